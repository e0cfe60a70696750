// A self-contained page: a report, a comparison, or a socket with its tiles.
"use strict";

function lineChart(box, chart) {
  const ink = getComputedStyle(box).color, wide = box.clientWidth > 700 ? 3 : 1;
  const columns = Math.min(wide, chart.panels.length), rows = Math.ceil(chart.panels.length / columns);
  const traces = [], notes = [], shapes = [];
  const layout = {grid: {rows, columns, pattern: "independent", ygap: 0.35},
    height: 60 + 190 * rows, margin: {l: 48, r: 8, t: 40, b: 36}, font: {color: ink, size: 11},
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", annotations: notes, shapes,
    legend: {orientation: "h", y: 1.0, yref: "container", yanchor: "top"}};
  chart.panels.forEach((panel, i) => {
    const axis = i ? i + 1 : "";
    for (const [name, line] of Object.entries(panel.lines)) {
      traces.push({type: "scatter", mode: chart.dots ? "lines+markers" : "lines", name: plain(name),
        x: line.x, y: line.y, xaxis: `x${axis}`, yaxis: `y${axis}`,
        legendgroup: name, showlegend: traces.every((trace) => trace.name !== plain(name)),
        line: {color: ink, ...line.style}});
    }
    for (const [x0, x1] of chart.shaded ?? []) {
      shapes.push({type: "rect", xref: `x${axis}`, yref: `y${axis} domain`, x0, x1, y0: 0, y1: 1,
        fillcolor: "rgba(128,128,128,0.18)", line: {width: 0}, layer: "below"});
    }
    notes.push({text: `<b>${plain(panel.title)}</b>`, xref: `x${axis} domain`, yref: `y${axis} domain`,
      x: 0, y: 1, yanchor: "bottom", xanchor: "left", showarrow: false});
    const grid = {gridcolor: "rgba(128,128,128,0.25)", zeroline: false, type: chart.log ? "log" : "-"};
    layout[`xaxis${axis}`] = {...grid, title: {text: i + columns >= chart.panels.length ? chart.over : ""}};
    layout[`yaxis${axis}`] = {...grid, title: {text: ""}};
  });
  Plotly.newPlot(box, traces, layout, {displayModeBar: false, responsive: true});
}

(async function () {
  const read = (name) => JSON.parse(byId(name)?.textContent ?? "null");
  if (!("DecompressionStream" in window)) {
    byId("state").textContent = "This browser is too old for the pictures; the numbers are below.";
    return;
  }
  const packed = Uint8Array.from(atob(byId("viewer").textContent), (letter) => letter.charCodeAt(0));
  const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const viewer = document.createElement("script");
  viewer.textContent = await new Response(unpacked).text();
  document.head.append(viewer);
  byId("state").hidden = true;
  const data = read("page-data");
  if (data?.moments) {
    const nearest = (time) => data.moments.reduce(
      (best, one) => (Math.abs(one.time - time) < Math.abs(best.time - time) ? one : best));
    let view = null;
    const seek = (time) => view.show({moment: nearest(time)});
    view = new SocketView(data.socket, seek, data.extras, data.kinds);
    view.show({...data, moment: nearest(data.start)});
    for (const button of document.querySelectorAll("button[data-moment]")) {
      button.addEventListener("click", () => view.show(
        {moment: button.dataset.moment === "mean" ? data.mean : nearest(data.start)}));
    }
  }
  if (data?.cards && !data.moments) { showCards(byId("cards"), data.cards); }
  for (const map of data?.maps ?? []) {
    const picture = new SocketMap(byId(map.box), null, data.socket);
    Object.assign(picture, {chosen: map.range, diverging: map.diverging, scales: {pressure: data.scale}});
    picture.show(map.moment);
  }
  const draw = (chart) => {
    if (!chart.drawn && chart.clientWidth) { chart.drawn = true; lineChart(chart, read(`${chart.id}-data`)); }
  };
  const charts = [...document.querySelectorAll(".chart")];
  charts.forEach(draw);
  document.addEventListener("toggle", () => charts.forEach(draw), true);
})();
