"use strict";
const page = JSON.parse(document.getElementById("data").textContent);
const view = { run: page.runs.length - 1, drive: 0, from: null, to: null, residual: -1, of: null };
const COLORS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000"]; // Okabe and Ito
const DASHES = ["solid", "dash", "dot", "dashdot", "longdash", "longdashdot", "solid"];
const STAR = "★";
const DIVERGING = [[0, "#2166ac"], [0.25, "#92c5de"], [0.5, "#f7f7f7"], [0.75, "#f4a582"], [1, "#b2182b"]]; // ColorBrewer RdBu
const wideEnough = window.matchMedia("(min-width: 48rem)").matches; // on a phone the tools would cover the legend
const config = { responsive: true, displaylogo: false, displayModeBar: wideEnough, modeBarButtonsToRemove: ["select2d", "lasso2d"] };
const element = (id) => document.getElementById(id);
const plain = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;"); // plotly reads tags
const withUnit = (one) => plain(one.unit ? `${one.name} [${one.unit}]` : one.name);

function unpack(packed) {
  if (!packed.values) {
    const bytes = Uint8Array.from(atob(packed.data), (letter) => letter.charCodeAt(0));
    const codes = new DataView(bytes.buffer);
    packed.values = Array.from({ length: bytes.length / 2 }, (_, i) => {
      const code = codes.getInt16(2 * i, true);
      return code === -32768 ? null : packed.low + packed.step * (code + 32767);
    });
  }
  return packed.values;
}

// A row of an array of shape (drives, components, rows).
function series(packed, drive, component) {
  const [, components, rows] = packed.shape;
  const start = (drive * components + component) * rows;
  return unpack(packed).slice(start, start + rows);
}

function layout(more) {
  const base = {
    margin: { l: 70, r: 15, t: 35, b: 45 }, font: { size: 12 }, hovermode: "closest",
    legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 }, paper_bgcolor: "white", plot_bgcolor: "white",
  };
  return Object.assign(base, more);
}

// Components below one another over the same seconds.
function stacked(id, components, tracesOf) {
  const traces = [], gap = 0.04, count = components.length, height = (1 - gap * (count - 1)) / count;
  const shape = { xaxis: { title: { text: "time [s]" }, anchor: `y${count > 1 ? count : ""}`, zeroline: false } };
  if (view.from !== null) Object.assign(shape.xaxis, { range: [view.from, view.to] });
  components.forEach((one, index) => {
    const axis = index ? `y${index + 1}` : "y", bottom = 1 - (index + 1) * height - index * gap;
    shape[index ? `yaxis${index + 1}` : "yaxis"] = {
      title: { text: withUnit(one), font: { size: 11 } }, domain: [Math.max(0, bottom), bottom + height], zeroline: false,
    };
    for (const trace of tracesOf(index)) {
      traces.push(Object.assign(trace, { yaxis: axis, showlegend: index === 0 && trace.showlegend !== false }));
    }
  });
  element(id).style.height = `${Math.max(220, 60 + 130 * count)}px`;
  return Plotly.react(id, traces, layout(shape), config);
}

// One polygon for every stretch without a gap.
function band(time, low, high, color, name) {
  const x = [], y = [], there = time.map((_, i) => low[i] !== null && high[i] !== null);
  for (let start = 0; start < time.length; start += 1) {
    if (!there[start]) continue;
    let end = start;
    while (end + 1 < time.length && there[end + 1]) end += 1;
    x.push(...time.slice(start, end + 1), ...time.slice(start, end + 1).reverse(), null);
    y.push(...high.slice(start, end + 1), ...low.slice(start, end + 1).reverse(), null);
    start = end;
  }
  return { x, y, mode: "lines", line: { width: 0 }, fill: "toself", fillcolor: color + "33", hoverinfo: "skip", legendgroup: name, showlegend: false };
}

function line(time, y, color, name, dash) {
  return { x: time, y, mode: "lines", line: { color, width: 1.5, dash }, name, legendgroup: name };
}

function drawPredictions() {
  const run = page.runs[view.run], time = series(page.time, view.drive, 0);
  return stacked("predictions", page.measurements, (k) => {
    const traces = run.predictions.flatMap((one, index) => {
      const middle = series(one.middle, view.drive, k), half = series(one.half, view.drive, k);
      const edge = (sign) => middle.map((value, i) => (value === null ? null : value + sign * half[i]));
      const name = `${one.ahead} ahead`;
      return [band(time, edge(-1), edge(1), COLORS[index], name), line(time, middle, COLORS[index], name, DASHES[index])];
    });
    const marker = { color: "black", size: 4 };
    return [...traces, { x: time, y: series(page.measured, view.drive, k), mode: "markers", marker, name: "measured" }];
  });
}

