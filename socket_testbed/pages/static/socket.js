// Pictures of a socket: unrolled wall, 3D view, course over time, bars of regions, cards.
// Their data is described in document.py.
"use strict";

// viridis (van der Walt and Smith 2015): perceptually uniform and safe for colour-blind readers.
const rgbOf = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
const VIRIDIS = ["#440154", "#482475", "#414487", "#355f8d", "#2a788e", "#21918c", "#22a884",
  "#44bf70", "#7ad151", "#bddf26", "#fde725"].map(rgbOf);
const SCALES = {  // [kPa]; ends of the colour scale, and the least automatic one
  pressure: {ends: [25, 50, 100, 200, 400], least: 50},
  shear: {ends: [2, 5, 10, 20, 50, 100], least: 5},
};
const ARROW = 36;  // [px]; length of an arrow at the end of the scale of shear
const LEGEND = `<i class="full"></i> certain <i class="grey"></i> the greyer, the farther the 95 % interval
  reaches beyond the value. Outlined: clusters, with their measured pressure [kPa]. Arrows: shear of the
  limb on the socket. The wall is unrolled and seen from outside.`;
const SOLID_PERIOD = 400;  // [ms]; minimum between 3D pictures
const PLAIN = {displayModeBar: false, responsive: true};
const byId = (name) => document.getElementById(name);
const known = (value) => value !== null && value !== undefined && Number.isFinite(value);

const plain = (text) => text.replaceAll("&", "&amp;").replaceAll("<", "&lt;");  // no markup

function element(tag, className, text) {
  const made = document.createElement(tag);
  made.className = className || "";
  made.textContent = text ?? "";
  return made;
}

function blend(colours, share) {
  const last = colours.length - 1, place = last * Math.min(Math.max(share, 0), 1);
  const below = Math.min(Math.floor(place), last - 1);
  return colours[below].map((low, i) => low + (place - below) * (colours[below + 1][i] - low));
}

// Colours are spread over a power of the share.
const viridis = (share, power) => blend(VIRIDIS, Math.min(Math.max(share, 0), 1) ** power);

const colourScale = (power) => VIRIDIS.map((rgb, i) => [(i / 10) ** (1 / power), `rgb(${rgb})`]);
const veiled = (rgb, veil, {colour, greyest}) =>
  `rgb(${rgb.map((c, k) => Math.round(c + veil * greyest * (colour[k] - c)))})`;
const BLUE_TO_RED = ["#2166ac", "#67a9cf", "#f7f7f7", "#f4a582", "#b2182b"];
const DIVERGING = BLUE_TO_RED.map((hex, i) => [i / 4, hex]);
const diverging = (share) => blend(BLUE_TO_RED.map(rgbOf), share);

function unpack(patch, tiles) {
  const bytes = Uint8Array.from(atob(patch.weights), (letter) => letter.charCodeAt(0));
  const stored = new Int16Array(bytes.buffer), flat = patch.points.flat();
  patch.at = (values) => flat.map((point, i) => {
    if (!known(point[0])) { return null; }
    let sum = 0;
    for (let tile = 0; tile < tiles; tile++) { sum += stored[i * tiles + tile] * values[tile]; }
    return sum * patch.unit;
  });
  patch.rows = (flatValues) => patch.y.map(
    (_, row) => flatValues.slice(row * patch.x.length, (row + 1) * patch.x.length));
  patch.flat = flat;
}

// --- the map

