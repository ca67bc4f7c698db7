// Reading the record: what held at a step. Lists of changes begin with the step from which they hold.
let RECORD = JSON.parse(byId("record").textContent);
const ROOT = 0;

function at(changes, step) {
  let low = 0;
  for (let high = changes.length - 1; low < high; ) {
    const middle = (low + high + 1) >> 1;
    if (changes[middle][0] <= step) low = middle;
    else high = middle - 1;
  }
  return changes[low];
}

const childrenOf = (tree, node) => tree.parent.flatMap((parent, child) => (parent === node ? [child] : []));

// How everything stood before the step of an episode, or at its end.
function momentOf(episode, step) {
  const now = Math.min(step, episode.steps);
  const ended = now === episode.steps;
  const [, task, node, blocked] = at(episode.standing, now);
  const tree = RECORD.tasks[task];
  const edge = ended ? null : at(episode.edges, now)[1];
  const open = ended ? [] : childrenOf(tree, node).filter((child) => !blocked.includes(child));
  const meant = edge ? [edge] : open; // a flat policy may take any open edge
  return {
    now, ended, task, node, blocked, tree, edge, open,
    reach: [...new Set(meant.flatMap((child) => tree.reach[child]))],
    avoid: meant.length ? tree.avoid[meant[0]].filter((name) => meant.every((child) => tree.avoid[child].includes(name))) : [],
    labels: at(episode.labels, now)[1],
    value: ended ? null : episode.values[now],
    decision: episode.decisions.findLast((some) => some.step <= now) ?? null,
  };
}

// Stretches of steps during which the same sub-task was in force: [first, end), and what it was.
function legsOf(episode) {
  const starts = new Set([0, ...episode.edges.map(([t]) => t), ...episode.standing.map(([t]) => t)]);
  const bounds = [...starts].filter((t) => t < episode.steps).sort((a, b) => a - b);
  const legs = [];
  for (const first of bounds) {
    const { task, edge } = momentOf(episode, first);
    const last = legs.at(-1);
    if (last && last.task === task && last.edge === edge && at(episode.standing, first)[2] === last.node) continue;
    if (last) last.end = first;
    legs.push({ first, end: episode.steps, task, edge, node: at(episode.standing, first)[2] });
  }
  return legs;
}
