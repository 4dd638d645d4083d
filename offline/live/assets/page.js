// Asks for the newest map each second, and draws it where it is another one.
let data = { components: [] };
let newest = -1;
const PERIOD_MS = 1000;

history.replaceState(null, "", location.pathname); // the token stays out of sight

// The drives over time, which the report has beside its map, are not on this page.
const robotShapes = () => [];
const showClicked = () => {};
const draw = drawMap;

function fill(list, texts, classOf = () => "") {
  list.replaceChildren(...texts.map((text) => {
    const item = document.createElement("li");
    item.textContent = text;
    item.className = classOf(text);
    return item;
  }));
}

// In the colours of their lines, as a phone has no room for a legend in the map.
function showRuns(state) {
  const list = document.getElementById("runs");
  fill(list, state.runs.map((run) => `${run.name}: ${run.state}`));
  const mapped = state.components.flatMap((component) => component.runs);
  state.runs.forEach((run, index) => {
    list.children[index].style.borderColor = mapped.find((each) => each.run === run.name)?.colour ?? "";
  });
}

async function show(state) {
  const line = document.getElementById("line");
  line.textContent = state.line;
  line.className = "";
  fill(document.getElementById("hints"), state.hints, (text) => text.startsWith("advice: ") ? "" : "warning");
  showRuns(state);
  data = { components: state.components };
  const section = document.getElementById("map");
  while (section.children.length > data.components.length) section.lastChild.remove();
  while (section.children.length < data.components.length) {
    const element = document.createElement("div");
    element.className = "plot map";
    element.dataset.index = section.children.length;
    section.append(element);
  }
  for (const element of section.children) await draw(element);
}

async function ask() {
  const line = document.getElementById("line");
  try {
    const answer = await fetch(`state?after=${newest}`, { cache: "no-store" });
    if (answer.status === 200) {
      const state = await answer.json();
      newest = state.number;
      await show(state);
    } else if (answer.status !== 204) throw new Error(answer.statusText);
    line.className = "";
  } catch (error) {
    line.textContent = "No answer: the program has ended, or the connection is lost.";
    line.className = "lost";
    newest = -1;
  }
  setTimeout(ask, PERIOD_MS);
}

addEventListener("resize", () => {
  for (const element of document.querySelectorAll(".plot.map")) draw(element);
});
ask();
