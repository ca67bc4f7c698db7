// Trying an agent: a task is typed, the layout's things are moved, and what comes back is played.
const BEGIN = JSON.parse(byId("begin").textContent);
const LANGUAGES = { spec: "SPECTRL", ltl: "LTL" };
const PATIENCE = 60000; // milliseconds
const FINE = 60; // steps of an arrow key across a world without cells
const FAR = 5; // such steps with Shift
const TURNS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

let layout = BEGIN.arrangement; // as it is shown
let places = null; // what was moved by hand, once anything was
let draws = layout.seed; // seeds of random numbers: each try has its own
let latest = Promise.resolve(); // one request after the other

class Refusal extends Error {}

async function ask(path, request) {
  const body = JSON.stringify(request);
  let answer;
  try {
    answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body, signal: AbortSignal.timeout(PATIENCE) });
  } catch {
    throw new Refusal("Nothing answers. Is the command still running?");
  }
  const found = await answer.json().catch(() => ({ message: `status ${answer.status}` }));
  if (!answer.ok) throw Object.assign(new Refusal(found.message), { line: found.line, column: found.column });
  return found;
}

function inTurn(work) {
  latest = latest.then(work).catch((error) => complain(error));
  return latest;
}

function complain(error) {
  const where = error.column ? `Line ${error.line ?? 1}, column ${error.column}: ` : "";
  byId("problem").textContent = `${where}${error.message}`;
  byId("task").setAttribute("aria-invalid", String(Boolean(error.column)));
  if (!error.column) return;
  const at = [...byId("task").value].slice(0, error.column - 1).join("").length; // columns count characters
  byId("task").focus();
  byId("task").setSelectionRange(at, at + 1);
}

function settle() {
  byId("problem").textContent = "";
  byId("notes").textContent = "";
  byId("task").setAttribute("aria-invalid", "false");
}

function go() {
  if (byId("go").getAttribute("aria-disabled") === "true") return latest;
  byId("go").setAttribute("aria-disabled", "true");
  const language = byId("language").value;
  const request = {
    language, task: byId("task").value, forever: language === "ltl" && byId("forever").checked,
    seed: layout.seed, places, draw: draws,
  };
  return inTurn(async () => {
    settle();
    const record = await ask("episode", request);
    draws += 1;
    byId("notes").textContent = record.notes.join(" ");
    showArranging(false);
    openRecord(record);
    byId("play").focus({ preventScroll: true }); // so that keys lead the player
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) play();
  }).finally(() => byId("go").setAttribute("aria-disabled", "false"));
}

function showArranging(shown) {
  byId("arrange").hidden = !shown;
  byId("change").hidden = shown;
  if (!shown) return;
  pause();
  showPlayer(false);
  byId("formula").textContent = document.title.slice("Play: ".length);
  drawArrangement();
}

// A layout that was drawn, or changed; the one that is shown stays if it is refused.
function arrange(seed, rearranged = () => null, focused = -1) {
  return inTurn(async () => {
    settle();
    const before = layout.seed;
    const wanted = rearranged();
    try {
      layout = await ask("layout", { seed, places: wanted });
      if (seed !== before) draws = seed;
      places = wanted;
    } finally {
      drawArrangement(focused);
    }
    const moved = layout.things[focused];
    byId("spoken").textContent = moved ? `${nameOf(moved)}: ${placeOf(moved)}.` : "New layout.";
  });
}

const nameOf = ([name]) => name || "the agent";
const inWords = (number) => String(Math.round(100 * number) / 100);
const placeOf = ([, x, y]) => {
  const { cell } = layout.scene;
  return cell ? `row ${Math.ceil(y / cell)}, column ${Math.ceil(x / cell)}` : `${inWords(x)} from the left, ${inWords(y)} from above`;
};

const move = (number, dx, dy) => arrange(layout.seed, () => placesAfter(number, dx, dy), number);

// A thing stays within the world, and in the middle of a cell where there are cells; what lies there takes its place.
function placesAfter(number, dx, dy) {
  const { width, height, cell } = layout.scene;
  const all = layout.things.map(([, x, y]) => [x, y]);
  const [x, y] = [[all[number][0] + dx, width], [all[number][1] + dy, height]].map(([some, most]) => {
    if (!cell) return Math.max(0, Math.min(most, some));
    return (Math.max(0, Math.min(most / cell - 1, Math.floor(some / cell))) + 0.5) * cell;
  });
  const there = cell ? all.findIndex(([left, top]) => Math.hypot(left - x, top - y) < cell / 2) : -1;
  if (there >= 0) all[there] = all[number];
  all[number] = [x, y];
  return all;
}

