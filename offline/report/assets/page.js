const data = JSON.parse(document.getElementById("data").textContent);
const CHI2_95 = Math.sqrt(5.991464547107979); // of two degrees of freedom
const STEPS = 36;
// There a finger outside the map scrolls the page, and buttons would cover the figure.
const TOUCH = matchMedia("(pointer: coarse)");
// No button may send a map anywhere.
const CONFIG = { displaylogo: false, displayModeBar: TOUCH.matches ? false : "hover", scrollZoom: true, showSendToCloud: false, plotlyServerURL: "",
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"] };
const STILL = { ...CONFIG, scrollZoom: false };
const NARROW_PX = 600; // as in page.css
const PAPER_PX = 690; // between the margins of A4 and of Letter
// What buttons choose: each name's first value until a click.
const chosen = { ellipses: "shape", tags: "sigma", layers: "over", legend: "folded" };
let printing = false;

// Plotly takes some markup in labels; names are names.
const plain = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const isDark = () => !printing && matchMedia("(prefers-color-scheme: dark)").matches;
const known = (value, digits) => value === null ? "unknown" : value.toFixed(digits);

function axis(extra) {
  return { gridcolor: colour("--grid"), zerolinecolor: colour("--grid"), linecolor: colour("--rule"),
    tickcolor: colour("--rule"), ...extra };
}

function layout(element, extra) {
  return { paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: colour("--front"), family: "system-ui, sans-serif", size: 12 }, width: widthOf(element),
    modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("--quiet"), activecolor: colour("--front") },
    hoverlabel: { align: "left", bgcolor: colour("--panel"), bordercolor: colour("--rule"),
      font: { color: colour("--front") } },
    margin: { l: 50, r: 12, t: 12, b: 44 }, ...extra };
}

const stillness = () => TOUCH.matches ? { dragmode: false } : {};

function widthOf(element) {
  return printing ? PAPER_PX : element.clientWidth;
}

function extent(traces) {
  let [low, high] = [[Infinity, Infinity], [-Infinity, -Infinity]];
  for (const { x, y } of traces) {
    for (let i = 0; i < x.length; i++) {
      if (x[i] === null) continue;
      low = [Math.min(low[0], x[i]), Math.min(low[1], y[i])];
      high = [Math.max(high[0], x[i]), Math.max(high[1], y[i])];
    }
  }
  return { low, high, wide: Math.max(high[0] - low[0], 1), tall: Math.max(high[1] - low[1], 1) };
}

// Rows of a horizontal legend, from above: what does not fit begins another.
function rowsOfLegend(traces, width) {
  let rows = 1, used = 0;
  for (const trace of traces.filter((each) => each.showlegend !== false)) {
    const entry = 60 + 7 * trace.name.length;
    if (used > 0 && used + entry > width) [rows, used] = [rows + 1, 0];
    used += entry;
  }
  return rows;
}

// So that metres are as long along both axes without much empty room.
function plan(element, traces) {
  const { low, high, wide, tall } = extent(traces);
  // Plotly leaves no room beside the ends of lines.
  const room = 0.02 * Math.max(wide, tall);
  const around = (i) => ({ include: [low[i] - room, high[i] + room] });
  const width = widthOf(element);
  const isFolded = !printing && innerWidth <= NARROW_PX && chosen.legend === "folded";
  const legend = isFolded ? 0 : rowsOfLegend(traces, width - 62);
  const height = Math.min(Math.max((width - 62) * (tall / wide) * 1.08, 260), 760) + 60 + 22 * legend;
  return layout(element, { height, dragmode: "pan", hovermode: "closest", showlegend: !isFolded,
    legend: { orientation: "h", y: 0, yref: "container", yanchor: "bottom", x: 0, tracegroupgap: 0 },
    margin: { l: 50, r: 12, t: 12, b: 48 + 22 * legend },
    xaxis: axis({ title: { text: "x (m)", standoff: 4 }, autorangeoptions: around(0) }),
    yaxis: axis({ title: { text: "y (m)", standoff: 4 }, autorangeoptions: around(1), scaleanchor: "x", scaleratio: 1 }) });
}

function start(run, shift) {
  return { type: "scatter", mode: "markers", x: [run.x[0]], y: [run.y[0] + shift], hoverinfo: "text",
    hovertext: [`start of ${plain(run.run)}`], legendgroup: run.run, showlegend: false,
    marker: { symbol: "triangle-up", angle: 90 - run.heading_rad * 180 / Math.PI, size: 15, color: run.colour,
      line: { color: colour("--back"), width: 1 } } };
}

const WAY_PX = 1.6;
const dashesOf = (run) => run.dashes.map((length) => `${WAY_PX * length}px`).join(",") || "solid";

function way(run, shift, dash = dashesOf(run)) {
  return { type: "scatter", mode: "lines", name: plain(run.run), x: run.x, y: run.y.map((y) => y + shift),
    hoverinfo: "name", legendgroup: run.run, line: { color: run.colour, width: WAY_PX, dash } };
}

