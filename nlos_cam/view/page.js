"use strict";
// The page: messages from the stream or the file, pictures and status.

const source = document.documentElement.outerHTML; // as it came, for a session saved by the page
const mode = document.documentElement.dataset.mode;
let token = location.hash.slice(1) || sessionStorage.getItem("token") || "";
if (token) sessionStorage.setItem("token", token);
// The same address with another token is no navigation: the page is the one that is open.
addEventListener("hashchange", () => location.reload());
const state = { run: "", bench: null, moment: null, status: { state: "connecting" }, statusAt: 0, shown: 0, answer: "" };
const bench = new Bench(find("#bench"));
let pictures = null;

// ---- messages -------------------------------------------------------------------------------------------------

function decode(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  const size = view.getUint32(4, true);
  const message = JSON.parse(new TextDecoder().decode(bytes.subarray(8, 8 + size)));
  message.raw = bytes;
  const body = bytes.subarray(8 + size);
  for (const [name, [at, rows, columns = 1, depth = 1]] of Object.entries(message.arrays))
    message.arrays[name] = { rows, columns, data: body.subarray(at, at + rows * columns * depth) };
  return message;
}

// Cut the whole messages off the front of a buffer.
function split(buffer) {
  const messages = [];
  let at = 0;
  while (at + 8 <= buffer.length) {
    const end = at + 4 + new DataView(buffer.buffer, buffer.byteOffset + at).getUint32(0, true);
    if (end > buffer.length) break;
    messages.push(buffer.slice(at, end));
    at = end;
  }
  return [messages, buffer.subarray(at)];
}

const HIDDEN_MS = 20000; // a page out of sight for this long leaves its stream, of eight, to others

// Call `away` once the page has been hidden for a while; return what ends this.
function whenHidden(away) {
  let timer = 0;
  const look = () => (clearTimeout(timer), (timer = document.hidden ? setTimeout(away, HIDDEN_MS) : 0));
  document.addEventListener("visibilitychange", look);
  look();
  return () => (clearTimeout(timer), document.removeEventListener("visibilitychange", look));
}

const seen = () => new Promise((resume) => {
  const look = () => document.hidden || (document.removeEventListener("visibilitychange", look), resume());
  document.addEventListener("visibilitychange", look);
  look();
});

async function receive(signal) {
  const answer = await asked("stream", { signal });
  const reader = answer.body.getReader();
  let rest = new Uint8Array(0);
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    const joined = new Uint8Array(rest.length + value.length);
    joined.set(rest);
    joined.set(value, rest.length);
    const [messages, left] = split(joined);
    rest = left;
    messages.map(decode).forEach(handle);
  }
}

// Watch while the page is in sight; a lost or refused stream is asked for again.
async function follow() {
  for (;;) {
    let reason = "the connection was lost: is the program still running? Trying again";
    const leaving = new AbortController();
    // A recording is played on where it stands: its stream is not asked for twice.
    const ended = mode === "recorded" ? () => {} : whenHidden(() => leaving.abort());
    try {
      await receive(leaving.signal);
    } catch (error) {
      if (error instanceof Refusal) reason = error.message;
    }
    ended();
    if (leaving.signal.aborted) reason = "out of sight: goes on when it is looked at";
    if (state.status.state !== "ended") setStatus({ state: "no connection", message: reason });
    await (leaving.signal.aborted ? seen() : new Promise((resume) => setTimeout(resume, 1500)));
  }
}

// A stream begins. One of another run makes the page forget; a live page that comes back to the same
// run keeps what it saw. A recording is sent from its start each time.
function begin(run) {
  const comesBack = mode === "live" && Boolean(run) && run === state.run;
  Object.assign(state, { run, status: { state: "connecting" }, statusAt: 0 });
  document.body.classList.toggle("recorded", mode !== "live");
  find("#offers").innerHTML = "";
  player.clear();
  if (comesBack) return;
  Object.assign(state, { bench: null, moment: null });
  kept.clear();
  plots.clear();
}

