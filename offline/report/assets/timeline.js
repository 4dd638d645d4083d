// One drive over time, linked with the map: a moment of the drive is a line here and a circle there.

const moment = { run: 0, t_s: null }; // no time until one is chosen

function timelineShapes(line) {
  const upright = (x0, x1, style) => ({ xref: "x", yref: "paper", x0, x1, y0: 0, y1: 1, ...style });
  const gap = { type: "rect", fillcolor: colour("--quiet"), opacity: 0.3, line: { width: 0 }, layer: "below" };
  const now = { type: "line", line: { color: colour("--front"), width: 1 } };
  const expected = { type: "line", xref: "paper", yref: "y", x0: 0, x1: 1, y0: 1, y1: 1,
    line: { color: colour("--quiet"), width: 1, dash: "dot" } };
  return [expected, ...line.gaps.map(([begin, end]) => upright(begin, end, gap)),
    ...(moment.t_s === null ? [] : [upright(moment.t_s, moment.t_s, now)])];
}

function timelineTraces(line) {
  const common = { type: "scatter", hovertemplate: "%{y} at %{x} s<extra></extra>" };
  const { step_s, m_s } = line.speed;
  const traces = [
    { ...common, mode: "lines", name: "speed", x: m_s.map((_, i) => (i + 0.5) * step_s), y: m_s, yaxis: "y3",
      line: { color: line.colour, width: WAY_PX, dash: dashesOf(line) } },
    { ...common, mode: "lines", name: "tags", x: line.t_s, y: line.tags, yaxis: "y2", fill: "tozeroy",
      line: { color: line.colour, width: 1, shape: "hv" } },
    { ...common, mode: "markers", name: "largest", x: line.t_s, y: line.worst, yaxis: "y",
      marker: { size: 3, color: colour("--quiet") } },
    { ...common, mode: "markers", name: "RMS", x: line.t_s, y: line.rms, yaxis: "y",
      marker: { size: 4, color: line.colour } },
  ];
  if (line.events.length) {
    const top = Math.max(0.1, ...m_s) * 1.15;
    traces.push({ type: "scatter", mode: "markers", name: "events", x: line.events.map((event) => event.t_s),
      y: line.events.map(() => top), yaxis: "y3", cliponaxis: false, hoverinfo: "text",
      hovertext: line.events.map((event) => plain(event.text)),
      marker: { symbol: "triangle-down", size: 10,
        color: line.events.map((event) => event.loss ? colour("--alarm") : colour("--quiet")) } });
  }
  return traces;
}

function drawTimeline(element) {
  const line = data.timelines[moment.run];
  return Plotly.react(element, timelineTraces(line), layout(element, { height: 290, showlegend: false,
    shapes: timelineShapes(line), hovermode: "closest", dragmode: "zoom", ...stillness(), uirevision: line.run,
    margin: { l: 58, r: 12, t: 6, b: 24 },
    xaxis: axis({ ticksuffix: " s", anchor: "y", range: [0, Math.max(endOf(line), 0.1)] }),
    yaxis: axis({ title: { text: "residual" }, domain: [0, 0.3], type: "log", dtick: 1, range: [-1, mostLog(line)] }),
    yaxis2: axis({ title: { text: "tags" }, domain: [0.36, 0.64], rangemode: "tozero", nticks: 4 }),
    yaxis3: axis({ title: { text: "m/s" }, domain: [0.7, 1], rangemode: "tozero", nticks: 4 }) }), STILL);
}

const mostLog = (line) => Math.max(1, Math.log10(1.3 * Math.max(...line.worst)));
const trajectoryOf = (line) => data.components[line.component].runs.find((run) => run.run === line.run);
const endOf = (line) => trajectoryOf(line).t_s.at(-1);

function placeAt({ t_s, x, y }, at_s) {
  const next = t_s.findIndex((each) => each > at_s);
  if (next < 1) return [x.at(-1), y.at(-1)];
  const share = (at_s - t_s[next - 1]) / (t_s[next] - t_s[next - 1]);
  return [x, y].map((each) => each[next - 1] + share * (each[next] - each[next - 1]));
}

// Where the robot was, as a shape: its place changes without a redraw of the map.
function robotShapes(index) {
  const line = data.timelines[moment.run];
  if (moment.t_s === null || line.component !== Number(index)) return [];
  const [xanchor, yanchor] = placeAt(trajectoryOf(line), moment.t_s);
  return [{ type: "circle", xref: "x", yref: "y", xsizemode: "pixel", ysizemode: "pixel", xanchor, yanchor,
    x0: -8, x1: 8, y0: -8, y1: 8, fillcolor: line.colour, line: { color: colour("--front"), width: 2.5 } }];
}

let isAwaited = false;

function showMoment(run, t_s) {
  const isOther = run !== moment.run;
  moment.run = run;
  moment.t_s = Math.min(Math.max(t_s, 0), endOf(data.timelines[run]));
  fillControls();
  if (isOther) drawTimeline(document.querySelector(".plot.timeline"));
  if (isAwaited) return;
  isAwaited = true;
  requestAnimationFrame(() => {
    isAwaited = false;
    const shapes = timelineShapes(data.timelines[moment.run]);
    Plotly.relayout(document.querySelector(".plot.timeline"), { shapes });
    for (const element of document.querySelectorAll(".plot.map")) {
      Plotly.relayout(element, { shapes: robotShapes(element.dataset.index) });
    }
  });
}

function fillControls() {
  const line = data.timelines[moment.run];
  const slider = document.getElementById("time");
  document.getElementById("run").value = moment.run;
  slider.max = endOf(line);
  slider.value = moment.t_s ?? 0;
  if (moment.t_s === null) return;
  const { step_s, m_s } = line.speed;
  const speed = m_s[Math.min(Math.floor(moment.t_s / step_s), m_s.length - 1)] ?? 0;
  const tags = line.tags[line.t_s.findLastIndex((each) => each <= moment.t_s)];
  document.getElementById("moment").textContent =
    `${moment.t_s.toFixed(1)} s: ${speed.toFixed(2)} m/s, tags in view: ${tags}`;
}

function linkTimeline() {
  fillControls();
  document.getElementById("run").addEventListener("change", (event) => showMoment(Number(event.target.value), 0));
  document.getElementById("time").addEventListener("input", (event) => showMoment(moment.run, Number(event.target.value)));
  const element = document.querySelector(".plot.timeline");
  const follow = (event) => {
    const { xaxis } = element._fullLayout;
    const pixel = event.clientX - element.getBoundingClientRect().left - xaxis._offset;
    if (pixel >= 0 && pixel <= xaxis._length) showMoment(moment.run, xaxis.p2d(pixel));
  };
  element.addEventListener("pointermove", follow);
  element.addEventListener("pointerdown", follow);
}

// A click at a trajectory in the map.
function showClicked({ points: [point] }) {
  const run = data.timelines.findIndex((line) => line.run === point.data.meta);
  if (run >= 0) showMoment(run, point.customdata);
}
