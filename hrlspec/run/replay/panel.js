// One agent's episode: all that is shown of it, side by side with another's if there are two.
function makePanel(run, number, episodeNumber, length, bounds, seek) {
  const episode = run.episodes[episodeNumber];
  const scene = RECORD.scenes[episodeNumber];
  const identity = `run-${number}`;
  const now = html("p", { class: "now" });
  const parts = [];
  const world = scene && drawWorld(scene, episode, identity);
  const automaton = RECORD.automaton && drawAutomaton(RECORD.automaton, episode.standing[0][1]);
  const treeBox = html("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Task tree" });
  const choice = drawChoice(episode);
  const chart = drawChart(episode, length, bounds, seek);
  const log = drawLog(episode, seek);
  const side = html("div", { class: "side" },
    automaton && section("Automaton", html("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Automaton" }, automaton.node)),
    section(RECORD.automaton ? "Ways on from this state" : "Task", treeBox), choice.node);
  const trees = {};
  let tree = null;

  const node = html("article", { class: world ? "panel" : "panel unseen", "aria-labelledby": identity },
    html("header", { class: "head" },
      html("h2", { id: identity }, run.name, html("span", {}, ` · ${run.method}`)),
      html("p", { class: "outcome number" }, html("b", {}, outcomeOf(episode)), ` · ${plural(episode.steps, "step")} · return ${episode.return}`)),
    now,
    world && html("div", { class: "world" }, world.node),
    side,
    html("section", { class: "chart" }, html("h3", {}, `Low level’s value${episode.decisions.length ? "; ○ the planner’s, where it decides" : ""}`), chart.node),
    html("details", { class: "log" }, html("summary", {}, "What happened"), log.node));

  return {
    node,
    episode,
    show(step) {
      const moment = momentOf(episode, step);
      node.dataset.step = moment.now;
      now.replaceChildren(...sentence(episode, moment));
      world?.show(moment);
      automaton?.show(moment, episode, `The automaton is in state ${moment.task}.`);
      trees[moment.task] ??= drawTree(moment.tree);
      if (tree !== trees[moment.task]) showTree(treeBox, moment.tree, (tree = trees[moment.task]).node);
      tree.show(moment, treeInWords(moment));
      choice.show(moment);
      chart.show(moment);
      log.show(moment.now);
      return spoken(episode, moment);
    },
  };
}

// Where nothing remains there is no graph to see.
const showTree = (box, tree, node) => box.replaceChildren(tree.parent.length > 1 ? node : html("p", { class: "small" }, "Nothing remains to be done."));

const section = (title, ...children) => html("section", {}, html("h3", {}, title), ...children);

// What happens now, for the eye.
function sentence(episode, moment) {
  const head = `Step ${moment.now} of ${episode.steps}. `;
  const here = moment.labels.length ? ["Here: ", html("b", {}, listed(moment.labels)), ". "] : [];
  if (moment.ended) return [head, ...here, "The episode is over: ", html("b", {}, outcomeOf(episode)), "."];
  const avoid = moment.avoid.length ? [", avoid ", html("b", { class: "avoid" }, `✕ ${listed(moment.avoid)}`)] : [];
  const goal = `◎ ${namesOf(moment.reach).join(moment.edge ? " and " : " or ")}`;
  return [head, ...here, moment.edge ? "Reach " : "Nothing is assigned; what remains: ", html("b", { class: "reach" }, goal), ...avoid, "."];
}

function treeInWords(moment) {
  const { tree, open, blocked, edge, node } = moment;
  const done = [];
  for (let some = node; some !== ROOT; some = tree.parent[some]) done.unshift(namesOf(tree.reach[some]).join(" and "));
  const parts = [
    done.length && `Done: ${done.join(", then ")}.`,
    edge && `In force: ${subtask(tree, edge)}.`,
    open.length && `Open branches: ${open.map((some) => subtask(tree, some)).join("; ")}.`,
    blocked.length && `Blocked: ${blocked.map((some) => subtask(tree, some)).join("; ")}.`,
  ];
  return `The task as a tree. ${parts.filter(Boolean).join(" ")}`;
}

// The newest decision: value and probability of each branch that was open then.
function drawChoice(episode) {
  const node = html("section");
  let last = null;
  return {
    node,
    show({ decision }) {
      if (decision === last) return;
      last = decision;
      node.replaceChildren(...(decision ? choiceTable(episode, decision) : []));
    },
  };
}

function choiceTable(episode, { step, value, branches }) {
  const { tree, edge } = momentOf(episode, step);
  const rows = branches.map(([branch, probability, worth]) => {
    const chosen = branch === edge;
    return html("tr", { class: chosen && "chosen" },
      html("td", {}, html("span", { class: "mark", "aria-hidden": "true" }, chosen ? "▶" : ""), subtask(tree, branch), chosen && html("span", { class: "hidden" }, " (chosen)")),
      html("td", { class: "number" }, html("span", { class: "bar", "aria-hidden": "true" }, html("i", { style: `width:${100 * (probability ?? 0)}%` })), percent(probability)),
      html("td", { class: "number right" }, shown(worth)));
  });
  const alone = "The planner’s value if this were the only branch";
  const heads = ["Branch", "Probability", "Value alone"].map((name, column) => html("th", { scope: "col", class: column === 2 && "right", title: column === 2 && alone }, name));
  return [
    html("h3", {}, `Planner at step ${step}`, html("span", { class: "number" }, `value ${shown(value)}`)),
    html("table", { class: "branches" }, html("thead", {}, html("tr", {}, ...heads)), html("tbody", {}, ...rows)),
  ];
}

// What happened, as buttons that lead to the step.
function drawLog(episode, seek) {
  const entries = eventsOf(episode).map(([step, words]) => {
    const button = html("button", { type: "button" }, html("span", { class: "number" }, `Step ${step}`), html("span", {}, words));
    button.addEventListener("click", () => seek(step));
    return { step, button };
  });
  return {
    node: html("ol", {}, ...entries.map(({ button }) => html("li", {}, button))),
    show(now) {
      for (const { step, button } of entries) {
        if (step === now) button.setAttribute("aria-current", "step");
        else button.removeAttribute("aria-current");
      }
    },
  };
}