function handle(message) {
  if (message.kind === "hello" && message.mode !== mode) location.reload(); // another program, with another page
  else if (message.kind === "hello") begin(message.run);
  else if (message.kind === "bench") setBench(message);
  else if (message.kind === "moment") {
    kept.add(message);
    showMoment(message);
  } else if (message.kind === "chunk") player.add(message);
  else if (message.kind === "status") setStatus(message);
}

function sameBytes(one, other) {
  return one !== null && one.length === other.length && one.every((byte, k) => byte === other[k]);
}

// ---- pictures -------------------------------------------------------------------------------------------------

function setBench(message) {
  state.bench = message;
  state.lidar = null;
  if (mode === "live" && !sameBytes(kept.bench, message.raw)) kept.clear(); // its moments are of the bench before
  kept.bench = message.raw;
  pictures = new Pictures(message);
  bench.setBench(message.parts, message.box);
  drawBar();
  const rows = (message.calibration || []).map((cells) => `<tr>${cells.map((cell) => `<td>${escape(cell)}</td>`).join("")}</tr>`);
  const assumed = '<span class="quiet-text">The wall was not measured: the rig is assumed. Measure it with <code>nlos-cam calibrate --wall</code>.</span>';
  find("#facts").innerHTML = rows.length ? `<table>${rows.join("")}</table>` : assumed;
  fillSelect(find("#other select"), []);
}

function drawBar() {
  pictures.bar(find("#bar"));
  for (const old of document.querySelectorAll("#bar span")) old.remove();
  const lying = matchMedia("(max-width: 820px)").matches;
  for (const share of [0, 0.25, 0.5, 0.75, 1]) {
    const label = document.createElement("span");
    label.textContent = pictures.cm(1 + 254 * share).toFixed(0);
    label.style.top = `${3 + 94 * share}%`;
    label.style.left = lying ? `${4 + 92 * share}%` : "";
    find("#bar div").append(label);
  }
}

// Options [value, text]; the present choice stays if it can.
function fillSelect(select, options) {
  const wanted = JSON.stringify(options);
  if (select.dataset.options === wanted) return;
  const value = select.value;
  select.dataset.options = wanted;
  select.innerHTML = options.map(([name, text]) => `<option value="${escape(name)}">${escape(text)}</option>`).join("");
  if (options.some(([name]) => name === value)) select.value = value;
}

const MEANINGS = {
  Reconstruction: "distance of the hidden surface from the relay wall, as the networks reconstruct it",
  Truth: "the simulated object as it is",
  Difference: "reconstruction less truth",
  Uncertainty: "expected absolute error of the depth at each pixel, if there is a surface",
  Surface: "probability that there is a hidden surface at each pixel",
  "Lidar: depth": "what the lidar itself sees: distance from the lidar along its axis",
  "Lidar: infrared": "counts of the returning infrared light",
};

function title(id, html) {
  const box = find(`${id} figcaption`);
  if (box.dataset.html === html) return;
  box.dataset.html = html;
  box.innerHTML = html;
  const words = box.textContent;
  const term = Object.keys(MEANINGS).find((name) => words.startsWith(name));
  box.title = term ? `${words.trim()}: ${MEANINGS[term]}` : words;
  find(`${id} div`).setAttribute("aria-label", box.title);
}

function caption(id, text) {
  const box = find(`${id} small`);
  if (box.textContent === text) return;
  delete box.dataset.html;
  box.textContent = text;
  box.title = text;
}

function drawMoment() {
  const moment = state.moment;
  if (!moment || !pictures) return;
  const { depth, truth, error, surface, lidar, infrared, change, residual } = moment.arrays;
  find("#verdict").className = moment.tone;
  setText("#headline", moment.headline);
  setText("#detail", moment.detail);
  setText("#warnings", [...(state.status.warnings || []), ...moment.warnings].join(" · "));
  pictures.hidden(find("#found"), depth, moment);
  title("#found", "Reconstruction");
  caption("#found", surface ? "lines: 20, 50, 80 % surface" : "");
  if (truth) drawTruth(depth, truth);
  drawUncertainty(truth ? ["#error", "#surface"] : ["#truth", "#wrong"], error, surface);
  find("#errors").hidden = !truth || !error;
  if (lidar && lidar !== state.lidar) drawLidar(moment, lidar, infrared);
  drawOther(change, residual, moment);
  bench.setSurface(pictures.quads(moment, find("#bench select").value));
  inspector.draw();
  state.shown++;
}

