// The map: trajectories, tags, ellipses, suspect tags, other possible places of runs.

const ofShape = (component) => component.has_shape && chosen.ellipses === "shape";

function ellipses(component) {
  const [x, y] = [[], []];
  for (const tag of component.tags) {
    const [px, py] = tag.position_m;
    const [xx, xy, yy] = ofShape(component) ? tag.shape : tag.covariance;
    if (xx === null || xy === null || yy === null) continue;
    const a = Math.sqrt(Math.max(xx, 0));
    const b = a > 0 ? xy / a : 0;
    const c = Math.sqrt(Math.max(yy - b * b, 0));
    for (let i = 0; i <= STEPS; i++) {
      const [cos, sin] = [Math.cos(2 * Math.PI * i / STEPS), Math.sin(2 * Math.PI * i / STEPS)];
      x.push(px + CHI2_95 * a * cos);
      y.push(py + CHI2_95 * (b * cos + c * sin));
    }
    x.push(null);
    y.push(null);
  }
  const name = `95 % ellipses, relative to ${ofShape(component) ? "the other tags" : "the frame"}`;
  return { type: "scatter", mode: "lines", name, x, y, hoverinfo: "skip",
    line: { color: colour("--quiet"), width: 0.8 }, fill: "toself", fillcolor: "rgba(128,140,150,0.16)" };
}

function sigmas([xx, , yy]) {
  return xx === null || yy === null ? "sigma unknown"
    : `sigma x ${Math.sqrt(Math.max(xx, 0)).toFixed(3)} m, y ${Math.sqrt(Math.max(yy, 0)).toFixed(3)} m`;
}

// Some 70 characters in a line.
function inLines(text) {
  return text.match(/.{1,70}(\s|$)|\S+/g);
}

function told(tag, component) {
  const lines = [`<b>tag ${plain(tag.label)}</b> (${plain(tag.family)})`,
    `x ${known(tag.position_m[0], 3)} m, y ${known(tag.position_m[1], 3)} m`];
  if (tag.suspect !== null) lines.push(...inLines(`suspect: ${plain(tag.suspect)}`));
  if (tag.shape !== null) lines.push(`${sigmas(tag.shape)} relative to the other tags`);
  if (tag.shape === null || component.has_both) {
    lines.push(`${sigmas(tag.covariance)} relative to ${plain(component.frame)}`);
  }
  lines.push(`read ${tag.n} times`);
  for (const run of tag.observations) {
    lines.push(`${plain(run.run)}: ${run.n}, residual ${run.rms.toFixed(2)} sigma RMS, ${run.worst.toFixed(1)} at most`);
  }
  const more = tag.n_runs - tag.observations.length;
  if (more) lines.push(`and ${more} more runs`);
  return lines.join("<br>");
}

// Sigma along the worst direction, of the shape or in the frame as the ellipses; null where unknown.
function largestSigma(tag, component) {
  const [xx, xy, yy] = ofShape(component) ? tag.shape : tag.covariance;
  if (xx === null || xy === null || yy === null) return null;
  return Math.sqrt(Math.max((xx + yy) / 2 + Math.hypot((xx - yy) / 2, xy), 0));
}

// Logarithmic, over a factor of five at least, so that colours of tags that are known alike are alike.
function sigmaScale(component) {
  const sigmas = component.tags.map((tag) => largestSigma(tag, component)).filter((sigma) => sigma > 0);
  if (chosen.tags !== "sigma" || !sigmas.length) return null;
  const high = Math.max(...sigmas), low = Math.min(Math.max(Math.min(...sigmas), high / 100), high / 5);
  const ticks = [high, low];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power++) {
    ticks.push(...[1, 2, 5].map((digit) => digit * 10 ** power).filter((tick) => tick > low * 1.3 && tick < high / 1.3));
  }
  return { low, high, ticks };
}