class SocketMap {
  constructor(box, solid, socket) {
    Object.assign(this, {box, solid, socket, moment: null, kind: "pressure", extras: {},
      scales: {}});  // the end of the scale of each kind so far
    for (const patch of socket.patches) { unpack(patch, socket.names.length); }
    this.wall = socket.patches.find((patch) => patch.name === "wall");
    this.end = socket.patches.find((patch) => patch.name === "end");
    this.clusters = Object.entries(socket.clusters);
    const legend = document.documentElement.style, teal = viridis(0.4, 1);
    legend.setProperty("--certain", VIRIDIS.map((rgb) => `rgb(${rgb})`).join());
    legend.setProperty("--uncertain", [0, 1].map((veil) => veiled(teal, veil, socket.grey)).join());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.show());
    this.narrow = matchMedia("(max-width: 700px)");
    this.narrow.addEventListener("change", () => this.show());
  }

  // Upper end of the colour scale: the smallest fixed one that covers all values so far.
  range(values) {
    if (this.chosen) { return this.chosen; }
    const {ends, least} = SCALES[this.kind];
    const highest = Math.max(...values.filter(known), this.scales[this.kind] ?? 0, least);
    this.scales[this.kind] = ends.find((end) => end >= highest) ?? highest;
    return this.scales[this.kind];
  }

  // Values shown on the tiles, the reach of their 95 % intervals, and their greyness.
  shown() {
    const extra = this.extras[this.kind];
    if (extra) { return {values: extra.values, unit: extra.unit}; }
    const {[this.kind]: values = null, reach, grey} = this.moment ?? {};
    return {values, unit: "kPa", ...(this.kind === "pressure" ? {reach, grey} : {})};
  }

  show(moment = this.moment) {
    this.moment = moment;
    const {values, unit, ...doubt} = this.shown();
    const ink = getComputedStyle(this.box).color;
    const paint = values && this.paint(values, unit, doubt);
    this.drawMap(paint, values, unit, ink);
    if (!this.solid) { return; }
    const wait = SOLID_PERIOD - (performance.now() - (this.drawnSolid ?? -SOLID_PERIOD));
    clearTimeout(this.later);
    if (wait > 0) {
      this.later = setTimeout(() => this.show(), wait);
    } else {
      this.drawnSolid = performance.now();
      this.drawSolid(paint, ink);
    }
  }

  paint(values, unit, {reach, grey}) {
    const extra = unit !== "kPa";
    const finite = values.filter(known);
    const least = Math.min(...finite, 0), differs = this.diverging || (extra && least < 0);
    const most = Math.max(...finite, extra && differs ? -least : least + 1e-9);
    const high = extra ? most : this.range(values), low = differs ? -high : 0;
    const of = (patch) => {
      const z = patch.at(values.map((value) => value ?? 0));
      const within = (given, end) => given && patch.at(given).map((v) => v && Math.min(Math.max(v, 0), end));
      return {z, r: within(reach, Infinity), veil: within(grey, 1)};
    };
    return {low, high, differs, power: this.kind === "pressure" ? this.socket.power : 1, patches: new Map(this.socket.patches.map((patch) => [patch, of(patch)]))};
  }

  drawMap(paint, values, unit, ink) {
    const {socket, wall, end, narrow} = this, {colour, greyest} = socket.grey;
    const veils = [[0, `rgba(${colour},0)`], [1, `rgba(${colour},${greyest})`]], traces = [], notes = [];
    const axes = (patch) => (patch === wall ? {xaxis: "x", yaxis: "y"} : {xaxis: "x2", yaxis: "y2"});
    for (const [patch, {z, r, veil}] of paint?.patches ?? []) {
      const place = {x: patch.x, y: patch.y, zsmooth: "best", ...axes(patch)};
      const main = patch === (wall ?? end);
      traces.push({
        ...place, type: "heatmap", z: patch.rows(z), zmin: paint.low, zmax: paint.high,
        colorscale: paint.differs ? DIVERGING : colourScale(paint.power), showscale: main,
        customdata: r && patch.rows(z.map((v, i) => (v === null ? null : [v - r[i], v + r[i]]))),
        hovertemplate: `%{z:.1f} ${unit}` + (r ? "<br>95 %: %{customdata[0]:.1f} to"
          + " %{customdata[1]:.1f}" : "") + "<extra></extra>",
        colorbar: {title: {text: unit, side: "right"}, thickness: 12, outlinewidth: 0,
          len: narrow.matches ? 0.6 : 0.9, tickfont: {color: ink}, x: 1.0, xpad: 4},
      });
      if (veil) {
        traces.push({...place, type: "heatmap", z: patch.rows(veil), zmin: 0, zmax: 1,
          colorscale: veils, showscale: false, hoverinfo: "skip"});
      }
    }
    const label = (tile, text, shift, extra) => {
      const on = socket.on_wall[tile] ? wall : end;
      const [x, y] = socket.places[tile], side = on === wall ? Math.round(x / 250) : 0;
      notes.push({x, y, yshift: shift, text, xanchor: ["left", "center", "right"][side + 1],
        xref: axes(on).xaxis, yref: axes(on).yaxis, showarrow: false, borderpad: 1,
        bgcolor: "rgba(255,255,255,0.82)", font: {size: narrow.matches ? 9 : 12, color: "#111"},
        ...extra});
    };
    const outline = (tile, look) => {
      const onWall = socket.on_wall[tile], x = socket.corners[tile].map((c) => c[0]);
      for (const turn of onWall ? [-360, 0, 360] : [0]) {  // repeated across the seam
        if (onWall && (Math.max(...x) + turn < -180 || Math.min(...x) + turn > 180)) { continue; }
        traces.push({type: "scatter", mode: "lines", hoverinfo: "skip", showlegend: false,
          ...axes(onWall ? wall : end), x: x.map((at) => at + turn),
          y: socket.corners[tile].map((c) => c[1]), ...look});
      }
    };
    const peak = this.kind === "pressure" && values
      ? values.reduce((best, v, i) => (v > (values[best] ?? -Infinity) ? i : best), 0) : null;
    this.clusters.forEach(([name, tile], i) => {
      outline(tile, {line: {color: "#fff", width: 4}});
      outline(tile, {line: {color: "#111", width: 2}});
      const measured = this.kind === "pressure" ? this.moment?.measured?.[i] : null;
      label(tile, plain(name) + (known(measured) ? `: <b>${measured.toFixed(1)}</b>` : ""),
        narrow.matches ? 20 : 26);
    });
    if (!values) {  // the tiles alone
      socket.names.forEach((name, tile) => outline(tile, {line: {color: ink, width: 1},
        hoverinfo: "text", text: plain(name)}));
    }
    if (peak !== null && !this.diverging) {
      label(peak, `<b>${this.moment.highest ?? "peak"} ${values[peak].toFixed(1)}</b>`, 0,
        {bgcolor: "rgba(17,17,17,0.85)", font: {size: narrow.matches ? 10 : 13, color: "#fff"}});
    }
    const arrows = this.kind === "shear" ? this.moment?.arrows ?? [] : [];
    arrows.forEach(([right, up], tile) => {  // its middle on that of the tile
      const length = Math.hypot(right ?? 0, up ?? 0);
      if (!(length > 0.02 * paint.high)) { return; }
      const [dx, dy] = [right, up].map((part) => (ARROW * part) / Math.max(length, paint.high));
      const {xaxis, yaxis} = axes(socket.on_wall[tile] ? wall : end), [x, y] = socket.places[tile];
      notes.push({x, y, xref: xaxis, yref: yaxis, text: "", showarrow: true, arrowhead: 2, arrowsize: 0.8,
        arrowwidth: 1.5, arrowcolor: length < 0.4 * paint.high ? "#fff" : "#111", ax: -dx, ay: dy, xshift: dx / 2, yshift: dy / 2});
    });
    for (const [name, tiles] of Object.entries(socket.regions)) {  // the user's own
      for (const tile of tiles) { outline(tile, {line: {color: "#fff", width: 1, dash: "dot"}}); }
      label(tiles[0], plain(name), -14);
    }
    const base = {zeroline: false, showgrid: false, fixedrange: true, tickfont: {color: ink}};
    const below = narrow.matches, far = below ? 1 : 0.79, lines = [];
    const layout = {
      margin: {l: narrow.matches ? 24 : 62, r: 8, t: 8, b: narrow.matches ? 4 : 28}, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: {color: ink, family: "inherit"}, annotations: notes, shapes: lines, showlegend: false,
      dragmode: false, hoverlabel: {font: {color: "#111"}, bgcolor: "#fff"},
    };
    if (wall) {
      const [low, high] = [wall.y[0], wall.y.at(-1)];
      const edges = socket.thirds, middles = [0, 1, 2].map((i) => (edges[i] + edges[i + 1]) / 2);
      layout.xaxis = {...base, domain: [0, end ? far : 1], range: [-180, 180],
        tickvals: below ? [-90, 0, 90] : [-180, -90, 0, 90, 180],
        ticktext: below ? socket.sides.slice(1, 4) : socket.sides};
      layout.yaxis = {...base, range: [low, high], tickvals: middles,
        ticktext: socket.heights, domain: [below && end ? 0.36 : 0, 1], tickangle: below ? -90 : 0};
      const line = {color: "rgba(255,255,255,0.55)", width: 1, dash: "dot"};
      for (const x of socket.sectors) { lines.push({type: "line", x0: x, x1: x, y0: low, y1: high, line}); }
      for (const y of edges.slice(1, 3)) { lines.push({type: "line", x0: -180, x1: 180, y0: y, y1: y, line}); }
    }
    if (end) {
      layout.xaxis2 = {...base, domain: wall && !below ? [far + 0.03, 1] : [0, 1], visible: false,
        anchor: "y2"};
      layout.yaxis2 = {...base, domain: [0, wall && below ? 0.27 : 1], visible: false, scaleanchor: "x2", anchor: "x2"};
      notes.push({text: "distal end,<br>anterior up", xref: "x2 domain", yref: "paper", x: below ? 0.02 : 0.5, y: 0.02,
        showarrow: false, font: {color: ink, size: 11}});
    }
    Plotly.react(this.box, traces, layout, PLAIN);
  }

  drawSolid(paint, ink) {
    const {socket} = this;
    const traces = socket.patches.map((patch) => {
      const wide = patch.x.length, faces = [[], [], []];
      for (let row = 0; row + 1 < patch.y.length; row++) {
        for (let col = 0; col + 1 < wide; col++) {
          const a = row * wide + col, square = [a, a + 1, a + wide + 1, a + wide];
          if (!square.every((at) => known(patch.flat[at][0]))) { continue; }
          for (const face of [[0, 1, 2], [0, 2, 3]]) { face.forEach((c, i) => faces[i].push(square[c])); }
        }
      }
      const found = paint?.patches.get(patch);
      const colours = patch.flat.map((_, i) => {
        if (!found || !known(found.z[i])) { return "rgb(200,200,200)"; }
        const share = (found.z[i] - paint.low) / (paint.high - paint.low);
        return veiled(paint.differs ? diverging(share) : viridis(share, paint.power), found.veil?.[i] ?? 0, socket.grey);
      });
      const [x, y, z] = [0, 1, 2].map((axis) => patch.flat.map((point) => point[axis] ?? 0));
      return {type: "mesh3d", x, y, z, i: faces[0], j: faces[1], k: faces[2], vertexcolor: colours,
        hoverinfo: "skip", lighting: {ambient: 0.92, diffuse: 0.12, specular: 0, fresnel: 0}};
    });
    for (const [, tile] of this.clusters) {
      const [x, y, z] = [0, 1, 2].map((axis) => socket.squares[tile].map((corner) => corner[axis]));
      traces.push({type: "scatter3d", mode: "lines", x, y, z, hoverinfo: "skip",
        line: {color: ink, width: 6}});
    }
    if (socket.surface) {
      const {points, faces} = socket.surface;
      const [x, y, z] = [0, 1, 2].map((axis) => points.map((point) => point[axis]));
      const [i, j, k] = [0, 1, 2].map((corner) => faces.map((face) => face[corner]));
      traces.push({type: "mesh3d", x, y, z, i, j, k, color: "#a8a8a8", opacity: 0.35, hoverinfo: "skip"});
    }
    if (!paint) {
      for (const square of socket.squares) {
        const [x, y, z] = [0, 1, 2].map((axis) => square.map((corner) => corner[axis]));
        traces.push({type: "scatter3d", mode: "lines", x, y, z, hoverinfo: "skip", line: {color: ink, width: 2}});
      }
    }
    const none = {visible: false}, [px, py, pz] = socket.proximal;
    Plotly.react(this.solid, traces, {
      uirevision: "kept", margin: {l: 0, r: 0, t: 0, b: 0}, showlegend: false,
      paper_bgcolor: "rgba(0,0,0,0)", font: {color: ink},
      scene: {xaxis: none, yaxis: none, zaxis: none, aspectmode: "data", dragmode: "orbit",
        camera: {eye: {x: 2.2, y: 1.3, z: 0.65}, up: {x: px, y: py, z: pz}}},
    }, PLAIN);
  }
}