function setText(selector, text) {
  const box = find(selector);
  if (box.textContent !== text) box.textContent = text;
}

function drawTruth(depth, truth) {
  title("#truth", "Truth (simulated)");
  caption("#truth", "");
  pictures.hidden(find("#truth"), truth, null);
  title("#wrong", `Difference ${pictures.swatch("signed")} ±${DIFFERENCE_SPAN_CM} cm`);
  const { overlap, errorMm } = pictures.difference(find("#wrong"), depth, truth);
  const box = (name) => `<i class="hatch-${name}" style="width: 9px"></i> ${name}`;
  const off = errorMm === null ? "" : `, ${errorMm.toFixed(0)} mm`;
  const text = `outline ${(100 * overlap).toFixed(0)} %${off} ${box("extra")} ${box("missing")}`;
  const small = find("#wrong small");
  if (small.dataset.html === text) return;
  small.dataset.html = text;
  small.innerHTML = text;
  small.title = "outline: share of the two outlines that they have in common; mm: mean depth error inside; extra: reconstructed where nothing is; missing: the reverse";
}

function drawUncertainty([errorAt, surfaceAt], error, surface) {
  // The pictures there may be those of a run before.
  if (errorAt === "#truth" && !error)
    for (const id of [errorAt, surfaceAt]) {
      title(id, "no truth, no uncertainty");
      caption(id, "");
      pictures.clear(find(id));
    }
  if (error) {
    title(errorAt, `Uncertainty ${pictures.swatch("error")} 0 to ${MAX_ERROR_MM} mm`);
    pictures.error(find(errorAt), error);
    caption(errorAt, "expected error of a surface");
  }
  if (surface) {
    title(surfaceAt, `Surface ${pictures.swatch("surface")} 0 to 100 %`);
    pictures.probability(find(surfaceAt), surface);
    caption(surfaceAt, "probability; line: 50 %");
  }
}

function drawLidar(moment, lidar, infrared) {
  state.lidar = lidar;
  pictures.lidar(find("#depth"), lidar);
  const [near, far] = moment.lidar_span_m.map((each) => (100 * each).toFixed(0));
  title("#depth", `Lidar: depth ${pictures.swatch("lidar")} ${near} to ${far} cm`);
  caption("#depth", "dark: no return");
  const [low, high] = pictures.infrared(find("#infrared"), infrared);
  title("#infrared", `Lidar: infrared ${pictures.swatch("grey")} ${low} to ${high} counts`);
}

function drawOther(change, residual, moment) {
  const maps = [];
  if (change) maps.push(["change", "Change from the bare wall"]);
  if (residual) maps.push(["residual", "Physics check: residual"]);
  for (const [name, title] of Object.entries(state.bench.wall_pictures || {})) maps.push([name, title]);
  fillSelect(find("#other select"), maps.length ? maps : [["", "Physics check: residual"]]);
  const select = find("#other select");
  const name = select.value;
  const span = otherSpan(moment, name);
  find("#other div").setAttribute("aria-label", select.selectedOptions[0] ? select.selectedOptions[0].text : "");
  if (span && moment.arrays[name]) {
    pictures.signed(find("#other"), moment.arrays[name]);
    const score = name === "residual" && moment.score !== null ? `; score ${moment.score.toFixed(2)}` : "";
    caption("#other", `red ${(100 * span).toFixed(0)} cm nearer, blue farther${score}`);
  } else if (state.bench.arrays[name]) {
    pictures.rgb(find("#other"), state.bench.arrays[name]);
    caption("#other", "");
  } else {
    pictures.clear(find("#other"));
    caption("#other", "first check to come");
  }
}

function otherSpan(moment, name) {
  return { change: moment.change_span_m, residual: moment.residual_span_m }[name];
}

// ---- the point under the pointer ------------------------------------------------------------------------------

// Index of the cell of an array, of any number of rows and columns, at shares of its width and height.
function cellAt({ rows, columns }, u, v) {
  return Math.floor(v * rows) * columns + Math.floor(u * columns);
}