function drawStates() {
  const run = page.runs[view.run], time = series(page.time, view.drive, 0);
  return stacked("states", run.states, (k) => {
    const [low, middle, high] = ["low", "middle", "high"].map((name) => series(run.posterior[name], view.drive, k));
    const traces = [band(time, low, high, COLORS[0], "posterior"), line(time, middle, COLORS[0], "posterior", "solid")];
    const truth = page.truth && k < page.truth.shape[1];
    return truth ? [...traces, line(time, series(page.truth, view.drive, k), "black", "truth", "dash")] : traces;
  });
}

function drawControls() {
  const time = series(page.time, view.drive, 0);
  return stacked("controls", page.controlNames, (k) => {
    const trace = line(time, series(page.controls, view.drive, k), COLORS[2], "command", "solid");
    return [Object.assign(trace, { showlegend: false, line: { color: COLORS[2], shape: "hv" } })];
  });
}

// The strongest standard deviations of every strip, or those of one residual.
function strip(run, residual) {
  const strips = page.runs[run].strips;
  if (residual >= 0) return strips.z[residual];
  return strips.drives.map((_, drive) => strips.edges.slice(1).map((_, at) => {
    const all = strips.z.map((one) => one[drive][at]).filter((z) => z !== null);
    return all.length ? all.reduce((most, z) => (Math.abs(z) > Math.abs(most) ? z : most)) : null;
  }));
}

function drawMap() {
  const run = page.runs[view.run], [across, up] = run.plane, strips = run.strips;
  const z = strips && strip(view.run, -1);
  const traces = page.labels.map((label, drive) => {
    const time = series(page.time, drive, 0), number = strips ? strips.drives.indexOf(label) : -1;
    const color = time.map((seconds) => {
      if (!strips || seconds === null) return 0;
      const at = Math.min(strips.edges.length - 2, Math.max(0, strips.edges.findIndex((edge) => edge > seconds) - 1));
      return Math.abs(z[number][at] || 0);
    });
    return {
      x: series(run.posterior.middle, drive, across), y: series(run.posterior.middle, drive, up), mode: "markers",
      marker: { size: drive === view.drive ? 6 : 4, color, cmin: 0, cmax: 6, colorscale: "Cividis", reversescale: true, showscale: drive === 0,
        colorbar: { title: { text: "sd" }, thickness: 12 } },
      customdata: time.map((seconds) => [drive, seconds]), showlegend: false,
      hovertemplate: `drive ${plain(label)}, %{customdata[1]:.1f} s: %{marker.color:.1f} sd<extra></extra>`,
    };
  });
  const same = run.states[across].unit === run.states[up].unit;
  return Plotly.react("map", traces, layout({
    xaxis: { title: { text: withUnit(run.states[across]) }, zeroline: false },
    yaxis: { title: { text: withUnit(run.states[up]) }, zeroline: false, ...(same ? { scaleanchor: "x" } : {}) },
  }), config).then((plot) => listen(plot, (point) => {
    const [drive, seconds] = point.customdata;
    go(drive, seconds - 1, seconds + 1);
  }));
}

function drawStrips() {
  const strips = page.runs[view.run].strips;
  if (!strips) return void (element("strips").textContent = "The drives are too short for strips of time.");
  const shape = { xaxis: { title: { text: "time [s]" }, zeroline: false }, yaxis: { title: { text: "drive" }, type: "category", autorange: "reversed" } };
  const middle = strips.edges.slice(1).map((edge, i) => (edge + strips.edges[i]) / 2);
  const stars = strips.significant.filter(([residual]) => view.residual < 0 || residual === view.residual);
  element("strips").style.height = `${Math.max(320, 90 + 16 * strips.drives.length)}px`;
  return Plotly.react("strips", [
    { type: "heatmap", x: strips.edges, y: strips.drives, z: strip(view.run, view.residual), zmin: -6, zmax: 6, colorscale: DIVERGING,
      colorbar: { title: { text: "sd" }, thickness: 12 }, hovertemplate: "drive %{y}, %{x:.1f} s: %{z:.1f} sd<extra></extra>" },
    { x: stars.map(([, , at]) => middle[at]), y: stars.map(([, drive]) => strips.drives[drive]), mode: "text", text: stars.map(() => STAR),
      hoverinfo: "skip", showlegend: false },
  ], layout(shape), config).then((plot) => listen(plot, (point) => {
    const at = point.pointIndex ? point.pointIndex[1] : middle.indexOf(point.x);
    go(page.labels.indexOf(String(point.y)), strips.edges[at] - 0.5, strips.edges[at + 1] + 0.5);
  }));
}