// --- the course over time

const SIDES = {l: 46, r: 52};  // [px]; beside the plot, and beside the slider below it

class Course {
  constructor(box, slider, seek) {
    Object.assign(this, {box, slider, course: null, at: 0});
    Object.assign(slider?.style ?? {}, {width: `calc(100% - ${SIDES.l + SIDES.r}px)`,
      margin: `0 ${SIDES.r}px 0 ${SIDES.l}px`});
    slider?.addEventListener("input", () => seek(Number(slider.value)));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.show());
    this.seek = seek;
  }

  show(course = this.course, at = this.at) {
    if (!course) { return; }
    Object.assign(this, {course, at});
    const ink = getComputedStyle(this.box).color, {time} = course, faint = "rgba(128,128,128,0.25)";
    const line = (y, look) => ({type: "scatter", mode: "lines", x: time, y, ...look});
    const traces = [
      line(course.high, {line: {width: 0}, hoverinfo: "skip", showlegend: false}),
      line(course.low, {line: {width: 0}, fill: "tonexty", fillcolor: "rgba(33,145,140,0.25)",
        name: "95 % interval", hoverinfo: "skip"}),
      line(course.peak, {line: {color: "#21918c", width: 2}, name: "peak pressure [kPa]",
        hovertemplate: "%{x:.1f} s: %{y:.1f} kPa<extra></extra>"}),
      line(course.force, {line: {color: "#d55e00", width: 1.5, dash: "dot"}, yaxis: "y2",
        name: "force along the socket [N]", hovertemplate: "%{y:.0f} N<extra></extra>"}),
    ];
    const axis = {tickfont: {color: ink}, gridcolor: faint, zeroline: false, fixedrange: true};
    const mark = (x, look) => ({type: "line", x0: x, x1: x, y0: 0, y1: 1, yref: "paper", line: look});
    const span = [time[0], time.at(-1)];
    Plotly.react(this.box, traces, {
      margin: {...SIDES, t: 24, b: 32}, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: {color: ink, family: "inherit"}, dragmode: false,
      hoverlabel: {font: {color: "#111"}, bgcolor: "#fff"},
      legend: {orientation: "h", x: 0, y: 1.02, yanchor: "bottom", font: {color: ink, size: 11}},
      xaxis: {...axis, range: span, ticksuffix: " s"},
      yaxis: {...axis, title: {text: "kPa", standoff: 4}, rangemode: "tozero"},
      yaxis2: {...axis, title: {text: "N", standoff: 4}, overlaying: "y", side: "right", showgrid: false,
        tickmode: "auto", nticks: 5, rangemode: "tozero"},
      shapes: [
        ...course.events.map((event) => mark(event.time, {color: "#888", width: 1, dash: "dash"})),
        ...(known(at) ? [mark(at, {color: ink, width: 2})] : []),
      ],
      annotations: course.events.slice(0, 12).map((event) => ({x: event.time, y: 1, yref: "paper",
        yanchor: "top", xanchor: "left", text: plain(event.label), showarrow: false,
        font: {size: 10, color: ink}, textangle: 90})),
    }, PLAIN);
    if (!this.listens) {
      this.listens = true;
      this.box.on("plotly_click", (event) => this.seek(event.points[0].x));
    }
    if (this.slider) {
      Object.assign(this.slider, {min: span[0], max: span[1], step: "any"});
      if (known(at)) { this.slider.value = at; }
    }
  }
}

