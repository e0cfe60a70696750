// The page of a trial or of a running testbed; it requests a picture once the last one is drawn.
"use strict";

const PERIOD = 150;  // [ms]; minimum between pictures
const RETRY = 2000;  // [ms]; after a request without an answer
const JUMP = 5;  // [s]; of the arrow keys
const ASK = {
  tare: "Tare the load cell? The limb must be out of the socket and nothing may touch it.",
  "trigger-off": "Stop the measurement? No sensor is read until it is started again.",
};

async function get(path) {
  const answer = await fetch(path);
  if (!answer.ok) { throw new Error((await answer.text()).trim()); }
  return answer.json();
}

function say(text, failed) {
  byId("said").textContent = text;
  byId("said").className = failed ? "failed" : "";
}

async function press(what, given = {}) {
  if (ASK[what] && !confirm(ASK[what])) { return; }
  say(`${what} …`);
  try {
    const answer = await fetch("do", {method: "POST", headers: {"Content-Type": "application/json"},
      body: JSON.stringify({do: what, ...given})});
    if (!answer.ok) { throw new Error(await answer.text()); }
    const {said, failed} = await answer.json();
    say(`${what}: ${said}`, failed);
  } catch (error) {
    say(`${what} failed: ${error.message}`, true);
  }
}

async function lose(error) {
  say(`no answer from the testbed (${error.message}): is the program still running?`, true);
  await new Promise((later) => setTimeout(later, RETRY));
}

async function begin() {
  for (let lost = false; ; lost = true) {
    try {
      const start = await get("start");
      if (lost) { say(""); }
      return start;
    } catch (error) {
      await lose(error);
    }
  }
}

function fill(table, rows) {
  table.replaceChildren(...rows.map((cells) => {
    const row = document.createElement("tr");
    row.append(...cells.map((cell) => element("td", "", cell)));
    return row;
  }));
}

(async function () {
  const start = await begin(), live = start.live === true;
  document.title = start.title;
  byId("title").textContent = start.title;
  byId("facts").textContent = Object.entries(start.facts).map(([name, fact]) => `${name} ${fact}`).join(", ");
  let position = start.start ?? 0, playing = false, moved = true, lost = false, since = 0;
  const seek = (time) => {
    position = Math.min(Math.max(time, 0), start.end ?? 0);
    moved = true;
  };
  const view = new SocketView(start.socket, live ? () => {} : seek);
  if (start.course) { view.show({course: start.course}); }

  if (live) {
    byId("buttons").hidden = byId("trial").hidden = byId("service").hidden = !start.buttons;
    const fields = Object.entries({trial: [], ...start.metadata}).map(([name, choices]) => {
      const field = element(choices.length ? "select" : "input");
      field.append(...choices.map((choice) => new Option(choice)));
      field.name = name;
      const label = element("label", "", `${name} `);
      label.append(field);
      byId("metadata").append(label);
      return field;
    });
    byId("record").addEventListener("click", () => press(
      byId("record").dataset.on ? "stop recording" : "record",
      Object.fromEntries(fields.map((field) => [field.name, field.value.trim()]))));
    byId("mark").addEventListener("click", () => press("mark", {label: byId("label").value}));
    for (const name of ["tare", "fit", "trigger-off", "trigger-on"]) {
      byId(name).addEventListener("click", () => press(name));
    }
  } else {
    byId("player").hidden = byId("cursor").hidden = false;
    const toggle = () => {
      if (!playing && position >= start.end) { seek(0); }
      playing = !playing;
      since = performance.now();
      byId("play").textContent = playing ? "Pause" : "Play";
    };
    byId("play").addEventListener("click", toggle);
    byId("events").replaceChildren(new Option("go to", ""), ...start.course.events.map(
      (event) => new Option(`${event.time.toFixed(2)} s: ${event.label}`, event.time)));
    byId("events").addEventListener("change", ({target}) => { if (target.value) { seek(Number(target.value)); } });
    document.addEventListener("keydown", (event) => {
      const {tagName} = event.target;
      if (["INPUT", "SELECT"].includes(tagName)) { return; }
      const step = {ArrowLeft: -JUMP, ArrowRight: JUMP}[event.key];
      if (step) { seek(position + step); }
      if (event.key === " " && !["BUTTON", "SUMMARY"].includes(tagName)) { event.preventDefault(); toggle(); }
    });
  }

  for (;;) {
    const began = performance.now();
    if (playing) {
      seek(position + Number(byId("speed").value) * (began - since) / 1000);
      since = began;
      if (position >= start.end) {
        playing = false;
        byId("play").textContent = "Play";
      }
    }
    if (!document.hidden && (live || moved)) {
      moved = false;
      try {
        const found = await get(live ? "now" : `now?t=${position}`);
        view.show(found);
        if (lost) { say(""); }
        lost = false;
        if (found.sensors) { fill(byId("sensors"), found.sensors); }
        if (found.wrench) { fill(byId("wrench"), found.wrench); }
        if (found.recording) {
          byId("recording").textContent = found.recording.words;
          byId("record").dataset.on = found.recording.on ? "on" : "";
          byId("record").textContent = found.recording.on ? "■ Stop recording" : "● Record";
        }
      } catch (error) {
        moved = lost = true;
        await lose(error);
      }
    }
    await new Promise((later) => setTimeout(later, Math.max(20, PERIOD - performance.now() + began)));
  }
})();