function drawRegimes() {
  const run = page.runs[view.run], columns = [];
  for (const one of run.regimes) {
    const ranges = [...new Set(one.cells.map((cell) => cell.between.join()))];
    ranges.forEach((between, number) => columns.push({ one, between, number, of: ranges.length }));
  }
  const cells = run.residuals.map((_, residual) => columns.map(({ one, between }) =>
    one.cells.find((cell) => cell.residual === residual && cell.between.join() === between)));
  const position = columns.map((_, i) => i);
  const starred = cells.flatMap((row, r) => row.map((cell, c) => (cell && cell.significant ? [r, c] : null)).filter(Boolean));
  const ticks = columns.map((column, i) => (column.number === Math.floor((column.of - 1) / 2) ? i : -1)).filter((i) => i >= 0);
  const edges = columns.map((column, i) => (column.number === 0 && i ? i - 0.5 : null)).filter((x) => x !== null);
  element("regimes").style.height = `${160 + 28 * run.residuals.length}px`;
  return Plotly.react("regimes", [
    { type: "heatmap", x: position, y: run.residuals.map(plain), z: cells.map((row) => row.map((cell) => (cell ? cell.z : null))), zmin: -6, zmax: 6,
      colorscale: DIVERGING, colorbar: { title: { text: "sd" }, thickness: 12 },
      text: cells.map((row) => row.map((cell) => (cell ? plain(cell.where) : ""))), hovertemplate: "%{y} %{text}: %{z:.1f} sd<extra></extra>" },
    { x: starred.map(([, c]) => c), y: starred.map(([r]) => plain(run.residuals[r])), mode: "text", text: starred.map(() => STAR), hoverinfo: "skip",
      showlegend: false },
  ], layout({
    margin: { l: 140, r: 15, t: 35, b: 90 }, yaxis: { autorange: "reversed", type: "category" },
    xaxis: { tickvals: ticks, ticktext: ticks.map((i) => plain(columns[i].one.variable)), tickangle: -35, zeroline: false },
    shapes: edges.map((x) => ({ type: "line", xref: "x", yref: "paper", x0: x, x1: x, y0: 0, y1: 1, line: { width: 1, color: "white" } })),
  }), config).then((plot) => listen(plot, (point) => {
    const cell = Array.isArray(point.pointIndex) && cells[point.pointIndex[0]][point.pointIndex[1]];
    if (cell && cell.place) goTo(cell.place);
  }));
}

function drawCurves() {
  const names = Object.keys(page.curves);
  if (!names.length) return;
  const rows = Object.entries(page.curves[view.of]);
  const traces = rows.map(([name, pairs], index) => ({
    x: pairs.map(([seconds]) => seconds), y: pairs.map(([, error]) => error), mode: "lines+markers", name: plain(name), marker: { symbol: index, size: 7 },
    line: { color: COLORS[index % COLORS.length], dash: DASHES[index % DASHES.length] },
  }));
  return Plotly.react("curves", traces, layout({
    xaxis: { type: "log", title: { text: "predicted ahead [s]" } }, yaxis: { type: "log", title: { text: plain(view.of) } },
  }), config);
}

function drawDiscovery() {
  const found = page.discovery;
  if (!found) return;
  if (found.shape) {
    const s = found.shape, edge = (sign) => s.curve.map((value, i) => value + sign * s.band[i]);
    Plotly.react("shape", [band(s.points, edge(-1), edge(1), COLORS[0], "curve"), line(s.points, s.curve, COLORS[0], "curve", "solid")], layout({
      showlegend: false, xaxis: { title: { text: withUnit({ name: s.variable, unit: s.variable_unit }) } },
      yaxis: { title: { text: withUnit({ name: s.channel, unit: s.unit }) } },
    }), config);
  }
  const listed = (value) => (Array.isArray(value) ? value : [value]);
  const rows = found.candidates.flatMap((one) => {
    const own = found.effects.find((effect) => effect.effect === one.effect), limits = listed(one.detection_limit);
    return listed(one.coefficient).map((value, i) => {
      const limit = limits[i], sd = one.sd === null ? null : listed(one.sd)[i];
      if (!limit || sd === null || one.absent === null) return null;
      const middle = (own ? own.coefficient[i] : value) - one.absent, [low, high] = (own ? own.interval_90[i] : [value - 1.645 * sd, value + 1.645 * sd]).map((end) => end - one.absent);
      return { name: plain(one.effect), value: middle / limit, minus: (middle - low) / limit, plus: (high - middle) / limit, own: Boolean(own) };
    }).filter(Boolean);
  });
  rows.sort((a, b) => Number(b.own) - Number(a.own) || Math.abs(b.value) - Math.abs(a.value));
  const trace = (own, name, color, symbol) => {
    const some = rows.slice(0, 30).filter((row) => row.own === own);
    return {
      x: some.map((row) => row.value), y: some.map((row) => row.name), mode: "markers", name, marker: { color, symbol, size: 8 },
      error_x: { type: "data", symmetric: false, array: some.map((row) => row.plus), arrayminus: some.map((row) => row.minus), color },
    };
  };
  element("candidates").style.height = `${140 + 20 * Math.min(30, rows.length)}px`;
  return Plotly.react("candidates", [trace(true, "found", COLORS[1], "diamond"), trace(false, "one step", COLORS[0], "circle")], layout({
    margin: { l: 190, r: 15, t: 30, b: 45 }, yaxis: { autorange: "reversed", type: "category" },
    xaxis: { title: { text: "coefficient / detection limit" } },
    shapes: [{ type: "rect", xref: "x", yref: "paper", x0: -1, x1: 1, y0: 0, y1: 1, fillcolor: "#999999", opacity: 0.15, line: { width: 0 } }],
  }), config);
}