// Place of a point of a map in the wall frame in metres; null where no depth is known.
function pointOf(family, u, v) {
  const arrays = state.moment ? state.moment.arrays : {};
  return family === "hidden" ? pictures && arrays.depth && hiddenPoint(arrays, u, v) : lidarPoint(arrays, u, v);
}

function hiddenPoint({ depth, truth }, u, v) {
  const [x0, x1, y0, y1] = state.bench.box;
  const at = cellAt(depth, u, v);
  const byte = depth.data[at] || (truth ? truth.data[at] : 0);
  return byte ? [x0 + u * (x1 - x0), y1 - v * (y1 - y0), pictures.cm(byte) / 100] : null;
}

function lidarPoint({ lidar }, u, v) {
  const view = state.bench && state.bench.lidar_view;
  const byte = lidar ? lidar.data[cellAt(lidar, u, v)] : 0;
  if (!view || !byte) return null;
  const [near, far] = state.moment.lidar_span_m;
  const depth = near + ((byte - 1) / 254) * (far - near);
  const [left, right, top, bottom] = view.slopes;
  const ray = [left + u * (right - left), top + v * (bottom - top), 1];
  return view.pose.map(([a, b, c, origin]) => depth * (a * ray[0] + b * ray[1] + c * ray[2]) + origin);
}

function wallText(point) {
  const [x, y, z] = point.map((value) => (100 * value).toFixed(1));
  return `wall x ${x}, y ${y}, z ${z} cm`;
}

function readPoint({ family, u, v }) {
  const moment = state.moment;
  if (!moment || !pictures) return [];
  return family === "hidden" ? readHidden(moment, u, v) : readLidar(moment, u, v);
}

function readHidden({ arrays: { depth, truth, error, surface } }, u, v) {
  const at = cellAt(depth, u, v);
  const cm = (byte) => (byte ? `${pictures.cm(byte).toFixed(1)} cm` : "no surface");
  const sure = error && depth.data[at] ? ` ± ${(error.data[at] * pictures.errorStepMm).toFixed(1)} mm` : "";
  const point = hiddenPoint({ depth, truth }, u, v);
  return [
    `depth ${cm(depth.data[at])}${sure}`,
    truth ? `truth ${cm(truth.data[at])}` : "",
    surface ? `surface ${((100 * surface.data[at]) / 255).toFixed(0)} %` : "",
    point ? wallText(point) : "",
    `pixel row ${Math.floor(at / depth.columns)}, column ${at % depth.columns}`,
  ];
}

function readLidar(moment, u, v) {
  const { lidar, infrared } = moment.arrays;
  if (!lidar) return [];
  const at = cellAt(lidar, u, v);
  const [near, far] = moment.lidar_span_m;
  const byte = lidar.data[at];
  const bound = { 1: "at most ", 255: "at least " }[byte] || "";
  const depth = byte ? `${bound}${(100 * (near + ((byte - 1) / 254) * (far - near))).toFixed(1)} cm` : "no return";
  const name = find("#other select").value;
  const map = moment.arrays[name];
  const span = otherSpan(moment, name);
  const signed = map && span ? map.data[cellAt(map, u, v)] : 0;
  const point = lidarPoint(moment.arrays, u, v);
  const pixel = (share, count) => Math.floor(share * count) * (moment.lidar_step || 1);
  return [
    `lidar depth ${depth}`,
    infrared ? `infrared ${infrared.data[cellAt(infrared, u, v)]} counts` : "",
    signed ? `${name} ${((1000 * span * (signed - 128)) / 127).toFixed(1)} mm` : "",
    point ? wallText(point) : "",
    `pixel row ${pixel(v, lidar.rows)}, column ${pixel(u, lidar.columns)}`,
  ];
}

function showMoment(moment) {
  state.moment = moment;
  plots.add(moment);
  find("#note").hidden = true;
  drawMoment();
}

// ---- status ---------------------------------------------------------------------------------------------------

const OVER = {
  "no connection": "No connection", "no answer": "No answer", ended: "The run has ended",
  stalled: "Camera stalled", paused: "Paused",
};

