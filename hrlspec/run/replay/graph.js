// The task as a graph: the tree of sub-tasks that is carried out, and the automaton whose states each have such a tree.
const LETTER_WIDTH = 7;
const ARROW = 7;

const widthOf = (text) => text.length * LETTER_WIDTH;

// A box for each sub-task, branches from left to right.
function drawTree(tree) {
  const boxes = tree.parent.map((_, edge) => ({
    reach: namesOf(tree.reach[edge]).join(" and "),
    avoid: tree.avoid[edge].length ? `not ${namesOf(tree.avoid[edge]).join(" ")}` : "",
  }));
  const width = Math.min(220, Math.max(64, ...boxes.map(({ reach, avoid }) => 44 + Math.max(widthOf(reach), 0.88 * widthOf(avoid)))));
  const height = boxes.some(({ avoid }) => avoid) ? 42 : 30;
  const [across, down] = [width + 40, height + 12];
  const depth = [];
  const row = [];
  let leaves = 0;
  const place = (node, level) => {
    depth[node] = level;
    const children = childrenOf(tree, node);
    children.forEach((child) => place(child, level + 1));
    row[node] = children.length ? (row[children[0]] + row[children.at(-1)]) / 2 : leaves++;
  };
  place(ROOT, 0);
  const left = (node) => 66 + across * (depth[node] - 1);
  const middle = (node) => 6 + down * row[node] + height / 2;
  const total = [66 + across * Math.max(...depth), down * leaves];
  const picture = svg("svg", { class: "graph", width: total[0], height: total[1], viewBox: `0 0 ${total.join(" ")}`, role: "img" });
  const groups = boxes.map(({ reach, avoid }, edge) => {
    if (edge === ROOT) return svg("g", {}, svg("circle", { class: "box", cx: 17, cy: middle(ROOT), r: 11 }));
    const [x, y, parent] = [left(edge), middle(edge), tree.parent[edge]];
    const start = parent === ROOT ? 28 : left(parent) + width + (tree.accepting.includes(parent) ? 3 : 0);
    const bend = (x - start) / 2;
    const lines = avoid ? [svg("text", { x: x + 28, y: y - 8 }, reach), svg("text", { class: "small", x: x + 28, y: y + 10 }, avoid)] : [svg("text", { x: x + 28, y }, reach)];
    return svg("g", {},
      svg("path", { class: "link", d: `M${start} ${middle(parent)}C${start + bend} ${middle(parent)} ${x - bend} ${y} ${x} ${y}` }),
      tree.accepting.includes(edge) && svg("rect", { class: "box", x: x - 3, y: y - height / 2 - 3, width: width + 6, height: height + 6, rx: 10 }),
      svg("rect", { class: "box", x, y: y - height / 2, width, height, rx: 8 }),
      svg("text", { class: "mark", x: x + 10, y: avoid ? y - 8 : y }),
      ...lines);
  });
  picture.append(...groups);

  return {
    node: picture,
    show(moment, words) {
      const { node, edge, open } = moment;
      const past = new Set();
      for (let some = node; some !== ROOT; some = tree.parent[some]) past.add(some);
      const shut = (some) => moment.blocked.includes(some);
      const reachable = (some) => some === node || (some > ROOT && !shut(some) && reachable(tree.parent[some]));
      groups.forEach((group, some) => {
        const state = {
          past: past.has(some) || (some === ROOT && node !== ROOT), here: some === node, force: some === edge && open.includes(some),
          blocked: shut(some), closed: some !== ROOT && !past.has(some) && !shut(some) && !reachable(some),
        };
        group.setAttribute("class", Object.keys(state).filter((name) => state[name]).join(" "));
        const mark = group.querySelector(".mark");
        if (mark) mark.textContent = state.past ? "✓" : state.blocked ? "⊘" : state.force ? "▶" : "";
      });
      picture.setAttribute("aria-label", words);
    },
  };
}