function drawArrangement(focused = -1) {
  const { scene, agent, things } = layout;
  byId("undo").disabled = !places;
  byId("how").textContent = !scene ? "This world cannot be drawn." : things.length
    ? `Drag ${things.some(([name]) => name) ? "things" : "the agent"} elsewhere, or use Tab and the arrow keys; with Shift they lead further.`
    : "Nothing can be moved in this world; there are new layouts.";
  if (!scene) return;
  const { width, height, cell } = scene;
  const thin = width / 400;
  const margin = cell ? 0 : width * 0.02;
  const box = `${-margin} ${-margin} ${width + 2 * margin} ${height + 2 * margin}`;
  const picture = svg("svg", { class: "map", viewBox: box, role: "group", "aria-label": "The world from above", style: `--ratio:${width / height}` });
  if (cell) picture.append(gridLines(width, height, cell, thin));
  const owners = new Map(things.filter(([name]) => name).map((thing) => [nearest(scene.shapes, thing), thing]));
  const groups = [];
  const movable = (thing, ...drawing) => {
    const group = makeMovable(picture, things.indexOf(thing), thing, thin, drawing);
    groups[things.indexOf(thing)] = group;
    return group;
  };
  const ring = { class: "focus", "stroke-width": 4 * thin };
  for (const shape of scene.shapes) {
    const drawing = [drawShape(shape, thin), drawName(shape, thin)];
    picture.append(...(owners.has(shape) ? [movable(owners.get(shape), ...drawing, formOf(shape, ring))] : drawing));
  }
  const radius = cell ? cell * CELL_AGENT : width * FREE_AGENT;
  const body = drawAgent(radius, thin, Boolean(cell), agent.length > 2);
  body.setAttribute("transform", `translate(${agent[0]} ${agent[1]}) rotate(${((agent[2] ?? 0) * 180) / Math.PI})`);
  const start = things.find(([name]) => !name);
  picture.append(start ? movable(start, body, svg("circle", { ...ring, cx: agent[0], cy: agent[1], r: 2 * radius })) : body);
  byId("arrangement").replaceChildren(picture);
  groups[focused]?.focus();
}

// The shape that a thing is drawn as.
function nearest(shapes, [name, x, y]) {
  const own = shapes.filter((shape) => shape.name === name);
  const far = (shape) => Math.hypot(shape.x - x, shape.y - y);
  return own.reduce((best, shape) => (far(shape) < far(best) ? shape : best));
}

function makeMovable(picture, number, thing, thin, drawing) {
  const group = svg("g", { class: "thing", tabindex: "0", role: "button", "aria-label": `${nameOf(thing)}, ${placeOf(thing)}`, "aria-describedby": "how" }, ...drawing);
  let from = null;
  const at = ({ clientX, clientY }) => new DOMPoint(clientX, clientY).matrixTransform(picture.getScreenCTM().inverse());
  const by = (event) => {
    const to = at(event);
    return [to.x - from.x, to.y - from.y];
  };
  group.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    from = at(event);
    picture.append(group); // above the others
    group.setPointerCapture(event.pointerId);
  });
  group.addEventListener("pointermove", (event) => from && group.setAttribute("transform", `translate(${by(event).join(" ")})`));
  group.addEventListener("pointerup", (event) => {
    if (!from) return;
    const [dx, dy] = by(event);
    from = null;
    if (Math.hypot(dx, dy) > thin) move(number, dx, dy);
    else group.focus();
  });
  group.addEventListener("pointercancel", () => {
    from = null;
    group.removeAttribute("transform");
  });
  group.addEventListener("keydown", (event) => {
    const turn = TURNS[event.key];
    if (!turn || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    const { width, cell } = layout.scene;
    const step = (cell ?? width / FINE) * (event.shiftKey ? FAR : 1);
    move(number, turn[0] * step, turn[1] * step);
  });
  return group;
}

function beginPlay() {
  byId("world").textContent = ` · ${BEGIN.world}`;
  for (const language of Object.keys(BEGIN.examples)) byId("language").append(html("option", { value: language }, LANGUAGES[language]));
  byId("task").value = BEGIN.examples.spec;
  byId("hint").textContent = `What can hold: ${BEGIN.names.join(", ")}.`;
  byId("language").addEventListener("change", ({ target }) => {
    byId("rounds").hidden = target.value !== "ltl";
    if (Object.values(BEGIN.examples).includes(byId("task").value)) byId("task").value = BEGIN.examples[target.value];
    settle();
  });
  byId("ask").addEventListener("submit", (event) => {
    event.preventDefault();
    go();
  });
  byId("task").addEventListener("keydown", (event) => {
    if (event.key !== "Enter" || event.shiftKey || event.isComposing) return;
    event.preventDefault();
    go();
  });
  byId("another").addEventListener("click", () => arrange(layout.seed + 1));
  byId("undo").addEventListener("click", () => arrange(layout.seed));
  byId("change").addEventListener("click", () => showArranging(true));
  showArranging(true);
}

beginPlay();