function listen(plot, tell) {
  plot.removeAllListeners("plotly_click");
  plot.on("plotly_click", (event) => tell(event.points[0]));
}

// Places are addresses: they can be linked to, kept and gone back from.
function go(drive, from, to) {
  if (drive < 0) return void (element("place").textContent = "This drive is not among those that are shown row by row.");
  location.hash = `run=${view.run}&drive=${drive}&from=${Math.max(0, from).toFixed(2)}&to=${to.toFixed(2)}`;
}

function goTo([drive, from, to]) {
  const strips = page.runs[view.run].strips;
  go(strips ? page.labels.indexOf(strips.drives[drive]) : drive, from, to);
}

function read() {
  const asked = new URLSearchParams(location.hash.slice(1));
  if (!asked.has("drive")) return false;
  const whole = (name, most) => Math.min(most, Math.max(0, Number.parseInt(asked.get(name), 10) || 0));
  view.run = whole("run", page.runs.length - 1);
  view.drive = whole("drive", page.labels.length - 1);
  const [from, to] = ["from", "to"].map((name) => Number.parseFloat(asked.get(name)));
  [view.from, view.to] = Number.isFinite(from) && to > from ? [from, to] : [null, null];
  return true;
}

function options(id, names, change) {
  const select = element(id);
  if (!select) return;
  names.forEach((name, index) => select.add(new Option(name, index)));
  select.addEventListener("change", () => change(Number(select.value)));
}

const DRAWN = {
  predictions: drawPredictions, states: drawStates, controls: drawControls, map: drawMap, strips: drawStrips, regimes: drawRegimes, curves: drawCurves,
  candidates: drawDiscovery,
};
const stale = new Set();
const near = new IntersectionObserver((entries) => entries.filter((entry) => entry.isIntersecting).forEach((entry) => draw(entry.target.id)), { rootMargin: "300px" });

function draw(id) {
  if (stale.delete(id)) DRAWN[id]();
}

// What is on the screen is drawn at once, the rest when it comes near.
function redraw(ids) {
  element("run").value = view.run;
  element("drive").value = view.drive;
  const seconds = view.from === null ? "all seconds" : `${view.from.toFixed(1)} to ${view.to.toFixed(1)} s`;
  element("place").textContent = `drive ${page.labels[view.drive]}, ${seconds}`;
  for (const id of ids.filter((id) => element(id))) {
    stale.add(id);
    near.unobserve(element(id));
    near.observe(element(id));
  }
}

const OF_DRIVE = ["predictions", "states", "controls"], OF_RUN = [...OF_DRIVE, "map", "strips", "regimes"];
options("run", page.runs.map((run) => run.label), (value) => { view.run = value; redraw(OF_RUN); });
options("drive", page.labels, (value) => { Object.assign(view, { drive: value, from: null, to: null }); redraw(OF_DRIVE); });
options("residual", ["the strongest", ...page.runs[view.run].residuals], (value) => { view.residual = value - 1; redraw(["strips"]); });
view.of = Object.keys(page.curves)[0] || null;
options("of", Object.keys(page.curves), (value) => { view.of = Object.keys(page.curves)[value]; redraw(["curves"]); });
element("all-seconds").addEventListener("click", () => { Object.assign(view, { from: null, to: null }); redraw(OF_DRIVE); });
window.addEventListener("hashchange", () => { if (read()) { redraw(OF_RUN); element("drives").scrollIntoView(); } });
window.addEventListener("beforeprint", () => Object.keys(DRAWN).forEach(draw));
function worstDrive() {
  if (!page.runs[view.run].strips) return 0;
  const most = strip(view.run, -1).map((strips) => Math.max(...strips.map((z) => Math.abs(z || 0))));
  const shown = page.labels.map((label) => most[page.runs[view.run].strips.drives.indexOf(label)]);
  return shown.indexOf(Math.max(...shown));
}

view.drive = worstDrive();
const asked = read();
redraw(Object.keys(DRAWN));
if (asked) element("drives").scrollIntoView();