// States as circles, further from the start to the right; what fails stands below a state instead of leading to one.
function drawAutomaton(automaton, start) {
  const moves = automaton.moves.filter(({ to }) => !automaton.violated.includes(to));
  const depth = { [start]: 0 };
  const queue = [start];
  for (const state of queue) { // grows while it is read
    for (const { from, to } of moves) {
      if (from === state && !(to in depth)) {
        depth[to] = depth[state] + 1;
        queue.push(to);
      }
    }
  }
  const radius = 17;
  const notes = Object.fromEntries(queue.map((state) => [state, notesOf(automaton, state)]));
  const longest = Math.max(6, ...moves.filter(({ from, to }) => from !== to).map((move) => move.if.length + (move.accepts ? 8 : 0)));
  const across = Math.max(150, 64 + LETTER_WIDTH * longest, 24 + 0.88 * Math.max(...Object.values(notes).flat().map(widthOf), 0));
  const down = 96;
  const columns = [];
  for (const state of queue) (columns[depth[state]] ??= []).push(state);
  const tallest = Math.max(...columns.map((some) => some.length));
  const x = (state) => 60 + across * depth[state];
  const top = moves.some(({ from, to }) => from !== to && depth[from] >= depth[to]) ? 92 : 34;
  const y = (state) => top + down * (columns[depth[state]].indexOf(state) + (tallest - columns[depth[state]].length) / 2);
  const size = [60 + across * (columns.length - 1) + 80, top + down * (tallest - 1) + 56];
  const picture = svg("svg", { class: "graph", width: size[0], height: size[1], viewBox: `0 0 ${size.join(" ")}`, role: "img" });
  const links = moves.filter(({ from, to }) => from in depth && from !== to).map((move) => ({ move, node: drawMove(move, [x(move.from), y(move.from)], [x(move.to), y(move.to)], radius) }));
  const states = queue.map((state) => ({ state, node: svg("g", {},
    automaton.satisfied.includes(state) && svg("circle", { class: "box", cx: x(state), cy: y(state), r: radius + 4 }),
    svg("circle", { class: "box", cx: x(state), cy: y(state), r: radius }),
    svg("text", { x: x(state), y: y(state), "text-anchor": "middle" }, automaton.satisfied.includes(state) ? "✓" : String(state - start)),
    ...notes[state].map((note, line) => svg("text", { class: "small halo", x: x(state), y: y(state) + radius + 12 + 14 * line, "text-anchor": "middle" }, note))) }));
  picture.append(...links.map(({ node }) => node), ...states.map(({ node }) => node));

  return {
    node: picture,
    show(moment, episode, words) {
      const been = episode.standing.filter(([step]) => step <= moment.now).map(([, task]) => task);
      const taken = new Set(been.slice(1).map((task, number) => `${been[number]}-${task}`));
      for (const { move, node } of links) node.setAttribute("class", taken.has(`${move.from}-${move.to}`) ? "past" : "");
      for (const { state, node } of states) {
        const names = [been.includes(state) && "past", state === moment.task && "here"];
        node.setAttribute("class", names.filter(Boolean).join(" "));
      }
      picture.setAttribute("aria-label", words);
    },
  };
}

function notesOf(automaton, state) {
  const some = automaton.moves.filter(({ from }) => from === state);
  return [
    ...some.filter(({ to, accepts }) => to === state && accepts).map((move) => `round if ${move.if}`),
    ...some.filter(({ to }) => automaton.violated.includes(to)).map((move) => `fails if ${move.if}`),
  ];
}

// An arrow with its condition; backwards and within a column it swings out above.
function drawMove(move, [x1, y1], [x2, y2], radius) {
  const forward = x2 > x1;
  const swing = forward ? 0 : 54 + (x1 - x2) / 12;
  const reach = forward ? (x2 - x1) / 2 : 40;
  const [sx, sy] = forward ? [x1 + radius, y1] : [x1 - 5, y1 - radius + 1];
  const [ex, ey] = forward ? [x2 - radius - 4, y2] : [x2 + 5, y2 - radius - 3];
  const [c1, c2] = forward ? [[sx + reach - radius, sy], [ex - reach + radius, ey]] : [[sx - reach, sy - swing], [ex + reach, ey - swing]];
  const along = forward ? 0.4 : 0.5; // labels of crossing arrows do not meet
  const [lx, ly] = [0, 1].map((axis) => bezier([sx, sy][axis], c1[axis], c2[axis], [ex, ey][axis], along));
  const angle = Math.atan2(ey - c2[1], ex - c2[0]);
  const tip = [0, 2.6, -2.6].map((turn) => `${ex + (turn ? ARROW * Math.cos(angle + turn) : 0)} ${ey + (turn ? ARROW * Math.sin(angle + turn) : 0)}`);
  return svg("g", {},
    svg("path", { class: "link", d: `M${sx} ${sy}C${c1.join(" ")} ${c2.join(" ")} ${ex} ${ey}` }),
    svg("path", { class: "arrow", d: `M${tip.join("L")}z` }),
    svg("text", { class: "halo", x: lx, y: ly - (forward ? 9 : 0), "text-anchor": "middle" }, move.accepts ? `${move.if} (round)` : move.if));
}

const bezier = (a, b, c, d, t) => (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t ** 2 * c + t ** 3 * d;
