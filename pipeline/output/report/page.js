"use strict";

// A click on a column's head sorts the rows by it, a second one the other way round.
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

// Numbers by value and before texts, texts by the alphabet.
function compare(a, b) {
  const [x, y] = [a, b].map((cell) => Number(cell.dataset.value ?? NaN));
  if (!isNaN(x) && !isNaN(y)) return x - y;
  if (isNaN(x) && isNaN(y)) return a.textContent.localeCompare(b.textContent, "en", { numeric: true });
  return isNaN(x) ? 1 : -1;
}

// A chart is drawn when it comes near to the window, and again when the window or its colours change.
const NARROWEST_PANEL = 260;
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
addEventListener("beforeprint", () => document.querySelectorAll(".plot").forEach(draw));

function draw(place) {
  near.unobserve(place);
  drawn.set(place, place.clientWidth);
  const { layout, height } = layoutOf(place);
  const chart = chartOf(place);
  const bands = chart.panels.flatMap((panel, index) =>
    panel.bands.flatMap((band) => bandTraces(band, chart.colours[band.label], index)));
  const lines = chart.panels.flatMap((panel, index) =>
    panel.series.map((series) => lineTrace(series, chart.colours[series.label], index)));
  const named = new Set();
  for (const trace of [...lines, ...bands.filter((trace) => trace.fill)]) {
    trace.showlegend = !named.has(trace.legendgroup);
    named.add(trace.legendgroup);
  }
  place.style.height = `${height}px`;
  const options = { displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d"] };
  Plotly.react(place, [...bands, ...lines], layout, options);
}

function chartOf(place) {
  return JSON.parse(place.nextElementSibling.textContent);
}

function axesOf(index) {
  const number = index ? index + 1 : "";
  return { xaxis: `x${number}`, yaxis: `y${number}` };
}

// What has one label is named once in the legend and hidden together.
function lineTrace(series, colour, index) {
  return {
    ...axesOf(index), x: series.x, y: series.y, name: escaped(series.label), legendgroup: series.label,
    mode: { "line+markers": "lines+markers", markers: "markers", dots: "markers" }[series.style] ?? "lines",
    line: { color: colour, width: 1.5, dash: series.style === "dashed" ? "dash" : "solid" },
    marker: series.style === "dots" ? { color: colour, size: 2, opacity: 0.5 } : { color: colour, size: 5 },
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
  const [text, line] = ["--text", "--line"].map((name) => style.getPropertyValue(name).trim());
  const columns = Math.max(1, Math.min(chart.columns, Math.floor(place.clientWidth / NARROWEST_PANEL)));
  const rows = Math.ceil(chart.panels.length / columns);
  const inLead = place.closest(".lead") !== null;
  const row = chart.panels.some((panel) => panel.plane) ? 380 : rows === 1 ? 340 : inLead ? 215 : 260;
  const height = rows * row + 90;
  const layout = {
    height, autosize: true, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: text, size: 12, family: style.fontFamily },
    margin: { l: 60, r: 10, t: 22, b: 45 }, hovermode: "closest",
    legend: { orientation: "h", y: -45 / (height - 67), yanchor: "top", x: 0 },
    annotations: [],
  };
  const gap = { x: columns > 1 ? 0.25 / columns : 0, y: 62 / (height - 67) };
  chart.panels.forEach((panel, index) => {
    const at = { x: index % columns, y: rows - 1 - Math.floor(index / columns) };
    const size = { x: (1 - gap.x * (columns - 1)) / columns, y: (1 - gap.y * (rows - 1)) / rows };
    for (const name of ["x", "y"]) {
      const start = at[name] * (size[name] + gap[name]);
      layout[`${name}axis${index ? index + 1 : ""}`] = {
        ...axisOf(panel, name), gridcolor: line, linecolor: line, zeroline: false,
        domain: [start, Math.min(1, start + size[name])], anchor: axesOf(index)[name === "x" ? "yaxis" : "xaxis"],
      };
    }
    if (panel.plane) Object.assign(layout[`yaxis${index ? index + 1 : ""}`], { scaleanchor: axesOf(index).xaxis, constrain: "domain" });
    layout.annotations.push({
      text: escaped(panel.title), showarrow: false, xref: `${axesOf(index).xaxis} domain`, yref: `${axesOf(index).yaxis} domain`,
      x: 0, y: 1, xanchor: "left", yanchor: "bottom", font: { size: 11 },
    });
  });
  return { layout, height };
}

function axisOf(panel, name) {
  const axis = panel[name];
  const named = panel.series.some((series) => series[name].some((value) => typeof value === "string"));
  const places = Object.keys(axis.ticks).map(Number);
  return {
    title: { text: escaped(axis.label), standoff: 5 }, nticks: axis.log ? 5 : 7, type: axis.log ? "log" : named ? "category" : "linear", automargin: true,
    ...(axis.limits && { range: axis.log ? axis.limits.map(Math.log10) : axis.limits }),
    ...(places.length && { tickvals: places, ticktext: Object.values(axis.ticks).map(escaped) }),
  };
}

// Plotly reads some HTML in its texts; names from logs are none.
function escaped(text) {
  return text.replaceAll("&", "&amp;").replaceAll("<", "&lt;");
}