function setStatus(status) {
  const old = status.state === "ended" || status.state === "no connection" ? { ...state.status, recording: null, warnings: [] } : {};
  state.status = { ...old, ...status, message: status.message || "" };
  state.statusAt = performance.now();
  if (state.status.control) controls.update(state.status.control);
  controls.able();
  drawStatus();
  if (mode === "live" && ["ended", "no connection"].includes(status.state)) offer();
}

// After the end, which a killed program does not send: what the page still holds can be played, and saved as a file.
function offer() {
  if (find("#offers").childElementCount || kept.moments.length < 2) return;
  const seconds = lasting(kept.seconds());
  find("#offers").innerHTML = `<button id="play-last">Play the last ${seconds}</button><button id="save-last" title="one .html file that any browser plays">Save them</button>`;
  find("#play-last").addEventListener("click", () => {
    if (!plays()) player.take(kept.moments);
    document.body.classList.add("recorded");
    player.toggle();
  });
  find("#save-last").addEventListener("click", async () => download(await kept.session(), `session-${new Date().toISOString().slice(0, 19).replace(/[:T]/g, "-")}.html`));
}

function lasting(value) {
  const whole = Math.floor(value);
  if (whole < 60) return `${whole} s`;
  if (whole >= 7200) return `${Math.floor(whole / 3600)} h`;
  return `${Math.floor(whole / 60)} min ${whole % 60} s`;
}

const count = (value) => value.toLocaleString("en-US");

function stateWord() {
  const since = (performance.now() - state.statusAt) / 1000;
  const live = mode === "live" && !["ended", "no connection"].includes(state.status.state);
  if (mode === "session") return "saved session";
  return live && state.statusAt && since > 4 ? "no answer" : state.status.state;
}

// The parts of the status line, each with what it means.
function statusParts(word) {
  const now = state.status;
  const since = (performance.now() - state.statusAt) / 1000;
  const live = mode === "live" && !["ended", "no connection"].includes(now.state);
  const calm = ["running", "playback", "saved session"].includes(word);
  const parts = [[`<b class="${calm ? "" : "on"}">${escape(word)}</b>`, "state of the run"]];
  if (now.message && !(OVER[word] && state.moment)) parts.push([escape(now.message), ""]);
  if (now.camera) parts.push([`<b>${escape(now.camera)}</b>`, "where the frames come from"]);
  if (live && now.fps !== undefined) {
    parts.push([`<b>${now.fps.toFixed(1)}</b> frames/s`, "reconstructed per second, over the last 10 s"]);
    const latency = `latency <b>${now.p50_ms.toFixed(0)}</b> ms, p99 <b>${now.p99_ms.toFixed(0)}</b> ms`;
    parts.push([latency, "from a frame's timestamp to its picture: the middle one, and what 99 of 100 stay below"]);
    if (now.camera_ms) parts.push([`simulation <b>${now.camera_ms.toFixed(0)}</b> ms`, "time to simulate a frame, on this machine too"]);
    parts.push([`newest frame <b>${(now.age_s + since).toFixed(1)}</b> s old`, "since the newest frame was taken"]);
  }
  if (now.dropped !== undefined) parts.push([`dropped <b>${count(now.dropped)}</b>`, "frames of the camera without a result"]);
  const celsius = Object.values((state.moment && state.moment.celsius) || {});
  if (celsius.length) parts.push([`<b>${Math.max(...celsius).toFixed(0)}</b> °C`, "the warmest part of the lidar"]);
  if (now.recording) parts.push([`<b class="on">● REC ${lasting(now.recording.seconds + (live ? since : 0))}</b>`, "the camera's streams are being recorded"]);
  if (live && now.disk_s !== undefined) parts.push([`disk for <b>${lasting(now.disk_s - (now.disk_s % 60))}</b>`, "of recording, until the disk is full"]);
  if (state.moment) parts.push([`frame <b>${count(state.moment.frame)}</b>`, "number of the frame, by the camera"]);
  return parts;
}

function drawStatus() {
  const word = stateWord();
  const html = statusParts(word).map(([part, meaning]) => `<span${meaning ? ` title="${meaning}"` : ""}>${part}</span>`).join("");
  if (find("#status").innerHTML !== html) find("#status").innerHTML = html;
  const playing = mode === "live" && plays(); // what is played after the end has its own verdict
  if (mode === "live" && OVER[word] && state.moment && !playing) drawOver(word);
  if (!state.moment) drawNote(word);
  speak();
}

