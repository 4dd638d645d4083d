const data = JSON.parse(document.getElementById("data").textContent);
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
