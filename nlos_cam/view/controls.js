"use strict";
// Controls of a run, its keys, the tabs and the plots.

const NAMES = {
  record: "Record", stop_recording: "Stop recording", snapshot: "Snapshot", save_session: "Save session",
  end_session: "End session", pause: "Pause", resume: "Go on", take_reference: "Reference of the empty bench",
  average: "Average", option: "Setting", export: "Save this frame",
};

const KEYS = [
  ["space", "pause or go on; in a recording play or pause"],
  ["← →", "a picture back or on; in a live view turn the bench"],
  ["↑ ↓", "turn the bench; + and - zoom, 0 resets"],
  ["R", "record, or stop recording"],
  ["S", "snapshot; in a recording save this frame"],
  ["M", "measure the distance between two points"],
  ["tab, then arrows", "move the point in a map; Enter enlarges it"],
  ["Esc", "close or end what is open"],
  ["?", "these keys"],
];

function tellAnswer(text, failed = false) {
  state.answer = text;
  const box = find("#answer");
  if (!box) return;
  box.className = failed ? "failed" : "quiet-text";
  box.textContent = text;
}

// The program's refusal, in its own words; other errors are in the browser's.
class Refusal extends Error {}

// Return the program's answer. Throws a Refusal.
async function asked(path, options) {
  const answer = await fetch(path, options);
  if (answer.ok) return answer;
  if (answer.status === 403) forgetToken();
  throw new Refusal((await answer.text()).trim());
}

function reasonOf(error) {
  return error instanceof Refusal ? error.message : "no answer: is the program still running?";
}

async function command(name, values = {}) {
  const words = NAMES[name] || name;
  openTab(find('#tabs [data-panel="controls"]')); // a key works from every tab, the answer is in this one
  tellAnswer(`${words}…`);
  try {
    const headers = { "Content-Type": "application/json", "X-Token": token };
    const answer = await asked("command", { method: "POST", headers, body: JSON.stringify({ command: name, ...values }) });
    tellAnswer((await answer.text()).trim());
  } catch (error) {
    tellAnswer(`${words}: ${reasonOf(error)}`, true);
  }
}

// The token was another run's: nothing can be controlled until the address of this one is opened.
function forgetToken() {
  token = "";
  sessionStorage.removeItem("token");
  controls.able();
}

// A number that was typed; an empty field gets its value back.
function typed(box, value, send) {
  if (box.value.trim() === "") box.value = value;
  else send(Number(box.value));
}

// A file that the run wrote, into this browser's downloads: the program may run on another machine.
async function fetchFile(name) {
  tellAnswer(`Download of ${name}…`);
  try {
    const answer = await asked(`files/${encodeURIComponent(name)}`, { headers: { "X-Token": token } });
    download(await answer.blob(), name);
    tellAnswer(`${name} is in this browser's downloads`);
  } catch (error) {
    tellAnswer(`${name}: ${reasonOf(error)}`, true);
  }
}