function colourAxis(component, scale, isShown) {
  // What is known worst stands out most from the background.
  return { colorscale: "Viridis", reversescale: !isDark(), cmin: Math.log10(scale.low), cmax: Math.log10(scale.high),
    showscale: isShown, colorbar: { thickness: 12, len: 0.6, x: 1.01, tickvals: scale.ticks.map(Math.log10),
      ticktext: scale.ticks.map((tick) => Number(tick.toPrecision(2)) + ({ [scale.high]: " worst", [scale.low]: " better" }[tick] || "")),
      outlinewidth: 0,
      title: { text: `tags:<br>sigma (m)<br>relative to<br>${ofShape(component) ? "the others" : "the frame"}<br>&nbsp;` } } };
}

function tagTrace(component, tags, name, symbol, colours) {
  const scale = sigmaScale(component);
  const trace = namedTags(component, tags, name);
  const marker = { symbol, size: 8, color: colours, line: { color: colour(scale ? "--front" : "--back"), width: 1 } };
  if (!scale) return { ...trace, marker };
  const color = tags.map((tag) => {
    const sigma = largestSigma(tag, component);
    return sigma === null ? colour("--quiet") : Math.log10(Math.max(sigma, scale.low));
  });
  return { ...trace, marker: { ...marker, color, coloraxis: "coloraxis" } };
}

function namedTags(component, tags, name) {
  const many = tags.length > 150;
  return { type: "scatter", mode: many ? "markers" : "markers+text", name, x: tags.map((tag) => tag.position_m[0]),
    y: tags.map((tag) => tag.position_m[1]), text: tags.map((tag) => plain(tag.label)), textposition: "top center",
    textfont: { size: 10, color: colour("--front") }, hoverinfo: "text", hovertext: tags.map((tag) => told(tag, component)),
    hoverlabel: { font: { family: "system-ui, sans-serif" } } };
}

function advised(advice) {
  const text = plain(advice.text).replace(" would ", "<br>would ").replace(" (beside ", "<br>(beside ");
  const trace = { type: "scatter", x: advice.x, y: advice.y, hoverinfo: "text", hovertext: advice.x.map(() => text),
    name: advice.kind === "pass" ? "advised pass" : "advised tag" };
  if (advice.kind === "pass") {
    return { ...trace, mode: "lines", line: { color: colour("--advice"), width: 7 }, opacity: 0.5 };
  }
  return { ...trace, mode: "markers", marker: { symbol: "star", size: 15, color: colour("--advice"),
    line: { color: colour("--back"), width: 1 } } };
}

function suspectTrace(component, tags) {
  // Old and new places are often near each other.
  const textposition = tags.map((_, i) => i % 2 ? "bottom center" : "top center");
  const text = tags.map((tag) => plain(tag.label) + (tag.age ? ` (${tag.age})` : ""));
  return { ...namedTags(component, tags, "suspect tags"), mode: "markers+text", text, textposition,
    textfont: { size: 12, color: colour("--alarm") },
    marker: { symbol: "x", size: 11, color: colour("--alarm"), line: { color: colour("--back"), width: 1 } } };
}

// From the old place to the new; a line without a head where their order is unknown.
function arrow({ from: [ax, ay], to: [x, y], ordered }) {
  return { x, y, ax, ay, xref: "x", yref: "y", axref: "x", ayref: "y", text: "", showarrow: true,
    arrowhead: ordered ? 2 : 0, arrowwidth: 2, arrowcolor: colour("--alarm"), standoff: 6, startstandoff: 6 };
}

