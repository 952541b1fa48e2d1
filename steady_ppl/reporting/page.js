"use strict";
// What the page holds, and the pens that everything is drawn with.
const page = JSON.parse(document.getElementById("data").textContent);
const view = { run: page.runs.length - 1, drive: 0, from: null, to: null, residual: -1, of: Object.keys(page.curves)[0] || null };
const COLORS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b07800", "#2a80b9", "#000000"]; // after Okabe and Ito, darker where pale on white
const DASHES = ["solid", "dash", "dot", "dashdot", "longdash", "longdashdot", "solid"];
// No tools: eight buttons a plot would be 64 stops of the tab key, and one of them offers to upload the drives.
const config = { responsive: true, displayModeBar: false };
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

// The last axis of an array of three, for example the rows of (drives, components, rows).
function series(packed, first, second) {
  const [, seconds, thirds] = packed.shape;
  const start = (first * seconds + second) * thirds;
  return unpack(packed).slice(start, start + thirds);
}

function layout(more) {
  const base = {
    margin: { l: 70, r: 15, t: 35, b: 45 }, font: { size: 12 }, hovermode: "closest",
    legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 }, paper_bgcolor: "white", plot_bgcolor: "white",
  };
  return Object.assign(base, more);
}

function line(x, y, color, name, dash) {
  return { x, y, mode: "lines", line: { color, width: 1.5, dash }, name, legendgroup: name };
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
  const look = { line: { width: 0.5, color }, fill: "toself", fillcolor: `${color}33`, hoverinfo: "skip" };
  return { x, y, mode: "lines", ...look, legendgroup: name, showlegend: false };
}

// A plot and its name, for those who hear the page.
function plot(id, traces, shape, said) {
  element(id).setAttribute("aria-label", said);
  return Plotly.react(id, traces, layout(shape), config);
}

function empty(id, text) {
  Plotly.purge(id);
  element(id).textContent = text;
  element(id).style.height = "auto";
}
