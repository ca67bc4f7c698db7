// Time and keys: one step for all panels, played, scrubbed or stepped.
const SPEEDS = [2, 5, 10, 20, 50, 100, 200]; // steps per second
const SECONDS = 12; // that an episode takes at the speed it begins with
const JUMP = 10;
const CLICKED = new Set(["BUTTON", "SUMMARY", "INPUT", "SELECT", "A"]);

const player = { step: 0, length: 1, bounds: [0, 1], panels: [], playing: false, since: 0 };

function openEpisode(episode) {
  pause();
  player.length = Math.max(1, ...RECORD.runs.map((run) => run.episodes[episode].steps));
  player.panels = RECORD.runs.map((run, number) => makePanel(run, number, episode, player.length, player.bounds, seek));
  byId("panels").replaceChildren(...player.panels.map(({ node }) => node));
  byId("episode").value = String(episode);
  byId("step").max = String(player.length);
  byId("speed").value = String(SPEEDS.find((speed) => speed * SECONDS >= player.length) ?? SPEEDS.at(-1));
  show(0);
}

function show(step) {
  player.step = Math.max(0, Math.min(player.length, step));
  const said = player.panels.map((panel) => panel.show(player.step));
  const named = said.length > 1 ? said.map((words, number) => `${RECORD.runs[number].name}: ${words}`) : said;
  byId("step").value = String(player.step);
  byId("step").setAttribute("aria-valuetext", `step ${player.step} of ${player.length}`);
  byId("clock").textContent = `${player.step} / ${player.length}`;
  if (!player.playing) byId("spoken").textContent = named.join(" ");
}

function seek(step) {
  pause();
  show(step);
}

function play() {
  if (player.step >= player.length) show(0);
  player.playing = true;
  player.since = performance.now();
  showPlaying();
  requestAnimationFrame(advance);
}

function pause() {
  if (!player.playing) return;
  player.playing = false;
  showPlaying();
  show(player.step);
}

function showPlaying() {
  document.body.classList.toggle("playing", player.playing);
  byId("play").setAttribute("aria-label", player.playing ? "Pause" : "Play");
}

function advance(time) {
  if (!player.playing) return;
  const pace = 1000 / Number(byId("speed").value);
  const steps = Math.floor((time - player.since) / pace);
  if (steps > 0) {
    player.since += steps * pace;
    show(player.step + steps);
  }
  if (player.step >= player.length) pause();
  else requestAnimationFrame(advance);
}

// The nearest step before or after this one at which anything happened.
function happening(direction) {
  const steps = player.panels.flatMap(({ episode }) => eventsOf(episode).map(([step]) => step)).sort((a, b) => a - b);
  const found = direction > 0 ? steps.find((step) => step > player.step) : steps.findLast((step) => step < player.step);
  return found ?? player.step;
}

function changeEpisode(by) {
  const count = RECORD.scenes.length;
  openEpisode((Number(byId("episode").value) + by + count) % count);
}

function changeSpeed(by) {
  const place = SPEEDS.indexOf(Number(byId("speed").value)) + by;
  if (place >= 0 && place < SPEEDS.length) byId("speed").value = String(SPEEDS[place]);
}

const toggle = () => (player.playing ? pause() : play());
const NAMED = {
  ArrowLeft: ({ shiftKey }) => seek(player.step - (shiftKey ? JUMP : 1)),
  ArrowRight: ({ shiftKey }) => seek(player.step + (shiftKey ? JUMP : 1)),
  Home: () => seek(0),
  End: () => seek(player.length),
};
const CHARACTERS = {
  " ": toggle, ",": () => seek(happening(-1)), ".": () => seek(happening(1)), "-": () => changeSpeed(-1), "+": () => changeSpeed(1),
  "=": () => changeSpeed(1), p: () => changeEpisode(-1), n: () => changeEpisode(1),
};

function onKey(event) {
  const { target, key } = event;
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const onSlider = target.id === "step";
  const action = NAMED[key] ?? (byId("keys").checked ? CHARACTERS[key.toLowerCase()] : undefined);
  // What has the focus keeps the keys that it uses itself.
  if (!action || byId("panels").hidden || target.matches("select, textarea") || (key === " " && !onSlider && CLICKED.has(target.tagName))) return;
  if (key in NAMED && target.classList.contains("scroll")) return;
  event.preventDefault();
  action(event);
}

function openRecord(record) {
  RECORD = record;
  player.bounds = boundsOf(RECORD.runs);
  byId("world").textContent = ` · ${RECORD.world}`;
  byId("formula").textContent = RECORD.formula;
  byId("panels").className = RECORD.runs.length > 1 ? "two" : "one";
  byId("episode").replaceChildren(...RECORD.scenes.map((_, number) => {
    const ended = RECORD.runs.map(({ episodes }) => `${outcomeOf(episodes[number])}, ${plural(episodes[number].steps, "step")}`);
    return html("option", { value: number }, `${number + 1}: ${ended.join("  |  ")}`);
  }));
  byId("episodes").hidden = RECORD.scenes.length === 1;
  showPlayer(true);
  openEpisode(0);
}

function showPlayer(shown) {
  for (const part of document.querySelectorAll("#panels, .legend, .transport")) part.hidden = !shown;
}

function begin() {
  for (const speed of SPEEDS) byId("speed").append(html("option", { value: speed }, `${speed} / s`));
  drawLegend();
  const clicks = {
    play: toggle, first: NAMED.Home, last: NAMED.End, back: () => seek(player.step - 1), forward: () => seek(player.step + 1),
    previous: () => changeEpisode(-1), next: () => changeEpisode(1),
  };
  for (const [id, action] of Object.entries(clicks)) byId(id).addEventListener("click", action);
  byId("step").addEventListener("input", ({ target }) => seek(Number(target.value)));
  byId("episode").addEventListener("change", ({ target }) => openEpisode(Number(target.value)));
  document.addEventListener("keydown", onKey);
  if (RECORD) openRecord(RECORD);
}

begin();
