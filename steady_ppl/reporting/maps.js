// Where a run fails: strips of time, the drives in the plane, ranges of every variable; each place leads to its seconds.
const DIVERGING = [[0, "#2166ac"], [0.25, "#92c5de"], [0.5, "#f7f7f7"], [0.75, "#f4a582"], [1, "#b2182b"]]; // ColorBrewer RdBu
const MARGIN = 0.5; // s shown around a strip

// What stands out: the sign as a shape, white where the cell is dark.
function marks(x, y, z) {
  const textfont = { size: 13, color: z.map((one) => (Math.abs(one) > 4 ? "white" : "black")) };
  return { x, y, mode: "text", text: z.map((one) => (one > 0 ? "▲" : "▼")), textfont, hoverinfo: "skip", showlegend: false };
}

function heatmap(x, y, z, text, hover) {
  const bar = { title: { text: "sd" }, thickness: 12 };
  return { type: "heatmap", x, y, z, text, zmin: -6, zmax: 6, colorscale: DIVERGING, colorbar: bar, hovertemplate: `${hover}: %{z:.1f} sd<extra></extra>` };
}

function listen(drawn, tell) {
  drawn.removeAllListeners("plotly_click");
  drawn.on("plotly_click", (event) => tell(event.points[0]));
}

// Standard deviations of every drive and strip: of one residual, or the strongest of all.
function strip(run, residual) {
  const strips = page.runs[run].strips, [residuals, drives] = strips.z.shape;
  return Array.from({ length: drives }, (_, drive) => {
    if (residual >= 0) return series(strips.z, residual, drive);
    const all = Array.from({ length: residuals }, (_, one) => series(strips.z, one, drive));
    return all[0].map((_, at) => all.reduce((most, one) => (one[at] !== null && (most === null || Math.abs(one[at]) > Math.abs(most)) ? one[at] : most), null));
  });
}

const standsOut = (strips) => strips.significant.filter(([residual]) => view.residual < 0 || residual === view.residual);
const ofStrip = (strips, drive, at) => [page.shown.indexOf(drive), strips.edges[at] - MARGIN, strips.edges[at + 1] + MARGIN];

function drawMap() {
  const run = page.runs[view.run], strips = run.strips, [across, up] = run.plane.length > 1 ? run.plane : [null, run.plane[0]];
  const middle = (drive, component) => (component === null ? series(page.time, drive, 0) : series(run.posterior.middle, drive, component));
  const horizontal = across === null ? { name: "time", unit: "s" } : run.states[across], z = strips && strip(view.run, -1);
  const traces = page.labels.map((label, drive) => {
    const time = series(page.time, drive, 0);
    const color = time.map((seconds) => {
      if (!strips || seconds === null) return 0;
      return Math.abs(z[page.shown[drive]][Math.max(0, strips.edges.slice(0, -1).findLastIndex((edge) => edge <= seconds))] || 0);
    });
    const chosen = drive === view.drive;
    return {
      x: middle(drive, across), y: middle(drive, up), mode: "lines+markers", line: { color: "#767676", width: chosen ? 2.5 : 0.5 },
      marker: {
        size: color.map((sd) => 2 + Math.min(6, sd)), color: strips ? color : "#767676", cmin: 0, cmax: 6, colorscale: "Cividis", reversescale: true,
        line: { width: chosen ? 1 : 0, color: "black" }, showscale: Boolean(strips) && drive === 0, colorbar: { title: { text: "sd" }, thickness: 12 },
      },
      customdata: time.map((seconds) => [drive, seconds]), text: time.map(() => plain(label)), showlegend: false,
      hovertemplate: "trajectory %{text}, %{customdata[1]:.1f} s: %{marker.color:.1f} sd<extra></extra>",
    };
  });
  const same = across !== null && horizontal.unit === run.states[up].unit;
  return plot("map", traces, {
    xaxis: { title: { text: withUnit(horizontal) }, zeroline: false },
    yaxis: { title: { text: withUnit(run.states[up]) }, zeroline: false, ...(same ? { scaleanchor: "x" } : {}) },
  }, `The trajectories of ${run.label}, coloured by misfit; the list of strips has the same places as links`).then((drawn) => listen(drawn, (point) => {
    const [drive, seconds] = point.customdata;
    go(drive, seconds - 1, seconds + 1);
  }));
}

function drawStrips() {
  const run = page.runs[view.run], strips = run.strips;
  if (!strips) return empty("strips", "The trajectories are too short for strips of time.");
  const z = strip(view.run, view.residual), stars = standsOut(strips), number = strips.drives.map((_, i) => i);
  const middle = strips.edges.slice(1).map((edge, i) => (edge + strips.edges[i]) / 2);
  const names = strips.drives.map((label) => plain(label.length > 16 ? `${label.slice(0, 15)}…` : label));
  const yaxis = { title: { text: "trajectory" }, autorange: "reversed", automargin: true, tickvals: number, ticktext: names };
  element("strips").style.height = `${Math.max(320, 90 + 16 * strips.drives.length)}px`;
  return plot("strips", [
    heatmap(strips.edges, number, z, strips.drives.map((label) => middle.map(() => plain(label))), "trajectory %{text}, %{x:.1f} s"),
    marks(stars.map(([, , at]) => middle[at]), stars.map(([, drive]) => drive), stars.map(([residual, drive, at]) => series(strips.z, residual, drive)[at])),
  ], { xaxis: { title: { text: "time [s]" }, zeroline: false }, yaxis }, `Misfit of ${run.label} of every trajectory and strip of time; the list below has the same places as links`)
    .then((drawn) => listen(drawn, (point) => point.pointIndex && go(...ofStrip(strips, ...point.pointIndex))));
}

