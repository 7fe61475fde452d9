"use strict";
// The page: messages from the stream or the file, pictures, status, controls, plots and player.

const mode = document.documentElement.dataset.mode;
const find = (selector) => document.querySelector(selector);
const token = location.hash.slice(1) || sessionStorage.getItem("token") || "";
if (token) sessionStorage.setItem("token", token);
const state = { bench: null, moment: null, status: { state: "connecting" }, statusAt: 0, shown: 0, answer: "" };
const bench = new Bench(find("#bench"));
let pictures = null;

// ---- messages -------------------------------------------------------------------------------------------------

function decode(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset), size = view.getUint32(4, true);
  const message = JSON.parse(new TextDecoder().decode(bytes.subarray(8, 8 + size)));
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
  const answer = await fetch("stream", { signal });
  if (!answer.ok) throw new Error((await answer.text()).trim());
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
    const leaving = new AbortController(), ended = whenHidden(() => leaving.abort());
    try {
      await receive(leaving.signal);
    } catch (error) {
      if (error.message && !/fetch|network/i.test(error.message)) reason = error.message;
    }
    ended();
    if (leaving.signal.aborted) reason = "out of sight: goes on when it is looked at";
    if (state.status.state !== "ended") setStatus({ state: "no connection", message: reason });
    await (leaving.signal.aborted ? seen() : new Promise((resume) => setTimeout(resume, 1500)));
  }
}

function handle(message) {
  if (message.kind === "hello" && mode !== "session") Object.assign(state, { bench: null, moment: null, status: { state: "connecting" }, statusAt: 0 }), player.clear();
  else if (message.kind === "bench") setBench(message);
  else if (message.kind === "moment") showMoment(message);
  else if (message.kind === "chunk") player.add(message);
  else if (message.kind === "status") setStatus(message);
}

// ---- pictures -------------------------------------------------------------------------------------------------

function setBench(message) {
  state.bench = message;
  pictures = new Pictures(message);
  bench.setBench(message.parts, message.box);
  pictures.bar(find("#bar"));
  for (const old of document.querySelectorAll("#bar span")) old.remove();
  for (const share of [0, 0.25, 0.5, 0.75, 1]) {
    const label = document.createElement("span");
    label.textContent = pictures.cm(1 + 254 * share).toFixed(0);
    label.style.top = `${3 + 94 * share}%`;
    label.style.left = matchMedia("(max-width: 820px)").matches ? `${4 + 92 * share}%` : "";
    find("#bar div").append(label);
  }
  const rows = (message.calibration || []).map((cells) => `<tr>${cells.map((cell) => `<td>${escape(cell)}</td>`).join("")}</tr>`);
  find("#facts").innerHTML = rows.length ? `<table>${rows.join("")}</table>` : '<span class="quiet-text">The wall was not measured: the rig is assumed. Measure it with <code>nlos-cam calibrate --wall</code>.</span>';
  fillSelect(find("#other select"), []);
}