const controls = {
  shape: "",

  update(given) {
    const shape = JSON.stringify([given.commands, given.options.map((each) => each.name)]);
    if (shape !== this.shape) {
      this.shape = shape;
      this.build(given);
    }
    this.text("#record", given.recording ? "Stop recording" : "Record");
    this.text("#session", given.saving ? "End session" : "Save session");
    this.text("#pause", given.paused ? "Go on" : "Pause");
    this.value("#average", given.average);
    for (const option of given.options) this.value(`#option-${option.name}`, option.value);
    this.files(given.files || []);
    this.forbid("#reference", given.no_reference || "");
  },

  text(selector, text) {
    const box = find(selector);
    if (box && box.textContent !== text) box.textContent = text;
  },

  value(selector, value) {
    const box = find(selector);
    if (box && document.activeElement !== box) box.value = value;
  },

  // Switch a button off, with the reason beside it.
  forbid(selector, reason) {
    const button = find(selector);
    if (!button) return;
    button.disabled = Boolean(reason) || !this.allowed();
    this.text("#reason", reason);
  },

  allowed() {
    return Boolean(token) && !["ended", "no connection"].includes(state.status.state);
  },

  files(names) {
    const box = find("#files");
    if (!box || box.dataset.names === JSON.stringify(names)) return;
    box.dataset.names = JSON.stringify(names);
    box.hidden = !names.length;
    box.innerHTML = `<span>Download</span>${names.map((name) => `<button data-file="${escape(name)}" title="a copy for this browser's machine">${escape(name)}</button>`).join("")}`;
    for (const button of box.querySelectorAll("button")) button.addEventListener("click", () => fetchFile(button.dataset.file));
    this.able();
  },

  build(given) {
    const has = (name) => given.commands.includes(name);
    const button = (id, text, title) => `<button id="${id}" title="${title}">${text}</button>`;
    const row = (name, content) => `<div class="row"><span>${name}</span>${content}</div>`;
    const rows = [];
    if (has("record")) {
      const label = '<input id="label" type="text" placeholder="label" maxlength="60" aria-label="label of the recording" />';
      const record = button("record", "Record", "the camera's streams, as a .bag (key R)");
      const session = button("session", "Save session", "this page with its pictures, as one .html file");
      rows.push(row("Record", label + record + session + button("snapshot", "Snapshot", "this frame as picture, arrays and mesh (key S)")));
    }
    rows.push('<div class="row" id="files" hidden></div>');
    if (has("pause")) {
      const pause = button("pause", "Pause", "stop reconstructing; the camera and a recording go on (space)");
      const reference = button("reference", "Take empty bench as reference", "average 60 frames of the bench with nothing hidden");
      const average = '<input id="average" type="number" min="1" max="1000" aria-label="frames to average" title="the mean of this many frames; moving objects blur" />';
      rows.push(row("Run", `${pause}${reference}<span class="quiet-text">average</span>${average}<span class="quiet-text">frames</span>`));
      rows.push('<div id="reason" class="quiet-text"></div>');
    }
    for (const each of given.options) {
      const name = escape(each.name.replaceAll("_", " "));
      const range = `min="${each.min}" max="${each.max}" step="${each.step}" aria-label="${name}"`;
      rows.push(row(name, `<input id="option-${each.name}" data-option="${each.name}" type="number" ${range} /> <span class="quiet-text">${each.min} to ${each.max}</span>`));
    }
    if (given.note) rows.push(`<div class="row quiet-text">${escape(given.note)}</div>`);
    find("#controls").innerHTML = `${rows.join("")}<div id="answer" class="quiet-text" role="status"></div>`;
    this.listen();
    if (!token) tellAnswer("Read-only: open the address that the program printed, with its token, to control.");
    this.able();
  },

  listen() {
    const on = (id, event, act) => find(id) && find(id).addEventListener(event, act);
    on("#record", "click", () => this.record());
    on("#session", "click", () => command(state.status.control.saving ? "end_session" : "save_session"));
    on("#snapshot", "click", () => command("snapshot"));
    on("#pause", "click", () => this.pause());
    on("#reference", "click", () => command("take_reference"));
    const now = () => state.status.control;
    on("#average", "change", (event) => typed(event.target, now().average, (frames) => command("average", { frames })));
    for (const box of document.querySelectorAll("[data-option]")) {
      const name = box.dataset.option;
      const shown = () => (now().options.find((each) => each.name === name) || { value: "" }).value;
      box.addEventListener("change", () => typed(box, shown(), (value) => command("option", { name, value })));
    }
  },

  record() {
    if (state.status.control.recording) command("stop_recording");
    else command("record", { label: find("#label").value });
  },

  pause() {
    command(state.status.control.paused ? "resume" : "pause");
  },

  // Buttons are off without a token and after the end.
  able() {
    for (const box of document.querySelectorAll("#controls button, #controls input, #controls select")) {
      const forbidden = box.id === "reference" && state.status.control && state.status.control.no_reference;
      box.disabled = !this.allowed() || Boolean(forbidden);
    }
  },
};

// ---- keys -----------------------------------------------------------------------------------------------------

let focusBefore = null; // the element that had the focus before the help was shown

function showHelp(shown) {
  const box = find("#help");
  const rows = KEYS.map(([key, does]) => `<tr><td><kbd>${escape(key)}</kbd></td><td>${escape(does)}</td></tr>`);
  box.firstElementChild.innerHTML = `<h2>Keys</h2><table>${rows.join("")}</table><p><button>Close</button></p>`;
  if (shown && box.hidden) focusBefore = document.activeElement;
  box.hidden = !shown;
  if (shown) box.querySelector("button").focus();
  else if (focusBefore) focusBefore.focus();
}

function plays() {
  return document.body.classList.contains("recorded");
}

function saveFrame() {
  if (state.status.state === "playback" && state.status.controls) command("export", { frame: state.moment.frame, time_s: state.moment.time_s });
  else if (state.moment) player.save();
}

const KEY_ACTS = {
  " ": () => (plays() ? player.toggle() : press("#pause")),
  ArrowLeft: () => (plays() ? player.step(-1) : bench.key("ArrowLeft")),
  ArrowRight: () => (plays() ? player.step(1) : bench.key("ArrowRight")),
  ArrowUp: () => bench.key("ArrowUp"),
  ArrowDown: () => bench.key("ArrowDown"),
  r: () => press("#record"),
  s: () => (plays() ? saveFrame() : press("#snapshot")),
  m: () => inspector.toggleMeasure(),
  "?": () => showHelp(find("#help").hidden),
};

// Press a button if it is there and on.
function press(selector) {
  const button = find(selector);
  if (button) button.click();
}

function onKey(event) {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.key === "Escape") {
    if (!find("#help").hidden) showHelp(false);
    else inspector.close();
    return;
  }
  if (!find("#help").hidden && event.key !== "?") {
    // The dialog has one button, and the page behind it is out of reach.
    if (event.key === "Tab") event.preventDefault();
    return;
  }
  const at = document.activeElement;
  const types = at.matches("input:not([type=range]), select, textarea");
  const act = KEY_ACTS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  const moves = event.key.startsWith("Arrow") && at.matches("[role=tab]");
  const clicks = event.key === " " && at.matches("button");
  if (types || moves || clicks || !act || (event.repeat && !event.key.startsWith("Arrow"))) return;
  event.preventDefault();
  act();
}

