"use strict";

// A click on a column header sorts the rows by that column; a second click reverses the order.
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => sortBy(button.parentElement));
}

function sortBy(head) {
  const sign = head.ariaSort === "ascending" ? -1 : 1;
  for (const other of head.parentElement.children) other.removeAttribute("aria-sort");
  head.ariaSort = sign > 0 ? "ascending" : "descending";
  const body = head.closest("table").tBodies[0];
  const rows = [...body.rows];
  rows.sort((a, b) => sign * compare(a.cells[head.cellIndex], b.cells[head.cellIndex]));
  body.append(...rows);
}

// Numbers are ordered by value and come before texts; texts are ordered alphabetically.
function compare(a, b) {
  const [x, y] = [a, b].map((cell) => Number(cell.dataset.value ?? NaN));
  if (!isNaN(x) && !isNaN(y)) return x - y;
  if (isNaN(x) && isNaN(y)) return a.textContent.localeCompare(b.textContent, "en", { numeric: true });
  return isNaN(x) ? 1 : -1;
}

// A button copies the command before it; where that is not permitted, the command is selected.
for (const button of document.querySelectorAll("button.copy")) {
  button.addEventListener("click", async () => {
    const command = button.previousElementSibling;
    getSelection().selectAllChildren(command);
    try {
      await navigator.clipboard.writeText(command.textContent);
      button.textContent = "Copied";
    } catch {
      button.textContent = "Selected";
    }
  });
}

// A chart is drawn when it comes close to the window, and redrawn when the window's size or colours change.
const NARROWEST_PANEL = 260;
const LETTER_PX = 7;
const TICK_PX = 42;
const dark = matchMedia("(prefers-color-scheme: dark)");
const drawn = new Map();

const near = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) if (isIntersecting) draw(target);
}, { rootMargin: "600px" });
const sized = new ResizeObserver((entries) => {
  for (const { target } of entries) if (drawn.has(target) && drawn.get(target) !== target.clientWidth) draw(target);
});
for (const place of document.querySelectorAll(".plot")) {
  place.style.height = `${layoutOf(place).height}px`;
  near.observe(place);
  sized.observe(place);
}
dark.addEventListener("change", () => [...drawn.keys()].forEach(draw));
addEventListener("beforeprint", () => document.querySelectorAll(".plot").forEach((place) => place.clientWidth && draw(place)));

function draw(place) {
  near.unobserve(place);
  drawn.set(place, place.clientWidth);
  const { layout, height } = layoutOf(place);
  const chart = chartOf(place);
  const bands = chart.panels.flatMap((panel, index) =>
    panel.bands.flatMap((band) => bandTraces(band, chart.colours[band.label], index)));
  const lines = chart.panels.flatMap((panel, index) => {
    const paths = panel.plane ? panel.series.filter((series) => series.style === "line" && !series.reference) : [];
    return panel.series.map((series) => lineTrace(series, chart.colours[series.label], index, paths.length - paths.indexOf(series)));
  });
  const named = new Set();
  for (const trace of [...lines, ...bands.filter((trace) => trace.fill)]) {
    trace.showlegend = !named.has(trace.legendgroup);
    named.add(trace.legendgroup);
  }
  place.style.height = `${height}px`;
  // the toolbar appears only while a mouse hovers over the chart
  const hovers = matchMedia("(hover: hover)").matches && !matchMedia("print").matches;
  const options = { displaylogo: false, showTips: false, displayModeBar: hovers ? "hover" : false, scrollZoom: false, modeBarButtonsToRemove: ["select2d", "lasso2d"] };
  Plotly.react(place, [...bands, ...lines], layout, options);
}

function chartOf(place) {
  return JSON.parse(place.nextElementSibling.textContent);
}

function axesOf(index) {
  const number = index ? index + 1 : "";
  return { xaxis: `x${number}`, yaxis: `y${number}` };
}

// Traces with the same label have one legend entry and are hidden together.
const MODES = { "line+markers": "lines+markers", markers: "markers", dots: "markers", triangles: "markers", outside: "markers" };
const MARKERS = {
  dots: { size: 2, opacity: 0.5 }, triangles: { size: 9, symbol: "triangle-up-open" }, outside: { size: 5, symbol: "square" },
};