function drawOver(word) {
  const otherwise = { paused: "the pictures stand still", ended: "the pictures are its last" }[word] || "the pictures are old";
  find("#verdict").className = ["paused", "ended"].includes(word) ? "quiet" : "alarm";
  setText("#headline", OVER[word]);
  setText("#detail", state.status.message || otherwise);
  if (["ended", "no connection"].includes(word)) setText("#warnings", "");
}

function drawNote(word) {
  const { message } = state.status;
  const session = state.statusAt ? "The session holds no picture." : "Loading the session…";
  const what = mode === "session" ? session : `${word === "ended" ? OVER.ended : word}${message ? `: ${message}` : "…"}`;
  find("#note").hidden = false;
  setText("#note", what);
}

// For a screen reader: verdict and warnings when they change, and not the numbers of each frame.
function speak() {
  const seen = ["#headline", "#warnings"].map((selector) => find(selector).textContent);
  const words = state.moment ? seen.filter(Boolean).join(". ") : find("#note").textContent;
  const news = words.replace(/[0-9.]+/g, "");
  if (state.spoken === news) return;
  state.spoken = news;
  find("#spoken").textContent = words;
}

// ---- start ----------------------------------------------------------------------------------------------------

const inspector = new Inspector(readPoint, pointOf, bench);

document.body.classList.toggle("recorded", mode !== "live");
listenToTabs();
addEventListener("keydown", onKey);
matchMedia("(max-width: 820px)").addEventListener("change", () => pictures && drawBar());
find("#keys").addEventListener("click", () => showHelp(true));
find("#help").addEventListener("click", () => showHelp(false));
find("#play").addEventListener("click", () => player.toggle());
find("#time").addEventListener("input", (event) => {
  player.playing = false;
  player.seek(Number(event.target.value));
});
// While it is dragged, the slider's place is the hand's; keys move it as any control.
for (const [event, dragged] of [["pointerdown", true], ["pointerup", false], ["pointercancel", false]])
  find("#time").addEventListener(event, () => (player.dragged = dragged));
// Space is for pause or go on after a click with the mouse, not for the button that was clicked.
addEventListener("click", (event) => {
  const button = event.target.closest("#controls button, #player button");
  if (button && event.detail > 0) button.blur();
});
find("#save").addEventListener("click", saveFrame);
for (const select of document.querySelectorAll("figure select, #bench select")) select.addEventListener("change", drawMoment);
openTab(find(`#tabs [data-panel="${mode === "session" ? "plots" : "controls"}"]`));

// Messages of a saved session, which are elements of its page.
function readSession() {
  find('#tabs [data-panel="controls"]').hidden = true;
  for (const element of document.querySelectorAll('script[type="text/x-message"]'))
    try {
      handle(decode(Uint8Array.from(atob(element.textContent), (sign) => sign.charCodeAt(0))));
      element.remove();
    } catch {
      break; // the last one of a killed run is cut
    }
  state.statusAt = performance.now();
  drawStatus();
}

if (mode === "session") addEventListener("DOMContentLoaded", readSession);
else follow();
setInterval(drawStatus, 250);

// For tests, and for the curious: what the page shows now.
window.nlos = {
  state: () => ({
    mode,
    frame: state.moment && state.moment.frame,
    time_s: state.moment && state.moment.time_s,
    shown: state.shown,
    verdict: state.moment && state.moment.verdict,
    headline: find("#headline").textContent,
    detail: find("#detail").textContent,
    status: state.status,
    statusText: find("#status").textContent,
    answer: state.answer,
    note: find("#note").hidden ? "" : find("#note").textContent,
    arrays: state.moment ? Object.keys(state.moment.arrays).filter((name) => state.moment.arrays[name]) : [],
    labels: bench.labels,
    quads: bench.quads.length,
    at: player.at,
    end: player.end(),
    playing: player.playing,
    readout: find("#readout output").textContent,
    marks: document.querySelectorAll(".mark").length,
    benchMarks: bench.marks.length,
    turn: [bench.yaw, bench.pitch],
  }),
};