const escape = (text) => String(text).replace(/[&<>"]/g, (sign) => `&#${sign.charCodeAt(0)};`);

// Options [value, text]; the present choice stays if it can.
function fillSelect(select, options) {
  const wanted = JSON.stringify(options);
  if (select.dataset.options === wanted) return;
  const value = select.value;
  select.dataset.options = wanted;
  select.innerHTML = options.map(([name, text]) => `<option value="${escape(name)}">${escape(text)}</option>`).join("");
  if (options.some(([name]) => name === value)) select.value = value;
}

function title(id, html) {
  const box = find(`${id} figcaption`);
  if (box.innerHTML !== html) box.innerHTML = html;
}

function caption(id, text) {
  find(`${id} small`).textContent = text;
}

function drawMoment() {
  const moment = state.moment;
  if (!moment || !pictures) return;
  const { depth, truth, error, surface, lidar, infrared, change, residual } = moment.arrays;
  find("#verdict").className = moment.tone;
  find("#headline").textContent = moment.headline;
  find("#detail").textContent = moment.detail;
  find("#warnings").textContent = [...(state.status.warnings || []), ...moment.warnings].join(" · ");
  pictures.hidden(find("#found"), depth, moment);
  caption("#found", surface ? "lines: 20, 50, 80 % surface" : "");
  const places = truth ? ["#error", "#surface"] : ["#truth", "#wrong"]; // without a truth they take its place
  find("#errors").hidden = !truth || !error;
  if (truth) {
    title("#truth", "Truth (simulated)");
    pictures.hidden(find("#truth"), truth, null);
    title("#wrong", `Difference ${pictures.swatch("signed")} ±${DIFFERENCE_SPAN_CM} cm`);
    const { overlap, errorMm } = pictures.difference(find("#wrong"), depth, truth);
    const box = (rgb) => `<i style="width: 9px; background: rgb(${rgb})"></i>`;
    find("#wrong small").innerHTML = `outline ${(100 * overlap).toFixed(0)} %, ${errorMm.toFixed(0)} mm ${box(INVENTED)} extra ${box(MISSED)} missing`;
  }
  if (!truth && !error) for (const id of places) title(id, "no truth, no estimate of the error");
  if (error) {
    title(places[0], `Error ${pictures.swatch("error")} 0 to ${MAX_ERROR_MM} mm`);
    pictures.error(find(places[0]), error);
    caption(places[0], "expected, if there is a surface");
  }
  if (surface) {
    title(places[1], `Surface ${pictures.swatch("grey")} 0 to 100 %`);
    pictures.probability(find(places[1]), surface);
    caption(places[1], "probability; line: 50 %");
  }
  if (lidar && lidar !== state.lidar) {
    state.lidar = lidar;
    pictures.lidar(find("#depth"), lidar);
    const [near, far] = moment.lidar_span_m.map((each) => (100 * each).toFixed(0));
    title("#depth", `Lidar: depth ${pictures.swatch("lidar")} ${near} to ${far} cm`);
    caption("#depth", "black: no return");
    const [low, high] = pictures.infrared(find("#infrared"), infrared);
    title("#infrared", `Lidar: infrared ${pictures.swatch("grey")} ${low} to ${high} counts`);
  }
  drawOther(change, residual, moment);
  bench.setSurface(pictures.quads(moment, find("#bench select").value));
  state.shown++;
}

function drawOther(change, residual, moment) {
  const maps = [];
  if (change) maps.push(["change", "Change from the bare wall"]);
  if (residual) maps.push(["residual", "Physics check: residual"]);
  for (const [name, title] of Object.entries(state.bench.wall_pictures || {})) maps.push([name, title]);
  fillSelect(find("#other select"), maps.length ? maps : [["", "Physics check: residual"]]);
  const name = find("#other select").value;
  const spans = { change: moment.change_span_m, residual: moment.residual_span_m };
  if (name in spans && moment.arrays[name]) {
    pictures.signed(find("#other"), moment.arrays[name]);
    const score = name === "residual" && moment.score !== null ? `; score ${moment.score.toFixed(2)}` : "";
    caption("#other", `red ${(100 * spans[name]).toFixed(0)} cm nearer, blue farther${score}`);
  } else if (state.bench.arrays[name]) {
    pictures.rgb(find("#other"), state.bench.arrays[name]);
    caption("#other", "");
  } else caption("#other", "first check to come");
}

function showMoment(moment) {
  state.moment = moment;
  plots.add(moment);
  find("#note").hidden = true;
  drawMoment();
}

// ---- status ---------------------------------------------------------------------------------------------------

function setStatus(status) {
  const kept = status.state === "ended" || status.state === "no connection" ? state.status : {};
  state.status = { ...kept, ...status };
  state.statusAt = performance.now();
  if (state.status.control) controls.update(state.status.control);
  drawStatus();
}

function seconds(value) {
  const whole = Math.floor(value);
  return whole < 60 ? `${whole} s` : `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}

function drawStatus() {
  const now = state.status, since = (performance.now() - state.statusAt) / 1000, parts = [];
  const live = mode === "live" && !["ended", "no connection"].includes(now.state);
  if (now.state === "no connection" && state.statusAt) now.message = now.message || "";
  const word = live && state.statusAt && since > 4 ? "no answer" : now.state;
  parts.push(`<b class="${word === "running" ? "" : "on"}">${escape(mode === "live" ? word : mode === "session" ? "saved session" : now.state)}</b>`);
  if (now.message) parts.push(escape(now.message));
  if (now.camera) parts.push(`<b>${escape(now.camera)}</b>`);
  if (live && now.fps !== undefined) {
    parts.push(`<b>${now.fps.toFixed(1)}</b> frames/s`);
    parts.push(`latency <b>${now.p50_ms.toFixed(0)}</b> ms, p99 <b>${now.p99_ms.toFixed(0)}</b> ms`);
    if (now.camera_ms) parts.push(`simulation <b>${now.camera_ms.toFixed(0)}</b> ms`);
    parts.push(`newest frame <b>${(now.age_s + since).toFixed(1)}</b> s old`);
  }
  if (now.dropped !== undefined) parts.push(`dropped <b>${now.dropped}</b>`);
  const celsius = Object.values((state.moment && state.moment.celsius) || {});
  if (celsius.length) parts.push(`<b>${Math.max(...celsius).toFixed(0)}</b> °C`);
  if (now.recording) parts.push(`<b class="on">● REC ${seconds(now.recording.seconds + (live ? since : 0))}</b>`);
  if (now.disk_s !== undefined) parts.push(`disk for <b>${(now.disk_s / 60).toFixed(0)}</b> min`);
  if (state.moment) parts.push(`frame <b>${state.moment.frame}</b>`);
  find("#status").innerHTML = parts.map((part) => `<span>${part}</span>`).join("");
  const over = { "no connection": "No connection", "no answer": "No answer", ended: "The run has ended", stalled: "Camera stalled", paused: "Paused" }[word];
  if (mode !== "session" && over && state.moment) {
    find("#verdict").className = word === "paused" ? "quiet" : "alarm";
    find("#headline").textContent = over;
    find("#detail").textContent = now.message || (word === "paused" ? "the pictures stand still" : "the pictures are old");
  }
  if (!state.moment) {
    find("#note").hidden = false;
    find("#note").textContent = mode === "session" ? "Loading the session…" : `${word === "ended" ? "The run has ended" : now.state}${now.message ? `: ${now.message}` : "…"}`;
  }
}

// ---- controls -------------------------------------------------------------------------------------------------

async function command(name, values = {}) {
  find("#answer").className = "quiet-text";
  state.answer = find("#answer").textContent = `${name}…`;
  try {
    const headers = { "Content-Type": "application/json", "X-Token": token };
    const answer = await fetch("command", { method: "POST", headers, body: JSON.stringify({ command: name, ...values }) });
    const text = (await answer.text()).trim();
    if (!answer.ok) throw new Error(text);
    state.answer = find("#answer").textContent = text;
  } catch (error) {
    find("#answer").className = "failed";
    state.answer = find("#answer").textContent = `${name}: ${error.message}`;
  }
}

const controls = {
  shape: "",
  update(given) {
    const shape = JSON.stringify([given.commands, given.options.map((each) => each.name)]);
    if (shape !== this.shape) this.build(given, (this.shape = shape));
    const set = (id, value) => { const box = find(id); if (box && document.activeElement !== box) box.value = value; };
    const text = (id, value) => { const box = find(id); if (box) box.textContent = value; };
    text("#record", given.recording ? "Stop recording" : "Record");
    text("#session", given.saving ? "End session" : "Save session");
    text("#pause", given.paused ? "Go on" : "Pause");
    set("#average", given.average);
    for (const option of given.options) set(`#option-${option.name}`, option.value);
  },
  build(given) {
    const has = (name) => given.commands.includes(name), button = (id, text, title) => `<button id="${id}" title="${title}">${text}</button>`;
    const rows = [];
    if (has("record")) rows.push(`<div class="row"><span>Record</span><input id="label" type="text" placeholder="label" maxlength="60" aria-label="label" />${button("record", "Record", "the camera's streams, as a .bag")}${button("session", "Save session", "this page with its pictures, as one .html file")}${button("snapshot", "Snapshot", "this frame as picture, arrays and mesh")}</div>`);
    if (has("pause")) rows.push(`<div class="row"><span>Run</span>${button("pause", "Pause", "stop reconstructing; the camera and a recording go on")}${button("reference", "Take empty bench as reference", "average 60 frames of the bench with nothing hidden")}<span class="quiet-text">average</span><input id="average" type="number" min="1" max="1000" aria-label="frames to average" title="the mean of this many frames; moving objects blur" /><span class="quiet-text">frames</span></div>`);
    for (const each of given.options) rows.push(`<div class="row"><span>${escape(each.name.replaceAll("_", " "))}</span><input id="option-${each.name}" data-option="${each.name}" type="number" min="${each.min}" max="${each.max}" step="${each.step}" /> <span class="quiet-text">${each.min} to ${each.max}</span></div>`);
    if (given.note) rows.push(`<div class="row quiet-text">${escape(given.note)}</div>`);
    find("#controls").innerHTML = `${rows.join("")}<div id="answer" class="quiet-text" role="status"></div>`;
    const on = (id, event, act) => find(id) && find(id).addEventListener(event, act);
    on("#record", "click", () => (find("#record").textContent === "Record" ? command("record", { label: find("#label").value }) : command("stop_recording")));
    on("#session", "click", () => command(find("#session").textContent === "Save session" ? "save_session" : "end_session"));
    on("#snapshot", "click", () => command("snapshot"));
    on("#pause", "click", () => command(find("#pause").textContent === "Pause" ? "pause" : "resume"));
    on("#reference", "click", () => command("take_reference"));
    on("#average", "change", (event) => command("average", { frames: Number(event.target.value) }));
    for (const box of document.querySelectorAll("[data-option]"))
      box.addEventListener("change", () => command("option", { name: box.dataset.option, value: Number(box.value) }));
    if (!token) {
      for (const box of document.querySelectorAll("#controls button, #controls input, #controls select")) box.disabled = true;
      find("#answer").textContent = "Read-only: open the address that the program printed, with its token, to control.";
    }
  },
};

for (const tab of document.querySelectorAll("#tabs button"))
  tab.addEventListener("click", () => {
    for (const each of document.querySelectorAll("#tabs button")) {
      each.setAttribute("aria-selected", each === tab);
      find(`#${each.dataset.panel}`).classList.toggle("shown", each === tab);
    }
    plots.draw();
  });
for (const select of document.querySelectorAll("figure select, #bench select")) select.addEventListener("change", drawMoment);

// ---- plots ----------------------------------------------------------------------------------------------------

const plots = {
  history: [],
  colors: ["#ebf0f5", "#5aaaff", "#ffbe5a", "#50dc78", "#e678dc", "#78dcdc"],
  add(moment) {
    const last = this.history.at(-1);
    if (last && (moment.time_s < last.time || moment.time_s - last.time > 30)) this.history = [];
    const { wait, ...stages } = moment.stages_ms;
    this.history.push({ time: moment.time_s, "Latency (ms)": { total: moment.latency_ms, ...stages }, "Temperature (°C)": moment.celsius, "Frames lost": { lost: moment.dropped }, "Physics score": moment.score === null ? {} : { score: moment.score } });
    if (this.history.length > 300) this.history.shift();
    if (find("#plots").classList.contains("shown")) this.draw();
  },
  draw() {
    if (!find("#plots").classList.contains("shown") || !this.history.length) return;
    if (!find("#plots canvas")) find("#plots").innerHTML = ["Latency (ms)", "Temperature (°C)", "Frames lost", "Physics score"].map((name) => `<div>${name} <span class="legend"></span><canvas data-name="${name}"></canvas></div>`).join("");
    for (const canvas of document.querySelectorAll("#plots canvas")) this.plot(canvas, canvas.dataset.name);
  },
  plot(canvas, name) {
    const series = Object.keys(this.history.at(-1)[name]), width = (canvas.width = canvas.clientWidth), height = (canvas.height = canvas.clientHeight);
    const pen = canvas.getContext("2d"), values = this.history.flatMap((each) => Object.values(each[name]));
    const high = Math.max(...values, 1e-3) * 1.1, low = name.startsWith("Temp") ? Math.min(...values) - 1 : 0;
    const t0 = this.history[0].time, span = Math.max(this.history.at(-1).time - t0, 1e-3);
    const x = (time) => 34 + ((width - 38) * (time - t0)) / span, y = (value) => height - 12 - ((height - 18) * (value - low)) / Math.max(high - low, 1e-6);
    pen.fillStyle = "#8c98a0";
    pen.font = "11px system-ui";
    pen.fillText(high.toPrecision(2), 0, 10);
    pen.fillText(low.toPrecision(2), 0, height - 10);
    pen.fillText(`last ${span.toFixed(0)} s`, width - 60, height - 1);
    pen.strokeStyle = "#2a3237";
    pen.strokeRect(33.5, 4.5, width - 38, height - 16);
    canvas.parentElement.querySelector(".legend").innerHTML = series.map((each, k) => `<span style="color:${this.colors[k % 6]}">${escape(each.replaceAll("_", " "))}</span>`).join(" ");
    series.forEach((each, k) => {
      pen.beginPath();
      for (const point of this.history) if (each in point[name]) pen.lineTo(x(point.time), y(point[name][each]));
      pen.strokeStyle = this.colors[k % 6];
      pen.stroke();
    });
  },
};

// ---- player ---------------------------------------------------------------------------------------------------

const player = {
  chunks: [], times: [], cache: new Map(), at: 0, playing: false, wanted: -1, shown: -1,
  clear() {
    Object.assign(this, { chunks: [], times: [], cache: new Map(), at: 0, wanted: -1, shown: -1 });
  },
  add(message) {
    message.times_s.forEach((time, k) => this.times.push([time, this.chunks.length, k]));
    this.chunks.push(message.arrays.data.data);
    find("#time").max = this.times.at(-1)[0];
    if (this.chunks.length === 1) this.seek(0);
    this.tell();
  },
  async moments(index) {
    if (!this.cache.has(index)) {
      const stream = new Blob([this.chunks[index]]).stream().pipeThrough(new DecompressionStream("deflate"));
      const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
      this.cache.set(index, split(bytes)[0].map(decode));
      if (this.cache.size > 12) this.cache.delete(this.cache.keys().next().value);
    }
    return this.cache.get(index);
  },
  // Show the last moment at or before a time.
  async seek(time) {
    this.at = time;
    let low = 0, high = this.times.length - 1;
    while (low < high) { const middle = (low + high + 1) >> 1; this.times[middle][0] <= time + 1e-6 ? (low = middle) : (high = middle - 1); }
    this.tell();
    if (low === this.wanted || !this.times.length) return;
    this.wanted = low;
    const [, chunk, place] = this.times[low], moments = await this.moments(chunk);
    if (this.wanted !== low) return; // a later one was wanted meanwhile
    let lidar = place;
    while (lidar > 0 && !moments[lidar].arrays.lidar) lidar--;
    const moment = moments[place]; // its lidar's pictures are those of an earlier moment of the chunk
    this.shown = low;
    showMoment({ ...moment, arrays: { ...moments[lidar].arrays, ...moment.arrays } });
    drawStatus();
  },
  tell() {
    const end = this.times.length ? this.times.at(-1)[0] : 0;
    find("#clock").textContent = `${this.at.toFixed(1)} of ${end.toFixed(1)} s${state.status.message ? ` (${state.status.message})` : ""}`;
    if (document.activeElement !== find("#time")) find("#time").value = this.at;
    find("#play").textContent = this.playing ? "Pause" : "Play";
  },
  toggle() {
    const end = this.times.length ? this.times.at(-1)[0] : 0;
    this.playing = !this.playing;
    if (this.playing && this.at >= end) this.at = 0;
    let before = performance.now();
    const step = (now) => {
      if (!this.playing) return;
      const last = this.times.at(-1)[0], next = this.at + ((now - before) / 1000) * Number(find("#speed").value);
      before = now;
      if (next >= last && mode !== "recorded") this.playing = false;
      this.seek(Math.min(next, last));
      requestAnimationFrame(step);
    };
    if (this.playing) requestAnimationFrame(step);
    this.tell();
  },
  // The frame's depth map and picture as files, made by the browser itself.
  save() {
    const { moment } = state, { depth, error } = moment.arrays, lines = ["row,column,depth_m,expected_error_m"];
    for (let i = 0; i < depth.data.length; i++)
      if (depth.data[i]) lines.push([Math.floor(i / depth.columns), i % depth.columns, (pictures.cm(depth.data[i]) / 100).toFixed(4), error ? ((error.data[i] * pictures.errorStepMm) / 1000).toFixed(5) : ""].join(","));
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([lines.join("\n") + "\n"], { type: "text/csv" }));
    link.download = `frame-${String(moment.frame).padStart(6, "0")}.csv`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  },
};
find("#play").addEventListener("click", () => player.toggle());
find("#time").addEventListener("input", (event) => { player.playing = false; player.seek(Number(event.target.value)); });
find("#time").addEventListener("change", (event) => event.target.blur());
find("#save").addEventListener("click", () => (state.status.controls ? command("export", { frame: state.moment.frame }) : player.save()));