// Lower paths are wider, so that coinciding paths stay visible: `place` counts from the top.
function lineTrace(series, colour, index, place) {
  const isPath = series.style === "line" && !series.reference;
  const isOut = series.style === "outside";
  return {
    ...axesOf(index), x: series.x, y: series.y, name: escaped(series.label), legendgroup: series.label,
    mode: MODES[series.style] ?? "lines", cliponaxis: !isOut, ...(isOut && { hoverinfo: "skip" }),
    ...(series.style === "area" && { fill: "toself", fillcolor: `${colour}33`, hoverinfo: "skip" }),
    line: { color: colour, width: series.reference ? 1.8 : isPath ? 1.5 + 1.5 * Math.max(0, Math.min(place, 4) - 1) : 1.5, dash: series.style === "dashed" ? "dash" : "solid" },
    marker: { color: colour, size: 6, ...MARKERS[series.style] },
  };
}

function bandTraces(band, colour, index) {
  const common = {
    ...axesOf(index), x: band.x, name: escaped(band.label), legendgroup: band.label, mode: "lines",
    line: { width: 0, color: colour }, hoverinfo: "skip", showlegend: false,
  };
  return [
    { ...common, y: band.low },
    { ...common, y: band.high, fill: "tonexty", fillcolor: `${colour}33` },
  ];
}

function layoutOf(place) {
  const chart = chartOf(place);
  const style = getComputedStyle(document.body);
  const [text, line] = ["--ink", "--grid"].map((name) => style.getPropertyValue(name).trim());
  const columns = Math.max(1, Math.min(chart.columns, Math.floor(place.clientWidth / NARROWEST_PANEL)));
  const rows = Math.ceil(chart.panels.length / columns);
  const planes = chart.panels.filter((panel) => panel.plane);
  const isLens = planes.length > 0 && planes.every((panel) => panel.x.limits && panel.y.limits);
  const row = isLens ? lensHeight(planes[0], (place.clientWidth - 70) / columns)
    : planes.length ? 400 : rows === 1 ? 260 : 180;
  const panelWidth = (place.clientWidth - 70) / columns - (columns > 1 ? 40 : 0);
  const titles = chart.panels.map((panel) => fitted(panel.title, panelWidth));
  const second = titles.some((title) => title.includes("\n")) ? 16 : 0; // line of a title
  const foot = (chart.legend ? 90 : 66) + second;
  const deep = chart.panels.some((panel) => fitted(panel.x.label, panelWidth - namesWidth(panel)).includes("\n")) ? 16 : 0; // of a label
  const height = rows * (row + second + deep) + foot;
  const inner = height - 67 - second - deep;
  const layout = {
    height, autosize: true, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: text, size: 12, family: style.fontFamily },
    margin: { l: 60, r: 10, t: 22 + second, b: 45 + deep }, hovermode: "closest", showlegend: chart.legend, dragmode: "zoom",
    hoverlabel: { font: { family: style.fontFamily } }, legend: { orientation: "h", y: -(45 + deep) / inner, yanchor: "top", x: 0 },
    annotations: [],
  };
  const gap = { x: 0, y: (62 + second + deep) / inner };
  const panelHeight = inner * (1 - gap.y * (rows - 1)) / rows;
  // the gap between columns fits ticks and an axis label, of two lines if it is longer than its axis
  const isLong = chart.panels.some((panel) => fitted(panel.y.label, panelHeight).includes("\n"));
  if (columns > 1) gap.x = Math.max(0.25 / columns, (isLong ? 84 : 66) / (place.clientWidth - 70));
  chart.panels.forEach((panel, index) => {
    const at = { x: index % columns, y: rows - 1 - Math.floor(index / columns) };
    const size = { x: (1 - gap.x * (columns - 1)) / columns, y: (1 - gap.y * (rows - 1)) / rows };
    for (const name of ["x", "y"]) {
      const start = at[name] * (size[name] + gap[name]);
      layout[`${name}axis${index ? index + 1 : ""}`] = {
        ...axisOf(panel, name, { x: panelWidth - namesWidth(panel), y: panelHeight }[name]), gridcolor: line, linecolor: line, zeroline: false,
        domain: [start, Math.min(1, start + size[name])], anchor: axesOf(index)[name === "x" ? "yaxis" : "xaxis"],
      };
    }
    if (panel.plane) Object.assign(layout[`yaxis${index ? index + 1 : ""}`], { scaleanchor: axesOf(index).xaxis, constrain: "domain" });
    layout.annotations.push({
      text: escaped(titles[index]).replaceAll("\n", "<br>"), align: "left", showarrow: false, xref: `${axesOf(index).xaxis} domain`, yref: `${axesOf(index).yaxis} domain`,
      x: 0, y: 1, xanchor: "left", yanchor: "bottom", font: { size: 12 },
    });
  });
  return { layout, height };
}

