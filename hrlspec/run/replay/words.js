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

// What happened, and when: [step, words]. In one step, what was reached comes before what is assigned next.
function eventsOf(episode) {
  const events = [];
  episode.standing.forEach(([step, task, node, blocked], number) => {
    if (!number) return;
    const [, before, from, shut] = episode.standing[number - 1];
    const tree = RECORD.tasks[task];
    if (task !== before) events.push([step, `the automaton moves to state ${task}`]);
    else if (node !== from) events.push([step, `${namesOf(tree.reach[node]).join(" and ")} is reached`]);
    else for (const edge of blocked.filter((some) => !shut.includes(some))) events.push([step, `the branch to ${subtask(tree, edge)} is blocked`]);
  });
  for (const [step, reward] of episode.rewards) events.push([step + 1, `reward ${reward}`]);
  for (const { step, branches } of episode.decisions) {
    const { tree, edge } = momentOf(episode, step);
    const branch = branches.find(([child]) => child === edge);
    const odds = branches.length > 1 && branch ? ` (${percent(branch[1])})` : "";
    events.push([step, `the planner assigns ${subtask(tree, edge)}${odds}`]);
  }
  events.push([episode.steps, `the episode ends: ${outcomeOf(episode).slice(2)}`]);
  return events.sort((a, b) => a[0] - b[0]); // which keeps the order within a step
}

function spoken(episode, moment) {
  const head = `Step ${moment.now} of ${episode.steps}.`;
  const here = ` Here: ${listed(moment.labels, "nothing")}.`;
  if (moment.ended) return `${head}${here} The episode ended: ${outcomeOf(episode).slice(2)}.`;
  const any = moment.edge ? "" : " any of";
  return `${head}${here} To reach:${any} ${listed(moment.reach, "nothing")}. To avoid: ${listed(moment.avoid, "nothing")}. Value ${shown(moment.value)}.`;
}
