// The world from above: shapes of the layout, what is to be reached and avoided, where the agent was, is and will be.
const CELL_AGENT = 0.34; // of a cell
const FREE_AGENT = 0.022; // of the picture's width

function drawWorld(scene, episode, name) {
  const [xs, ys, headings] = episode.places;
  const { width, height, cell } = scene;
  const thin = width / 400;
  const margin = cell ? 0 : width * 0.02;
  const box = `${-margin} ${-margin} ${width + 2 * margin} ${height + 2 * margin}`;
  const picture = svg("svg", { class: "map", viewBox: box, role: "img", style: `--ratio:${width / height}` });
  picture.append(hatching(name, thin));
  if (cell) picture.append(gridLines(width, height, cell, thin));
  const marks = scene.shapes.map((shape) => ({ shape, node: drawMarks(shape, name, thin) }));
  const toCome = svg("path", { class: "trail to-come", "stroke-width": 2 * thin, d: route(xs, ys, 0, episode.steps, cell) });
  const been = svg("path", { class: "trail been", "stroke-width": 2.4 * thin });
  const done = svg("g");
  const agent = drawAgent(cell ? cell * CELL_AGENT : width * FREE_AGENT, thin, Boolean(cell), Boolean(headings));
  picture.append(...scene.shapes.map((shape) => drawShape(shape, thin)), ...marks.map(({ node }) => node), toCome, been, ...scene.shapes.map((shape) => drawName(shape, thin)), agent, done);
  const numbers = completed(episode).map((step, number) => [step, markDone(xs[step], ys[step], number + 1, (cell ?? width / 9) * 0.17, thin, cell)]);

  return {
    node: picture,
    show(moment) {
      const here = namesOf(moment.reach);
      const shunned = namesOf(moment.avoid);
      for (const { shape, node } of marks) {
        node.classList.toggle("reach", here.includes(shape.name));
        node.classList.toggle("avoid", shunned.includes(shape.name));
      }
      been.setAttribute("d", route(xs, ys, 0, moment.now, cell));
      const turn = headings ? ` rotate(${(headings[moment.now] * 180) / Math.PI})` : "";
      agent.setAttribute("transform", `translate(${xs[moment.now]} ${ys[moment.now]})${turn}`);
      done.replaceChildren(...numbers.filter(([step]) => step <= moment.now).map(([, node]) => node));
      picture.setAttribute("aria-label", `The world from above. ${spoken(episode, moment)}`);
    },
  };
}

// Steps at which the task moved on.
function completed(episode) {
  return episode.standing
    .filter(([, task, node], number, all) => number && (task !== all[number - 1][1] || node !== all[number - 1][2]))
    .map(([step]) => step);
}

// A line through places; over the edge of a torus it leaves on one side and comes back on the other.
function route(xs, ys, first, last, cell) {
  const far = cell ? 1.5 * cell : Infinity;
  let path = `M${xs[first]} ${ys[first]}`;
  for (let t = first + 1; t <= last; t++) {
    const [dx, dy] = [xs[t] - xs[t - 1], ys[t] - ys[t - 1]];
    if (Math.max(Math.abs(dx), Math.abs(dy)) > far) {
      const [ox, oy] = [dx, dy].map((some) => -Math.sign(some) * (Math.abs(some) > far ? cell / 2 : 0));
      path += `L${xs[t - 1] + ox} ${ys[t - 1] + oy}M${xs[t] - ox} ${ys[t] - oy}`;
    }
    path += `L${xs[t]} ${ys[t]}`;
  }
  return path;
}

function gridLines(width, height, cell, thin) {
  let path = "";
  for (let x = cell; x < width; x += cell) path += `M${x} 0V${height}`;
  for (let y = cell; y < height; y += cell) path += `M0 ${y}H${width}`;
  return svg("path", { class: "grid", d: path, "stroke-width": thin });
}

