// What was measured over the steps: value, reward, sub-tasks, what held. Rows share their steps and one cursor.
function drawChart(episode, length, bounds, seek) {
  const [low, high] = bounds;
  const share = (step) => `${(100 * step) / length}%`;
  const height = (value) => (100 * (high - value)) / (high - low);
  const rows = html("div", { class: "rows" });
  let count = 0;
  const row = (name, kind, ...children) => {
    const style = `grid-row:${++count}`;
    const title = html("span", { class: "row-name", style }, name);
    rows.append(title, html("div", { class: `plot ${kind}`, style }, ...children));
    return title;
  };

  const line = svg("svg", { viewBox: `0 0 ${length} 100`, preserveAspectRatio: "none", "aria-hidden": "true" },
    svg("path", { class: "zero", d: `M0 ${height(0)}H${length}` }),
    svg("path", { d: lineOf(episode.values, height) }));
  const dots = episode.decisions.filter(({ value }) => value !== null).map(({ step, value }) =>
    html("span", { class: "dot", style: `left:${share(step)};top:${height(value)}%` }));
  const axis = row("", "value", line, ...dots);
  axis.classList.add("axis");
  axis.append(html("span", {}, shown(high)), html("span", {}, shown(low)));
  if (episode.rewards.length) {
    row("reward", "strip", ...episode.rewards.map(([step, reward]) => html("span", { class: step + 1 > 0.9 * length ? "gain left" : "gain", style: `left:${share(step + 1)}` }, `▲${reward > 0 ? "+" : ""}${reward}`)));
  }
  const legs = legsOf(episode).filter(({ edge }) => edge);
  if (legs.length) row("sub-task", "tall", ...legs.map(({ first, end, task, edge }) => {
    const text = subtask(RECORD.tasks[task], edge);
    return html("span", { class: "leg", style: `left:${share(first)};width:${share(end - first)}`, title: text }, text);
  }));
  const held = RECORD.names.map((name, proposition) => {
    const spans = stretchesOf(episode, proposition);
    if (!spans.length) return null;
    return row(name, "strip", ...spans.map(([first, end]) => html("span", { class: "held", style: `left:calc(${share(first)} - 1.5px);width:${share(Math.min(end, length) - first)}` })));
  });

  const cursor = html("span", { class: "cursor" });
  const reading = html("span", { class: "reading number" });
  const over = html("div", { class: "over-plots", style: `grid-row:1 / span ${count}` }, cursor, reading);
  rows.append(over);
  const seekTo = (event) => {
    const { left, width } = over.getBoundingClientRect();
    seek(Math.round((length * (event.clientX - left)) / width));
  };
  rows.addEventListener("pointerdown", (event) => {
    rows.setPointerCapture(event.pointerId);
    seekTo(event);
  });
  rows.addEventListener("pointermove", (event) => rows.hasPointerCapture(event.pointerId) && seekTo(event));

  return {
    node: rows,
    show(moment) {
      cursor.style.left = share(moment.now);
      reading.hidden = moment.value === null;
      reading.textContent = shown(moment.value);
      reading.style.left = share(moment.now);
      reading.style.top = `${0.96 * height(moment.value ?? 0)}px`;
      reading.classList.toggle("left", moment.now > 0.8 * length);
      reading.classList.toggle("low", height(moment.value ?? 0) > 50);
      held.forEach((title, proposition) => title?.classList.toggle("holds", moment.labels.includes(proposition)));
    },
  };
}

// A line that has gaps where there is no number.
function lineOf(values, height) {
  let path = "";
  values.forEach((value, step) => {
    if (value !== null) path += `${step && values[step - 1] !== null ? "L" : "M"}${step} ${height(value)}`;
  });
  return path || "M0 0";
}

// Steps [first, end) at which a proposition holds.
function stretchesOf(episode, proposition) {
  const spans = [];
  episode.labels.forEach(([step, members], number) => {
    const end = episode.labels[number + 1]?.[0] ?? episode.steps + 1;
    if (!members.includes(proposition)) return;
    if (spans.at(-1)?.[1] === step) spans.at(-1)[1] = end;
    else spans.push([step, end]);
  });
  return spans;
}

// The least and the largest value of all runs and episodes, so that all charts can be compared.
function boundsOf(runs) {
  const all = runs.flatMap(({ episodes }) => episodes.flatMap((some) => [...some.values, ...some.decisions.map(({ value }) => value)]));
  const known = all.filter((value) => value !== null);
  const low = known.reduce((a, b) => Math.min(a, b), 0);
  const high = known.reduce((a, b) => Math.max(a, b), 0);
  return high > low ? [low, high] : [low, low + 1];
}