function links(layers, shifts) {
  const places = new Map();
  layers.forEach((layer, i) => layer.tags.label.forEach((label, j) => {
    if (!places.has(label)) places.set(label, []);
    places.get(label).push([layer.tags.x[j], layer.tags.y[j] + shifts[i]]);
  }));
  const [x, y] = [[], []];
  for (const seen of places.values()) {
    for (let i = 1; i < seen.length; i++) {
      x.push(seen[i - 1][0], seen[i][0], null);
      y.push(seen[i - 1][1], seen[i][1], null);
    }
  }
  return { type: "scatter", mode: "lines", name: "same tag", x, y, hoverinfo: "skip",
    line: { color: colour("--front"), width: 1 } };
}

function drawBefore(element) {
  const layers = data.components[element.dataset.index].before;
  let above = 0;
  const shifts = layers.map((layer, i) => {
    if (chosen.layers === "over") return 0;
    const ys = [...layer.y, ...layer.tags.y];
    const [low, high] = ys.reduce(([a, b], y) => [Math.min(a, y), Math.max(b, y)], [Infinity, -Infinity]);
    const shift = i ? above - low : 0;
    above = high + shift + 0.25 * (high - low) + 1;
    return shift;
  });
  const traces = layers.flatMap((layer, i) => [way(layer, shifts[i]), start(layer, shifts[i]), {
    type: "scatter", mode: "markers", x: layer.tags.x, y: layer.tags.y.map((y) => y + shifts[i]), hoverinfo: "text",
    hovertext: layer.tags.label.map((label) => `tag ${plain(label)} by ${plain(layer.run)}`), legendgroup: layer.run,
    showlegend: false, marker: { symbol: "square-open", size: 8, color: layer.colour, line: { width: 1.6 } } }]);
  traces.push(links(layers, shifts));
  return Plotly.react(element, traces, { ...plan(element, traces), ...stillness() }, CONFIG);
}

function drawSearch(element) {
  const search = data.searches[element.dataset.index];
  const trace = { type: "scatter", mode: "lines+markers", x: search.grid_s, y: search.cost,
    line: { color: colour("--front"), width: 1.4 }, marker: { size: 4 },
    hovertemplate: "%{y} at %{x} s<extra></extra>" };
  const found = { type: "line", xref: "x", yref: "paper", x0: search.offset_s, x1: search.offset_s, y0: 0, y1: 1,
    line: { color: colour("--alarm"), width: 1.4, dash: "dot" } };
  return Plotly.react(element, [trace], layout(element, { height: 260, showlegend: false, shapes: [found],
    hovermode: "closest", dragmode: "zoom", ...stillness(),
    xaxis: axis({ title: { text: "time offset (s), beyond robot.yaml's", standoff: 4 } }),
    yaxis: axis({ title: { text: "cost" }, rangemode: "tozero" }) }), STILL);
}

function draw(element) {
  if (element.classList.contains("map")) return drawMap(element);
  if (element.classList.contains("search")) return drawSearch(element);
  return element.classList.contains("before") ? drawBefore(element) : drawTimeline(element);
}

// The first figure at once, the others when there is time, so that the page is there soon.
async function drawAll() {
  for (const element of document.querySelectorAll(".plot")) {
    await draw(element);
    await new Promise((resolve) => setTimeout(resolve, 0));
  }
  document.documentElement.dataset.drawn = "yes";
}

const KINDS = { ellipses: ".plot.map", tags: ".plot.map", layers: ".plot.before", legend: ".plot.map, .plot.before" };
for (const button of document.querySelectorAll("button[data-choice]")) {
  const { choice, value } = button.dataset;
  button.addEventListener("click", () => {
    chosen[choice] = value;
    for (const other of document.querySelectorAll(`button[data-choice="${choice}"]`)) {
      other.setAttribute("aria-pressed", String(other === button));
    }
    for (const element of document.querySelectorAll(KINDS[choice])) draw(element);
  });
}
linkTimeline();
for (const row of document.querySelectorAll("tr[data-tags]")) {
  row.addEventListener("click", () => showTags(row.dataset.tags));
  row.addEventListener("keydown", (event) => event.key === "Enter" && showTags(row.dataset.tags));
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
// Plotly's own way to follow the window gives figures a height that overlaps what comes below.
let later = 0;
addEventListener("resize", () => {
  clearTimeout(later);
  later = setTimeout(() => printing || drawAll(), 100);
});
addEventListener("beforeprint", () => {
  printing = true;
  document.documentElement.dataset.paper = "";
  for (const details of document.querySelectorAll("details")) details.open = true;
  for (const element of document.querySelectorAll(".plot")) draw(element);
});
addEventListener("afterprint", () => {
  printing = false;
  delete document.documentElement.dataset.paper;
  drawAll();
});
drawAll();