// --- cards and bars

function showCards(box, cards) {
  box.replaceChildren(...cards.map((card) => {
    const made = element("div", card.bad ? "card bad" : "card");
    made.append(element("h3", "", card.title), element("strong", "", card.value));
    if (card.interval) { made.append(element("span", "interval", `95 %: ${card.interval}`)); }
    made.append(element("p", "", card.words));
    return made;
  }));
}

function showBars(box, bars, title) {
  const rows = bars.values[title], ends = rows.flat().filter(known);
  const low = Math.min(0, ...rows.map((row) => row[0]).filter(known));
  const high = Math.max(...ends, low + 1e-9);
  const at = (value) => `${(100 * (Math.min(Math.max(value, low), high) - low)) / (high - low)}%`;
  box.replaceChildren(...bars.regions.map((name, i) => {
    const row = element("div", "bar-row"), track = element("div", "track");
    const [value, from, to] = rows[i];
    row.append(element("span", "", name), track);
    if (known(value)) {
      const bar = element("div", "bar"), whisker = element("div", "whisker");
      const sides = [Math.min(0, value), Math.max(0, value)];
      Object.assign(bar.style, {left: at(sides[0]), width: `calc(${at(sides[1])} - ${at(sides[0])})`});
      Object.assign(whisker.style, {left: at(from), width: `calc(${at(to)} - ${at(from)})`});
      track.append(bar, whisker);
    }
    const text = (v) => v.toFixed(bars.decimals[title]);
    const said = known(value) ? `${text(value)} (${text(from)} to ${text(to)})` : "none";
    row.append(element("span", "said", said));
    return row;
  }), element("p", "legend", "Whiskers and parentheses: 95 % intervals."));
}