function drawRegimes() {
  const run = page.runs[view.run], columns = run.regimes.columns, position = columns.map((_, i) => i);
  if (!columns.length) return empty("regimes", "The trajectories have too few rows for ranges.");
  const cells = run.residuals.map((_, residual) => columns.map((_, column) => run.regimes.cells.find(([r, c]) => r === residual && c === column)));
  const stars = run.regimes.cells.filter(([, , , significant]) => significant);
  const first = (i) => i === 0 || columns[i].variable !== columns[i - 1].variable, starts = position.filter(first);
  const ticks = starts.map((start, i) => ({ at: (start + (starts[i + 1] || columns.length) - 1) / 2, name: plain(columns[start].variable) }));
  element("regimes").style.height = `${160 + 28 * run.residuals.length}px`;
  return plot("regimes", [
    heatmap(position, run.residuals.map(plain), cells.map((row) => row.map((cell) => (cell ? cell[2] : null))), cells.map((row) => row.map((_, c) => plain(columns[c].where))),
      "%{y} %{text}"),
    marks(stars.map(([, column]) => column), stars.map(([residual]) => plain(run.residuals[residual])), stars.map(([, , z]) => z)),
  ], {
    margin: { l: 140, r: 15, t: 35, b: 90 }, yaxis: { autorange: "reversed", type: "category" },
    xaxis: { tickvals: ticks.map((tick) => tick.at), ticktext: ticks.map((tick) => tick.name), tickangle: -35, zeroline: false, range: [-0.5, columns.length - 0.5] },
    shapes: starts.slice(1).map((start) => ({ type: "line", xref: "x", yref: "paper", x0: start - 0.5, x1: start - 0.5, y0: 0, y1: 1, line: { width: 1, color: "white" } })),
  }, `Misfit of ${run.label} over ranges of every variable; the list below has the same places as links`).then((drawn) => listen(drawn, (point) => {
    const cell = Array.isArray(point.pointIndex) && cells[point.pointIndex[0]][point.pointIndex[1]];
    if (cell && cell[4]) goTo(cell[4]);
  }));
}

// The maps again as tables of links, for the keyboard and for those who hear the page.
function tableOf(head, rows) {
  const table = document.createElement("table"), top = table.createTHead().insertRow(), body = table.createTBody();
  const add = (row, tag, scope, content) => {
    const cell = document.createElement(tag);
    if (scope) cell.scope = scope;
    cell.append(content);
    row.append(cell);
  };
  head.forEach((text) => add(top, "th", "col", text));
  for (const [first, ...rest] of rows) {
    const row = body.insertRow();
    add(row, "th", "row", first);
    rest.forEach((text) => add(row, "td", null, text));
  }
  return table;
}

function linked(z, stands, place) {
  if (z === null || z === undefined) return "–";
  const text = `${z > 0 ? "+" : "−"}${Math.abs(z).toFixed(1)}${stands ? " !" : ""}`;
  if (!place || place[0] < 0) return text;
  const link = document.createElement("a"), [drive, from, to] = place;
  Object.assign(link, { href: address({ run: view.run, drive, from: Math.max(0, from), to }), textContent: text });
  return link;
}

function listStrips() {
  const strips = page.runs[view.run].strips;
  if (!strips) return "The trajectories are too short for strips of time.";
  const z = strip(view.run, view.residual), out = new Set(standsOut(strips).map(([, drive, at]) => `${drive} ${at}`));
  const head = strips.edges.slice(1).map((edge, i) => `${strips.edges[i].toFixed(1)} to ${edge.toFixed(1)} s`);
  return tableOf(["trajectory", ...head], strips.drives.map((label, d) =>
    [label, ...z[d].map((one, at) => linked(one, out.has(`${d} ${at}`), ofStrip(strips, d, at)))]));
}

function listRegimes() {
  const run = page.runs[view.run], cells = new Map(run.regimes.cells.map((cell) => [`${cell[0]} ${cell[1]}`, cell]));
  return tableOf(["range", ...run.residuals], run.regimes.columns.map((column, c) => [column.where, ...run.residuals.map((_, r) => {
    const cell = cells.get(`${r} ${c}`);
    return cell ? linked(cell[2], cell[3], cell[4] && [page.shown.indexOf(cell[4][0]), cell[4][1], cell[4][2]]) : "–";
  })]));
}
