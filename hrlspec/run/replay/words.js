// What is shown, in words.
const namesOf = (members) => members.map((member) => RECORD.names[member]);
const listed = (members, nothing) => namesOf(members).join(", ") || nothing;
const plural = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;
const shown = (value) => (value === null ? "–" : value.toFixed(2));
const percent = (share) => (share === null ? "–" : `${(100 * share).toFixed(share > 0 && share < 0.01 ? 1 : 0)} %`);
const SIGNS = { satisfied: "✓", violated: "✕" };

function subtask(tree, edge) {
  const avoid = tree.avoid[edge].length ? `, avoiding ${namesOf(tree.avoid[edge]).join(" ")}` : "";
  return namesOf(tree.reach[edge]).join(" and ") + avoid;
}

function outcomeOf(episode) {
  const how = episode.rounds ? plural(episode.rounds, "round") : episode.outcome;
  return `${SIGNS[episode.outcome] ?? "◦"} ${how}`;
}

// What happened, and when: [step, words].
function eventsOf(episode) {
  const events = episode.decisions.map((some) => {
    const { tree, edge } = momentOf(episode, some.step);
    const branch = some.branches.find(([child]) => child === edge);
    const odds = some.branches.length > 1 && branch ? ` (${percent(branch[1])})` : "";
    return [some.step, `the planner chooses ${subtask(tree, edge)}${odds}`];
  });
  episode.standing.forEach(([step, task, node, blocked], number) => {
    if (!number) return;
    const [, before, from, shut] = episode.standing[number - 1];
    const tree = RECORD.tasks[task];
    if (task !== before) events.push([step, `the automaton moves to state ${task}`]);
    else if (node !== from) events.push([step, `${namesOf(tree.reach[node]).join(" and ")} is reached`]);
    for (const edge of blocked.filter((some) => task === before && node === from && !shut.includes(some))) {
      events.push([step, `the branch to ${namesOf(tree.reach[edge]).join(" and ")} is blocked`]);
    }
  });
  for (const [step, reward] of episode.rewards) events.push([step + 1, `reward ${reward}`]);
  events.push([episode.steps, `the episode ends: ${outcomeOf(episode).slice(2)}`]);
  return events.map((event, order) => [...event, order]).sort((a, b) => a[0] - b[0] || a[2] - b[2]);
}

function spoken(episode, moment) {
  const head = `Step ${moment.now} of ${episode.steps}.`;
  const here = ` Here: ${listed(moment.labels, "nothing")}.`;
  if (moment.ended) return `${head}${here} The episode ended: ${outcomeOf(episode).slice(2)}.`;
  const any = moment.edge ? "" : " any of";
  return `${head}${here} To reach:${any} ${listed(moment.reach, "nothing")}. To avoid: ${listed(moment.avoid, "nothing")}. Value ${shown(moment.value)}.`;
}