function hatching(name, thin) {
  const size = 9 * thin;
  return svg("defs", {},
    svg("pattern", { id: `hatch-${name}`, width: size, height: size, patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" },
      svg("path", { class: "hatching", d: `M${size / 2} 0V${size}`, "stroke-width": 1.6 * thin })));
}

// A region, a cell or a wall as an element with other attributes.
function formOf({ kind, x, y, radius }, attributes) {
  const r = kind === "cell" ? 0.94 * radius : radius;
  return kind === "disc"
    ? svg("circle", { cx: x, cy: y, r, ...attributes })
    : svg("rect", { x: x - r, y: y - r, width: 2 * r, height: 2 * r, rx: kind === "cell" ? 0.13 * r : 0, ...attributes });
}

function drawShape(shape, thin) {
  if (shape.kind === "wall") return svg("g", {}, formOf(shape, { class: "wall" }));
  return svg("g", {},
    formOf(shape, { class: "place", "stroke-width": thin }),
    shape.color && formOf(shape, { class: "tint", fill: `rgb(${shape.color})` }));
}

// What classes reach and avoid switch on: rim, hatching and a badge, above all shapes.
function drawMarks(shape, owner, thin) {
  const { kind, x, y, radius } = shape;
  const corner = radius * 0.7;
  const badge = Math.min(0.2 * radius, 11 * thin);
  const arm = 0.5 * badge;
  const line = { "stroke-width": 0.26 * badge };
  if (kind === "wall") return svg("g");
  return svg("g", {},
    formOf(shape, { class: "hatch", fill: `url(#hatch-${owner})` }),
    formOf(shape, { class: "rim", "stroke-width": 4 * thin }),
    svg("g", { class: "badge", transform: `translate(${x + corner} ${y - corner})` },
      svg("circle", { r: badge, ...line }),
      svg("circle", { class: "aim", r: 0.3 * badge, ...line }),
      svg("path", { class: "cross", d: `M${-arm} ${-arm}L${arm} ${arm}M${-arm} ${arm}L${arm} ${-arm}`, ...line })));
}

// Above the way of the agent.
function drawName({ kind, name, x, y, radius }, thin) {
  const size = Math.min(kind === "disc" ? 0.62 * radius : 0.8 * radius, (2.9 * radius) / name.length, 24 * thin);
  return svg("text", { class: "name", x, y, "font-size": size, "stroke-width": size * 0.2 }, name);
}

function drawAgent(radius, thin, onGrid, turns) {
  if (onGrid) {
    return svg("g", { class: "agent" },
      svg("circle", { class: "edge", r: radius, "stroke-width": 7.5 * thin }),
      svg("circle", { class: "ring", r: radius, "stroke-width": 4.5 * thin }));
  }
  const nose = turns && svg("path", { class: "body", d: `M${radius * 0.5} ${-radius * 0.95}L${radius * 2.1} 0L${radius * 0.5} ${radius * 0.95}z` });
  return svg("g", { class: "agent" }, svg("circle", { class: "halo", r: radius * 1.5 }), nose, svg("circle", { class: "body", r: radius }));
}

function markDone(x, y, number, radius, thin, cell) {
  const [left, up] = cell ? [x - 0.3 * cell, y + 0.3 * cell] : [x, y];
  return svg("g", { class: "done" },
    svg("circle", { cx: left, cy: up, r: radius, "stroke-width": 1.2 * thin }),
    svg("text", { x: left, y: up, "font-size": radius * 1.4 }, String(number)));
}

const LEGEND = [
  [`<circle cx="10" cy="10" r="6.5" fill="none" stroke="var(--reach)" stroke-width="2.4"/><circle cx="10" cy="10" r="1.6" fill="var(--reach)"/>`, "to be reached now"],
  [`<path d="M4 4 16 16M4 16 16 4" stroke="var(--avoid)" stroke-width="2.4" stroke-linecap="round"/>`, "to be avoided now (hatched)"],
  [`<circle cx="10" cy="10" r="8" fill="var(--done)"/><text x="10" y="14" text-anchor="middle" font-size="11" font-weight="700" fill="var(--surface)">1</text>`, "where the task moved on, in order"],
  [`<path d="M2 10h16" stroke="var(--ink)" stroke-width="2.4" stroke-linecap="round"/>`, "way so far; faint: still to come"],
];

function drawLegend() {
  for (const [drawing, meaning] of LEGEND) {
    const picture = svg("svg", { viewBox: "0 0 20 20", "aria-hidden": "true" });
    picture.innerHTML = drawing;
    byId("legend").append(html("li", {}, picture, meaning));
  }
}