// Places by the survey that is the frame, each with a line to the tag that the map has elsewhere.
function surveyTraces(survey, tags) {
  const wrong = survey.filter((place) => place.tag !== null && !place.fits);
  const here = survey.filter((place) => place.tag !== null && place.fits);
  const elsewhere = survey.filter((place) => place.tag === null);
  const traces = [];
  const add = (name, places, line, text) => {
    if (!places.length) return;
    // The map's own tags have their labels already.
    const label = places.map((place) => place.tag === null ? plain(place.label) : "");
    traces.push({ type: "scatter", mode: "markers+text", name, x: places.map((place) => place.position_m[0]),
      y: places.map((place) => place.position_m[1]), hoverinfo: "text", hovertext: places.map(text), text: label,
      textposition: "top center", textfont: { size: 10, color: line },
      marker: { symbol: "circle-open", size: 15, color: line, line: { width: 1.5 } } });
  };
  add("place by the survey", here, colour("--front"),
    (place) => `tag ${plain(place.label)} by the survey: ${place.off_m.toFixed(3)} m from the map's`);
  add("survey, not in this map", elsewhere, colour("--quiet"),
    (place) => `tag ${plain(place.label)} by the survey; this map does not have it`);
  add("survey, looks wrong", wrong, colour("--alarm"),
    (place) => `tag ${plain(place.label)} by the survey: ${place.off_m.toFixed(3)} m from the map's, does not hold the frame`);
  if (wrong.length) {
    const along = (axis) => wrong.flatMap((place) => [place.position_m[axis], tags[place.tag].position_m[axis], null]);
    traces.push({ type: "scatter", mode: "lines", x: along(0), y: along(1), hoverinfo: "skip", showlegend: false,
      line: { color: colour("--alarm"), width: 2 } });
  }
  return traces;
}

function driven(run) {
  return { ...way(run, 0), customdata: run.t_s, meta: run.run,
    hovertemplate: "%{fullData.name} at %{customdata} s<extra></extra>" };
}

function rival(run) {
  const text = `${plain(run.run)}: one of ${run.of} possible places beside ${plain(run.with)}; not used`;
  const name = run.of > 1 ? `${plain(run.run)}, ${run.of} possible places` : `${plain(run.run)}, uncertain place`;
  return { ...way(run, 0, "dot"), name, legendgroup: `rivals ${run.run}`, hoverinfo: "text",
    hovertext: run.x.map(() => text), opacity: 0.6 };
}

// What a row of a table chose, by component.
const picked = {};

function pickedTrace(tags) {
  return { type: "scatter", mode: "markers", name: "chosen tag", x: tags.map((tag) => tag.position_m[0]),
    y: tags.map((tag) => tag.position_m[1]), hoverinfo: "skip", showlegend: false,
    marker: { symbol: "circle-open", size: 26, color: colour("--pick"), line: { width: 3 } } };
}

function mapTraces(component, index) {
  const own = Object.fromEntries(component.runs.map((run) => [run.run, run.colour]));
  const suspects = component.tags.filter((tag) => tag.suspect !== null);
  const single = component.tags.filter((tag) => tag.suspect === null && tag.n_runs < 2);
  const shared = component.tags.filter((tag) => tag.suspect === null && tag.n_runs > 1);
  const traces = component.runs.flatMap((run) => [driven(run), start(run, 0)]);
  if (component.is_merged) {
    component.before.forEach((run, i) => traces.push({ ...way(run, 0, "dot"), name: "before merging",
      visible: "legendonly", legendgroup: "before", showlegend: i === 0 }));
  }
  const named = new Set();
  for (const run of component.rivals) {
    traces.push({ ...rival(run), showlegend: !named.has(run.run) });
    named.add(run.run);
  }
  if (component.tags.length) traces.unshift(ellipses(component));
  if (single.length) {
    traces.push(tagTrace(component, single, component.runs.length > 1 ? "tags of one run" : "tags", "square",
      single.map((tag) => tag.observations.length ? own[tag.observations[0].run] : colour("--quiet"))));
  }
  if (shared.length) {
    traces.push(tagTrace(component, shared, "tags of several runs", "diamond", colour("--shared")));
  }
  traces.push(...surveyTraces(component.survey, component.tags));
  traces.push(...component.advice.map(advised));
  if (suspects.length) traces.push(suspectTrace(component, suspects));
  if (picked[index]) traces.push(pickedTrace(picked[index].map((i) => component.tags[i])));
  return traces;
}

// The first map fills what is left of the first screen; on a phone something is left beside it, to scroll by.
function mapHeight(element, planned) {
  if (printing) return planned;
  if (innerWidth <= NARROW_PX) return Math.min(Math.max(planned, 300), 0.6 * innerHeight);
  if (element.dataset.index !== "0") return planned;
  const left = innerHeight - element.getBoundingClientRect().top - scrollY - 12;
  return Math.max(left, 0.6 * innerHeight);
}

