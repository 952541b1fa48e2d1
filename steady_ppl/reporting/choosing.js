// What is shown: places are addresses, which can be linked to, kept and gone back from.
function address({ run, drive, from, to }) {
  const seconds = from === null ? "" : `&from=${from.toFixed(2)}&to=${to.toFixed(2)}`;
  return `#run=${run}&drive=${drive}${seconds}`;
}

function go(drive, from, to) {
  if (drive < 0) return void (element("place").textContent = "This trajectory is not among those that are shown row by row.");
  follow(address({ run: view.run, drive, from: Math.max(0, from), to }));
}

// A place as `where_to_look` names it, its drive by the table's number.
const goTo = ([drive, from, to]) => go(page.shown.indexOf(drive), from, to);

// Also the address that is there already.
function follow(hash) {
  if (hash === location.hash) show();
  else location.hash = hash;
}

function read() {
  const asked = new URLSearchParams(location.hash.slice(1));
  if (!asked.has("drive")) return false;
  const whole = (name, most, otherwise) => {
    const number = Number.parseInt(asked.get(name), 10);
    return Number.isNaN(number) ? otherwise : Math.min(most, Math.max(0, number));
  };
  view.run = whole("run", page.runs.length - 1, view.run);
  view.drive = whole("drive", page.labels.length - 1, 0);
  const [from, to] = ["from", "to"].map((name) => Number.parseFloat(asked.get(name)));
  const last = series(page.time, view.drive, 0).reduce((a, b) => Math.max(a, b), 0);
  [view.from, view.to] = to > from && to > 0 && from < last ? [Math.max(0, from), Math.min(to, last)] : [null, null];
  return true;
}

function show() {
  if (!read()) return;
  redraw(OF_RUN);
  element("h-drives").scrollIntoView();
  element("h-drives").focus({ preventScroll: true });
}

// The address always says what is shown.
function choose(change) {
  Object.assign(view, change);
  history.replaceState(null, "", location.href.split("#")[0] + address(view)); // whole: in a notebook's frame a part is the notebook's
  redraw("run" in change ? OF_RUN : [...OF_DRIVE, "map"]);
}

function options(id, names, change) {
  const select = element(id);
  if (!select) return;
  select.replaceChildren(...names.map((name, index) => new Option(name, index)));
  select.onchange = () => change(Number(select.value));
}

const DRAWN = {
  predictions: drawPredictions, states: drawStates, paths: drawPaths, controls: drawControls, map: drawMap, strips: drawStrips, regimes: drawRegimes,
  curves: drawCurves, shape: drawShape, candidates: drawCandidates,
};
const LISTS = { "strips-list": listStrips, "regimes-list": listRegimes };
const OF_DRIVE = ["predictions", "states", "paths", "controls"], OF_RUN = [...OF_DRIVE, "map", "strips", "regimes"];
const stale = new Set();
const near = new IntersectionObserver((entries) => entries.filter((entry) => entry.isIntersecting).forEach((entry) => draw(entry.target.id)), { rootMargin: "300px" });

function draw(id) {
  if (!stale.delete(id)) return;
  try {
    DRAWN[id]();
  } catch (error) {
    element(id).textContent = `This picture could not be drawn: ${error.message}`;
    console.error(id, error);
  }
}

function list(id) {
  const box = element(id);
  if (box.open) box.querySelector(".wide").replaceChildren(LISTS[id]());
}

// What is on the screen is drawn at once, the rest when it comes near.
function redraw(ids) {
  element("run").value = view.run;
  element("drive").value = view.drive;
  element("place").textContent = where();
  const residuals = page.runs[view.run].residuals;
  if (ids.includes("regimes")) {
    view.residual = Math.min(view.residual, residuals.length - 1);
    options("residual", ["the strongest", ...residuals], (value) => { view.residual = value - 1; redraw(["strips"]); });
    element("residual").value = view.residual + 1;
  }
  for (const id of ids.filter((id) => element(id))) {
    stale.add(id);
    near.unobserve(element(id));
    near.observe(element(id));
  }
  Object.keys(LISTS).forEach(list);
}

function worstDrive() {
  if (!page.runs[view.run].strips) return 0;
  const most = strip(view.run, -1).map((strips) => Math.max(...strips.map((z) => Math.abs(z || 0))));
  const shown = page.shown.map((drive) => most[drive]);
  return shown.indexOf(Math.max(...shown));
}

options("run", page.runs.map((run) => run.label), (value) => choose({ run: value }));
options("drive", page.labels, (value) => choose({ drive: value, from: null, to: null }));
options("of", Object.keys(page.curves), (value) => { view.of = Object.keys(page.curves)[value]; redraw(["curves"]); });
element("all-seconds").addEventListener("click", () => choose({ from: null, to: null }));
element("apart").addEventListener("change", () => redraw(["predictions"]));
Object.keys(LISTS).forEach((id) => element(id).addEventListener("toggle", () => list(id)));
window.addEventListener("hashchange", show);
// By hand, because in a notebook's frame a link would leave the page.
document.addEventListener("click", (event) => {
  const link = event.target.closest('a[href^="#"]');
  if (!link || event.ctrlKey || event.metaKey) return;
  event.preventDefault();
  const hash = link.getAttribute("href"), place = element(hash.slice(1));
  if (!place) return void follow(hash);
  location.hash = hash;
  place.scrollIntoView();
  place.focus({ preventScroll: true });
});

// On paper everything is drawn, as wide as the paper, and what is folded is open.
const PAPER = 680; // pixels: A4 and Letter, upright
const drawn = () => [...document.querySelectorAll(".js-plotly-plot")];
window.addEventListener("beforeprint", () => {
  Object.keys(DRAWN).filter(element).forEach(draw);
  drawn().forEach((one) => Plotly.relayout(one, { width: PAPER }));
  document.querySelectorAll("#program details:not([open])").forEach((one) => { one.open = true; one.dataset.shut = ""; });
});
window.addEventListener("afterprint", () => {
  drawn().forEach((one) => Plotly.relayout(one, { width: null, autosize: true }));
  document.querySelectorAll("details[data-shut]").forEach((one) => { one.open = false; delete one.dataset.shut; });
});

view.drive = worstDrive();
redraw(Object.keys(DRAWN));
show();
