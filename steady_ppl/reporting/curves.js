// Curves over the time or over the time ahead, and the coefficients of the candidates.
const TICKS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100];
const where = () => `${page.runs[view.run].label}, trajectory ${page.labels[view.drive]}, ${secondsShown()}`;
const secondsShown = () => (view.from === null ? "all seconds" : `${view.from.toFixed(1)} to ${view.to.toFixed(1)} s`);

// Components below one another over the same seconds; each axis fits what is in them.
function stacked(id, components, tracesOf, said) {
  const traces = [], gap = 0.04, count = components.length, height = (1 - gap * (count - 1)) / count;
  const seconds = series(page.time, view.drive, 0).filter((second) => second !== null);
  const range = view.from === null ? [seconds[0], seconds[seconds.length - 1]] : [view.from, view.to];
  const shape = { xaxis: { title: { text: "time [s]" }, anchor: `y${count > 1 ? count : ""}`, zeroline: false, range } };
  components.forEach((one, index) => {
    const axis = index ? `y${index + 1}` : "y", bottom = 1 - (index + 1) * height - index * gap, inside = [];
    for (const trace of tracesOf(index)) {
      traces.push(Object.assign(trace, { yaxis: axis, showlegend: index === 0 && trace.showlegend !== false }));
      trace.y.forEach((y, i) => { if (y !== null && trace.x[i] >= range[0] && trace.x[i] <= range[1]) inside.push(y); });
    }
    const [least, most] = [inside.reduce((a, b) => Math.min(a, b), Infinity), inside.reduce((a, b) => Math.max(a, b), -Infinity)];
    const margin = 0.06 * (most - least) || 0.1;
    shape[index ? `yaxis${index + 1}` : "yaxis"] = {
      title: { text: withUnit(one), font: { size: 11 } }, domain: [Math.max(0, bottom), bottom + height], zeroline: false,
      ...(least <= most ? { range: [least - margin, most + margin] } : {}),
    };
  });
  element(id).style.height = `${Math.max(220, 60 + 130 * count)}px`;
  return plot(id, traces, shape, `${said}: ${where()}`);
}

// The rows that were measured, with a break wherever three of them, as they usually come, are missing.
function joined(time, middle, half) {
  const rows = time.map((_, i) => i).filter((i) => half[i] !== null), found = [[], [], []];
  const apart = rows.slice(1).map((row, i) => time[row] - time[rows[i]]).sort((a, b) => a - b);
  const usual = apart[Math.floor(apart.length / 2)];
  rows.forEach((row, i) => {
    if (i && time[row] - time[rows[i - 1]] > 3.5 * usual) found.forEach((values, k) => values.push(k ? null : time[row]));
    [time, middle, half].forEach((values, k) => found[k].push(values[row]));
  });
  return found;
}

function drawPredictions() {
  const run = page.runs[view.run], time = series(page.time, view.drive, 0), apart = element("apart").checked;
  return stacked("predictions", run.measurements, (k) => {
    const measured = series(run.measured, view.drive, k), near = series(run.predictions[0].middle, view.drive, k);
    const less = (values) => values.map((value, i) => (!apart ? value : value === null || near[i] === null ? null : value - near[i]));
    const traces = run.predictions.flatMap((one, index) => {
      const [at, middle, half] = joined(time, less(series(one.middle, view.drive, k)), series(one.half, view.drive, k));
      const edge = (sign) => middle.map((value, i) => (value === null ? null : value + sign * half[i]));
      const name = `${one.ahead} ahead`;
      return [band(at, edge(-1), edge(1), COLORS[index], name), line(at, middle, COLORS[index], name, DASHES[index])];
    });
    const marker = { color: "black", size: view.from === null ? 3 : 5, opacity: 0.7 };
    return [...traces, { x: time, y: less(measured), mode: "markers", marker, name: "measured" }];
  }, "Measured and predicted over time");
}

function drawStates() {
  const run = page.runs[view.run], time = series(page.time, view.drive, 0);
  return stacked("states", run.states, (k) => {
    const [low, middle, high] = ["low", "middle", "high"].map((name) => series(run.posterior[name], view.drive, k));
    const traces = [band(time, low, high, COLORS[0], "posterior"), line(time, middle, COLORS[0], "posterior", "solid")];
    return run.truth ? [...traces, line(time, series(run.truth, view.drive, k), "black", "truth", "dash")] : traces;
  }, "Posterior of the states over time");
}