function drawMap(element) {
  const index = element.dataset.index;
  const component = data.components[index];
  const traces = mapTraces(component, index);
  const planned = plan(element, traces);
  // What was zoomed to stays when something else is drawn.
  for (const name of ["xaxis", "yaxis"]) {
    const now = element._fullLayout && element._fullLayout[name];
    if (now && now.autorange === false && !printing) planned[name].range = [...now.range];
  }
  const scale = sigmaScale(component);
  if (scale) planned.coloraxis = colourAxis(component, scale, planned.showlegend);
  if (scale && planned.showlegend) planned.margin.r = 100;
  const drawn = Plotly.react(element, traces, { ...planned, height: mapHeight(element, planned.height), uirevision: "map",
    annotations: component.moves.map(arrow), shapes: robotShapes(index) }, CONFIG);
  if (!element.dataset.listens) {
    zoomByPinches(element);
    element.on("plotly_click", showClicked);
  }
  element.dataset.listens = "yes";
  return drawn;
}

const rangesOf = (element) => [element._fullLayout.xaxis, element._fullLayout.yaxis].map((each) => [...each.range]);
const setRanges = (element, [x, y]) => Plotly.relayout(element, { "xaxis.range": x, "yaxis.range": y });

// Shows tags, each as component:index.
async function showTags(text) {
  const chosenTags = text.split(" ").map((each) => each.split(":").map(Number));
  const index = chosenTags[0][0];
  for (const other of Object.keys(picked)) delete picked[other];
  picked[index] = chosenTags.filter(([component]) => component === index).map(([, tag]) => tag);
  for (const element of document.querySelectorAll(".plot.map")) await draw(element);
  const element = document.querySelector(`.plot.map[data-index="${index}"]`);
  const { tags, runs } = data.components[index];
  const places = picked[index].map((i) => tags[i].position_m);
  const whole = extent([...runs, { x: tags.map((tag) => tag.position_m[0]), y: tags.map((tag) => tag.position_m[1]) }]);
  const ranges = [0, 1].map((axis) => {
    const values = places.map((place) => place[axis]);
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const half = 0.7 * (high - low) + 0.08 * Math.max(whole.wide, whole.tall);
    return [(low + high) / 2 - half, (low + high) / 2 + half];
  });
  await setRanges(element, ranges);
  element.scrollIntoView({ block: "center" });
}

// Plotly has no pinch: two fingers keep the points of the map under them, as far as shift and zoom can.
function zoomByPinches(element) {
  let first = null, last = null, waiting = false;
  const fingers = (event) => {
    const box = element.getBoundingClientRect();
    const [a, b] = [...event.touches].map((touch) => [touch.clientX - box.left, touch.clientY - box.top]);
    return { middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], apart: Math.max(Math.hypot(a[0] - b[0], a[1] - b[1]), 1) };
  };
  const catchTwo = (event, act) => {
    if (event.touches.length !== 2) return;
    event.preventDefault();
    event.stopPropagation();
    act(fingers(event));
  };
  const caught = { capture: true, passive: false };
  element.addEventListener("touchstart", (event) => catchTwo(event, (now) => {
    first = { ...now, ranges: rangesOf(element) };
  }), caught);
  element.addEventListener("touchmove", (event) => catchTwo(event, (now) => {
    if (first === null) return;
    const { xaxis, yaxis } = element._fullLayout;
    const factor = first.apart / now.apart;
    last = [xaxis, yaxis].map((axis, i) => {
      const [low, high] = first.ranges[i];
      // Ranges of y begin below, pixels above.
      const share = (pixel) => i ? 1 - (pixel - axis._offset) / axis._length : (pixel - axis._offset) / axis._length;
      const fixed = low + share(first.middle[i]) * (high - low);
      const begin = fixed - share(now.middle[i]) * (high - low) * factor;
      return [begin, begin + (high - low) * factor];
    });
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      setRanges(element, last);
    });
  }), caught);
  // The finger that came first had begun to drag; what plotly makes of that is undone.
  element.addEventListener("touchend", () => {
    if (last !== null) setTimeout(setRanges, 0, element, last);
    first = last = null;
  }, { capture: true });
}