// The height of a lens follows from its limits, within bounds.
function lensHeight(panel, width) {
  const [wide, high] = [panel.x.limits, panel.y.limits].map(([low, top]) => top - low);
  return Math.min(300, Math.max(130, width * high / wide)) + 40;
}

// Width of tick names at the left of a panel, beyond the margin.
function namesWidth(panel) {
  const longest = Math.max(0, ...Object.values(panel.y.ticks).map((text) => text.length));
  return Math.max(0, longest * LETTER_PX - 40);
}

function axisOf(panel, name, length) {
  const axis = panel[name];
  const named = panel.series.some((series) => series[name].some((value) => typeof value === "string"));
  const places = Object.keys(axis.ticks).map(Number);
  const ends = axis.limits ?? endsOf(panel, name);
  const own = axis.log && !places.length ? decades(ends) : [];
  return {
    title: { text: escaped(fitted(axis.label, length)).replaceAll("\n", "<br>"), standoff: 5 }, nticks: name === "x" ? Math.max(3, Math.min(7, Math.floor(length / TICK_PX))) : 7, type: axis.log ? "log" : named ? "category" : "linear", automargin: true,
    ...(name === "x" && !named && { tickangle: 0 }), exponentformat: "none", separatethousands: true,
    ...(axis.limits && { range: axis.log ? axis.limits.map(Math.log10) : axis.limits }),
    ...(places.length && { tickvals: places, ticktext: Object.values(axis.ticks).map(escaped) }),
    ...(own.length > 1 && { tickvals: own, ticktext: own.map(written) }),
  };
}

// Splits a text that is longer than its axis into two lines, at the space nearest to the middle.
function fitted(text, length) {
  if (text.length * LETTER_PX <= length) return text;
  const spaces = [...text.matchAll(/ /g)].map((each) => each.index);
  const middle = spaces.sort((a, b) => Math.abs(a - text.length / 2) - Math.abs(b - text.length / 2))[0];
  return middle === undefined ? text : `${text.slice(0, middle)}\n${text.slice(middle + 1)}`;
}

function endsOf(panel, name) {
  const values = panel.series.flatMap((series) => series[name]);
  if (name === "y") values.push(...panel.bands.flatMap((band) => [...band.low, ...band.high]));
  const known = values.filter((value) => typeof value === "number" && value > 0);
  return [known.reduce((a, b) => Math.min(a, b), Infinity), known.reduce((a, b) => Math.max(a, b), 0)];
}

// Ticks of a logarithmic axis: 1, 2, 5, or 1, 3, or 1 in each decade.
function decades([low, high]) {
  const [first, last] = [Math.floor(Math.log10(low)), Math.ceil(Math.log10(high))];
  if (!Number.isFinite(first) || !Number.isFinite(last)) return [];
  const span = Math.log10(high / low);
  const digits = span < 1.6 ? [1, 2, 5] : span < 3.2 ? [1, 3] : [1];
  const every = span > 8 ? Math.ceil(span / 8) : 1;
  const found = [];
  for (let power = first; power <= last; power += every) {
    for (const digit of digits) found.push(Number(`${digit}e${power}`));
  }
  return found.filter((value) => value >= low / 1.001 && value <= high * 1.001);
}

function written(value) {
  if (value >= 1e-4 && value < 1e7) return value.toLocaleString("en", { maximumFractionDigits: 6 });
  const [digit, power] = value.toExponential(0).split("e");
  return `${digit} × 10<sup>${Number(power)}</sup>`;
}

// Plotly interprets some HTML in its texts; names from logs must not be interpreted.
function escaped(text) {
  return text.replaceAll("&", "&amp;").replaceAll("<", "&lt;");
}