// ---- tabs -----------------------------------------------------------------------------------------------------

const tabs = () => [...document.querySelectorAll("#tabs button:not([hidden])")];

function openTab(tab) {
  for (const each of document.querySelectorAll("#tabs button")) {
    each.setAttribute("aria-selected", each === tab);
    each.tabIndex = each === tab ? 0 : -1;
    find(`#${each.dataset.panel}`).classList.toggle("shown", each === tab);
  }
  plots.draw();
}

function listenToTabs() {
  for (const tab of document.querySelectorAll("#tabs button")) {
    tab.addEventListener("click", () => openTab(tab));
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (!step) return;
      const all = tabs();
      const next = all[(all.indexOf(tab) + step + all.length) % all.length];
      openTab(next);
      next.focus();
      event.preventDefault();
    });
  }
}

// ---- plots ----------------------------------------------------------------------------------------------------

const PLOTS = {
  "Latency (ms)": "from the frame's timestamp to its picture, and the stages of it",
  "Temperature (°C)": "of the lidar's laser driver and controller",
  "Frames lost": "frames of the camera without a result, since the start",
  "Physics score": "0: the rendered answer explains the measured maps; 1: not at all",
};

const plots = {
  history: [],

  clear() {
    this.history = [];
  },

  colors: ["#ebf0f5", "#5aaaff", "#ffbe5a", "#50dc78", "#e678dc", "#78dcdc"],
  dashes: [[], [6, 3], [2, 2], [9, 3, 2, 3], [4, 4], [1, 3]],

  add(moment) {
    const last = this.history.at(-1);
    if (last && (moment.time_s < last.time || moment.time_s - last.time > 30)) this.history = [];
    const { wait, ...stages } = moment.stages_ms;
    this.history.push({
      time: moment.time_s,
      "Latency (ms)": { total: moment.latency_ms, ...stages },
      "Temperature (°C)": moment.celsius,
      "Frames lost": { lost: moment.dropped },
      "Physics score": moment.score === null ? {} : { score: moment.score },
    });
    if (this.history.length > 300) this.history.shift();
    this.draw();
  },

  draw() {
    if (!find("#plots").classList.contains("shown") || !this.history.length) return;
    if (!find("#plots canvas"))
      find("#plots").innerHTML = Object.entries(PLOTS).map(([name, meaning]) => `<div><span title="${meaning}">${name}</span> <span class="legend"></span><canvas data-name="${name}" role="img" aria-label="plot: ${name}"></canvas></div>`).join("");
    for (const canvas of document.querySelectorAll("#plots canvas")) this.plot(canvas, canvas.dataset.name);
  },

  // A piece of a series' line for the legend: its dashes tell it from the others without its color.
  sample(k) {
    return `<svg width="24" height="6" aria-hidden="true"><path d="M0 3H24" stroke="currentColor" stroke-width="1.5" stroke-dasharray="${this.dashes[k % 6]}"/></svg>`;
  },

  plot(canvas, name) {
    const series = Object.keys(this.history.at(-1)[name]);
    const width = (canvas.width = canvas.clientWidth);
    const height = (canvas.height = canvas.clientHeight);
    const pen = canvas.getContext("2d");
    const values = this.history.flatMap((each) => Object.values(each[name]));
    const legend = series.map((each, k) => `<span style="color:${this.colors[k % 6]}">${this.sample(k)} ${escape(each.replaceAll("_", " "))}</span>`);
    canvas.parentElement.querySelector(".legend").innerHTML = legend.join(" ");
    if (!values.length) return; // a recording without temperatures: the canvas is clear
    const high = Math.max(...values, 1e-3) * 1.1;
    const low = name.startsWith("Temp") ? Math.min(...values) - 1 : 0;
    const start = this.history[0].time;
    const span = Math.max(this.history.at(-1).time - start, 1e-3);
    const x = (time) => 34 + ((width - 38) * (time - start)) / span;
    const y = (value) => height - 12 - ((height - 18) * (value - low)) / Math.max(high - low, 1e-6);
    pen.fillStyle = "#8c98a0";
    pen.font = "11px system-ui";
    pen.fillText(high.toPrecision(2), 0, 10);
    pen.fillText(low.toPrecision(2), 0, height - 10);
    pen.fillText(`last ${span.toFixed(0)} s`, width - 60, height - 1);
    pen.strokeStyle = "#2a3237";
    pen.strokeRect(33.5, 4.5, width - 38, height - 16);
    series.forEach((each, k) => {
      pen.beginPath();
      for (const point of this.history) if (each in point[name]) pen.lineTo(x(point.time), y(point[name][each]));
      pen.setLineDash(this.dashes[k % 6]);
      pen.strokeStyle = this.colors[k % 6];
      pen.stroke();
    });
    pen.setLineDash([]);
  },
};