// Draws of the chosen drive in the plane: how much is known of where it went.
function drawPaths() {
  const run = page.runs[view.run], [across, up] = run.plane, traces = [];
  if (up === undefined) return empty("paths", "One state alone has no plane.");
  const time = series(page.time, view.drive, 0);
  const inside = (values) => values.map((value, i) => (view.from === null || (time[i] >= view.from && time[i] <= view.to) ? value : null));
  for (let draw = 0; draw < run.paths.shape[1] / 2; draw += 1) {
    const [x, y] = [0, 1].map((axis) => inside(series(run.paths, view.drive, 2 * draw + axis)));
    traces.push({ ...line(x, y, COLORS[0], "posterior draws", "solid"), opacity: 0.35, showlegend: draw === 0 });
  }
  if (run.truth) {
    const [x, y] = [across, up].map((k) => inside(series(run.truth, view.drive, k)));
    traces.push(line(x, y, "black", "truth", "dash"));
  }
  const same = run.states[across].unit === run.states[up].unit;
  return plot("paths", traces, {
    xaxis: { title: { text: withUnit(run.states[across]) }, zeroline: false },
    yaxis: { title: { text: withUnit(run.states[up]) }, zeroline: false, ...(same ? { scaleanchor: "x" } : {}) },
  }, `Posterior draws of the path: ${where()}`);
}

function drawControls() {
  const time = series(page.time, view.drive, 0);
  return stacked("controls", page.controlNames, (k) => {
    const trace = line(time, series(page.controls, view.drive, k), COLORS[2], "command", "solid");
    return [Object.assign(trace, { showlegend: false, line: { color: COLORS[2], shape: "hv" } })];
  }, "Commands over time");
}

function drawCurves() {
  if (view.of === null) return null;
  const traces = Object.entries(page.curves[view.of]).map(([name, pairs], index) => ({
    x: pairs.map(([seconds]) => seconds), y: pairs.map(([, error]) => error), mode: "lines+markers", name: plain(name), marker: { symbol: index, size: 7 },
    line: { color: COLORS[index % COLORS.length], dash: DASHES[index % DASHES.length] },
  }));
  return plot("curves", traces, {
    xaxis: { type: "log", title: { text: "predicted ahead [s]" }, tickvals: TICKS }, yaxis: { type: "log", title: { text: `error, ${plain(view.of)}` } },
  }, `Errors of ${view.of} against the time ahead; the table above has the figures`);
}

function drawShape() {
  const s = page.discovery.shape, edge = (sign) => s.curve.map((value, i) => value + sign * s.band[i]);
  return plot("shape", [band(s.points, edge(-1), edge(1), COLORS[0], "curve"), line(s.points, s.curve, COLORS[0], "curve", "solid")], {
    showlegend: false, xaxis: { title: { text: withUnit({ name: s.variable, unit: s.variable_unit }) } },
    yaxis: { title: { text: withUnit({ name: s.channel, unit: s.unit }) } },
  }, `What ${s.channel} lacks over ${s.variable}`);
}

const MOST = 30;
// Candidates with a detection limit, in units of it: what was found first, then the largest.
function candidateRows() {
  const found = page.discovery, listed = (value) => (Array.isArray(value) ? value : [value]);
  const rows = found.candidates.flatMap((one) => {
    const own = found.effects.find((effect) => effect.effect === one.effect), limits = listed(one.detection_limit), values = listed(one.coefficient);
    return values.map((value, i) => {
      const limit = limits[i], sd = one.sd === null ? null : listed(one.sd)[i];
      if (!limit || sd === null || one.absent === null) return null;
      const [low, high] = own ? own.interval_90[i] : [value - 1.645 * sd, value + 1.645 * sd], middle = own ? own.coefficient[i] : value;
      const name = plain(values.length > 1 ? `${one.effect} ${i + 1}` : one.effect);
      return { name, value: (middle - one.absent) / limit, minus: (middle - low) / limit, plus: (high - middle) / limit, own: Boolean(own) };
    }).filter(Boolean);
  });
  return rows.sort((a, b) => Number(b.own) - Number(a.own) || Math.abs(b.value) - Math.abs(a.value)).slice(0, MOST);
}

function drawCandidates() {
  const rows = candidateRows(), narrow = element("candidates").clientWidth < 500;
  const trace = (own, name, color, symbol) => {
    const some = rows.filter((row) => row.own === own);
    return {
      x: some.map((row) => row.value), y: some.map((row) => (narrow ? row.name.replace(":", ":<br>") : row.name)), mode: "markers", name,
      marker: { color, symbol, size: 8 },
      error_x: { type: "data", symmetric: false, array: some.map((row) => row.plus), arrayminus: some.map((row) => row.minus), color },
    };
  };
  element("candidates").style.height = `${140 + (narrow ? 28 : 20) * rows.length}px`;
  return plot("candidates", [trace(true, "found", COLORS[1], "diamond"), trace(false, "each alone", COLORS[0], "circle")], {
    margin: { l: narrow ? 125 : 190, r: 15, t: 30, b: 45 }, yaxis: { autorange: "reversed", type: "category" },
    xaxis: { title: { text: narrow ? "in detection limits" : "coefficient / detection limit" } },
    shapes: [{ type: "rect", xref: "x", yref: "paper", x0: -1, x1: 1, y0: 0, y1: 1, fillcolor: "#999999", opacity: 0.15, line: { width: 0 } }],
  }, "Coefficients of the candidates in units of their detection limits; the table below has the figures");
}
