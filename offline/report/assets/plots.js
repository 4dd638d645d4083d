// What figures share: colours, axes, sizes, trajectories.

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