// ---- start ----------------------------------------------------------------------------------------------------

document.body.classList.toggle("recorded", mode !== "live");
find(`#tabs [data-panel="${mode === "session" ? "plots" : "controls"}"]`).click();
if (mode === "session") {
  find('#tabs [data-panel="controls"]').hidden = true;
  addEventListener("DOMContentLoaded", () => {
    for (const element of document.querySelectorAll('script[type="text/x-message"]'))
      try {
        handle(decode(Uint8Array.from(atob(element.textContent), (sign) => sign.charCodeAt(0))));
        element.remove();
      } catch { break; } // the last one of a killed run is cut
    state.statusAt = performance.now();
    drawStatus();
  });
} else follow();
setInterval(drawStatus, 250);
// For tests, and for the curious: what the page shows now.
window.nlos = {
  state: () => ({
    mode, frame: state.moment && state.moment.frame, time_s: state.moment && state.moment.time_s, shown: state.shown, verdict: state.moment && state.moment.verdict, headline: find("#headline").textContent, detail: find("#detail").textContent,
    status: state.status, statusText: find("#status").textContent, answer: state.answer, note: find("#note").hidden ? "" : find("#note").textContent, arrays: state.moment ? Object.keys(state.moment.arrays).filter((name) => state.moment.arrays[name]) : [], labels: bench.labels,
    quads: bench.quads.length, at: player.at, end: player.times.length ? player.times.at(-1)[0] : 0, playing: player.playing,
  }),
};