function offer(select, names, change) {
  if ([...select.options].map((option) => option.value).join() !== names.join()) {
    select.replaceChildren(...names.map((name) => new Option(name)));
    select.onchange = change;
  }
}

// All pictures of a page, for the moments of a source.
class SocketView {
  constructor(socket, seek, extras = {}, kinds = ["pressure", "shear"]) {
    this.map = new SocketMap(byId("map"), byId("solid"), socket);
    this.map.extras = extras;
    this.course = byId("course") && new Course(byId("course"), byId("cursor"), seek);
    this.bars = null;
    byId("legend").innerHTML = LEGEND;
    const scales = () => {
      const {ends} = SCALES[this.map.kind] ?? {ends: []};
      offer(byId("scale"), ["automatic", ...ends.map((end) => `0 to ${end} kPa`)], (event) => {
        this.map.chosen = ends[event.target.selectedIndex - 1];
        this.map.show();
      });
    };
    offer(byId("kind"), [...kinds, ...Object.keys(extras)], (event) => {
      Object.assign(this.map, {kind: event.target.value, chosen: undefined});
      scales();
      this.map.show();
    });
    scales();
  }

  show({moment, cards, bars, course}) {
    if (moment) {
      this.map.show(moment);
      byId("when").textContent = moment.words ?? `at ${moment.time.toFixed(2)} s`;
    }
    if (cards) { showCards(byId("cards"), cards); }
    if (bars) {
      this.bars = bars;
      const again = () => showBars(byId("bars"), this.bars, byId("bar-value").value);
      offer(byId("bar-value"), Object.keys(bars.values), again);
      again();
    }
    if (course || moment) { this.course?.show(course, moment?.time); }
  }
}
