// Shows a scene in place of its still picture, where the browser can.
(async function () {
  "use strict";
  const box = document.getElementById("scene"), state = document.getElementById("scene-state");
  if (!document.createElement("canvas").getContext("webgl") || !("DecompressionStream" in window)) {
    state.textContent = "A still picture: this browser shows no 3D (WebGL).";
    return;
  }
  const read = (name) => document.getElementById(name).textContent;
  const figure = JSON.parse(read("scene-figure")), choices = JSON.parse(read("scene-values"));
  const packed = Uint8Array.from(atob(read("scene-viewer")), (letter) => letter.charCodeAt(0));
  const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const viewer = document.createElement("script");
  viewer.textContent = await new Response(unpacked).text();
  document.head.append(viewer);

  // The tiles: five points each, four triangles around the last.
  const FAN = [[4, 0, 1], [4, 1, 2], [4, 2, 3], [4, 3, 0]];
  const control = (name) => document.getElementById(name);
  function paint(set, row) {
    const values = set.values[row], known = [], unknown = [];
    values.forEach((value, tile) => (value === null ? unknown : known).push(tile));
    const facts = values.flatMap((value, tile) => Array(5).fill(
      `${choices.names[tile]}<br>${set.unit}: ${value === null ? "none" : +value.toPrecision(4)}`
    ));
    [known, unknown].forEach((tiles, i) => {
      const corner = (c) => tiles.flatMap((tile) => FAN.map((face) => 5 * tile + face[c]));
      Object.assign(figure.data[i], {
        i: corner(0), j: corner(1), k: corner(2), text: facts, visible: tiles.length > 0,
      });
    });
    Object.assign(figure.data[0], {
      intensity: values.flatMap((value) => Array(5).fill(value ?? set.low)),
      cmin: set.low, cmax: set.high,
    });
    figure.data[0].colorbar.title.text = set.unit;
  }
  const chosen = () => choices.sets[control("source").value][control("value").value];
  function show() {
    const set = chosen(), row = control("instant").value;
    control("instant-shown").value = set.times ? `${set.times[row].toFixed(2)} s` : "";
    paint(set, row);
    return Plotly.react(box, figure.data, figure.layout, {
      responsive: true, displayModeBar: false,
    });
  }
  function offer() {  // the values of a source, the one shown before if it has it
    const names = Object.keys(choices.sets[control("source").value]);
    const before = control("value").value;
    control("value").replaceChildren(...names.map((name) => new Option(name)));
    control("value").value = names.includes(before) ? before : names[0];
    rewind();
  }
  function rewind() {
    const set = chosen();
    control("instant").max = set.values.length - 1;
    control("instant").value = set.start;
    control("time").hidden = !set.times;
  }
  offer();
  control("source").addEventListener("change", () => { offer(); show(); });
  control("value").addEventListener("change", () => { rewind(); show(); });
  control("instant").addEventListener("input", show);
  box.replaceChildren();
  state.hidden = true;
  await show();
  const start = JSON.stringify(box.layout.scene.camera);

  const TURN = Math.PI / 18, NEARER = 1 / 1.15;  // of one step
  const STEPS = {  // around, upwards, distance
    ArrowLeft: [TURN, 0, 1], ArrowRight: [-TURN, 0, 1], ArrowUp: [0, TURN, 1],
    ArrowDown: [0, -TURN, 1], "+": [0, 0, NEARER], "-": [0, 0, 1 / NEARER],
  };
  function move(key) {
    if (key === "Home") { return Plotly.relayout(box, {"scene.camera": JSON.parse(start)}); }
    const {eye, center} = box.layout.scene.camera, [around, upwards, farther] = STEPS[key];
    const [x, y, z] = ["x", "y", "z"].map((axis) => eye[axis] - center[axis]);
    const distance = Math.hypot(x, y, z), azimuth = Math.atan2(y, x) + around;
    const height = Math.max(-1.5, Math.min(1.5, Math.asin(z / distance) + upwards));
    const across = farther * distance * Math.cos(height);
    return Plotly.relayout(box, {"scene.camera.eye": {
      x: center.x + across * Math.cos(azimuth),
      y: center.y + across * Math.sin(azimuth),
      z: center.z + farther * distance * Math.sin(height),
    }});
  }
  box.addEventListener("keydown", (event) => {
    if ((event.key in STEPS || event.key === "Home") && !event.ctrlKey && !event.altKey) {
      event.preventDefault();
      move(event.key);
    }
  });
  for (const button of document.querySelectorAll("#camera button")) {
    button.addEventListener("click", () => move(button.value));
  }
  for (const part of document.querySelectorAll(".needs-scene")) { part.hidden = false; }
})();
