"use strict";
// Player of recorded moments, and the moments that a live page keeps for when its run has ended.

const KEPT_S = 60;
const CHUNK_MOMENTS = 12;
const CACHED_CHUNKS = 12;
// In pieces, so that no reader of this script takes them for elements.
const SESSION_MARK = ["<!", "-- nlos-cam session --", ">"].join("");
const [MESSAGE_START, MESSAGE_END] = [["<", 'script type="text/x-message">'].join(""), ["</", "script>\n"].join("")];

const player = {
  chunks: [], // each compressed, or a list of moments
  times: [],
  cache: new Map(),
  at: 0,
  playing: false,
  dragged: false,
  wanted: -1,

  clear() {
    Object.assign(this, { chunks: [], times: [], cache: new Map(), at: 0, wanted: -1, playing: false });
  },

  add(message) {
    message.times_s.forEach((time, k) => this.times.push([time, this.chunks.length, k]));
    this.chunks.push(message.arrays.data.data);
    find("#time").max = this.end();
    if (this.chunks.length === 1) this.seek(0);
    this.tell();
  },

  // Take moments that the page still holds.
  take(moments) {
    this.clear();
    this.chunks = [moments];
    this.times = moments.map((moment, k) => [moment.time_s - moments[0].time_s, 0, k]);
    this.at = this.end();
    find("#time").max = this.at;
    this.tell();
  },

  end() {
    return this.times.length ? this.times.at(-1)[0] : 0;
  },

  async moments(index) {
    if (Array.isArray(this.chunks[index])) return this.chunks[index];
    const { cache } = this; // `clear` begins another one, for another recording
    if (!cache.has(index)) {
      const stream = new Blob([this.chunks[index]]).stream().pipeThrough(new DecompressionStream("deflate"));
      const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
      const moments = split(bytes)[0].map(decode);
      cache.set(index, moments);
      if (cache.size > CACHED_CHUNKS) cache.delete(cache.keys().next().value);
      return moments;
    }
    return cache.get(index);
  },

  // Number of the last moment at or before a time.
  numberAt(time) {
    let low = 0;
    let high = this.times.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.times[middle][0] <= time + 1e-6) low = middle;
      else high = middle - 1;
    }
    return low;
  },

  async seek(time) {
    this.at = time;
    const number = this.numberAt(time);
    this.tell();
    if (number === this.wanted || !this.times.length) return;
    this.wanted = number;
    const [, chunk, place] = this.times[number];
    const moments = await this.moments(chunk);
    if (this.wanted !== number) return; // a later one was wanted meanwhile
    let lidar = place;
    while (lidar > 0 && !moments[lidar].arrays.lidar) lidar--;
    const moment = moments[place]; // its lidar's pictures are those of an earlier moment of the chunk
    showMoment({ ...moment, arrays: { ...moments[lidar].arrays, ...moment.arrays } });
    drawStatus();
  },

  // Go some moments on or back, and pause.
  step(count) {
    if (!this.times.length) return;
    this.playing = false;
    const number = Math.min(Math.max(this.numberAt(this.at) + count, 0), this.times.length - 1);
    this.seek(this.times[number][0]);
  },

  tell() {
    const message = state.status.state === "playback" ? state.status.message : "";
    find("#clock").textContent = `${this.at.toFixed(1)} of ${this.end().toFixed(1)} s${message ? ` (${message})` : ""}`;
    const slider = find("#time");
    if (!this.dragged) slider.value = this.at;
    slider.setAttribute("aria-valuetext", `${this.at.toFixed(1)} of ${this.end().toFixed(1)} s`);
    find("#play").textContent = this.playing ? "Pause" : "Play";
  },

  toggle() {
    this.playing = !this.playing && this.times.length > 0;
    if (this.playing && this.at >= this.end()) this.at = 0;
    let before = performance.now();
    const step = (now) => {
      if (!this.playing) return;
      const next = this.at + ((now - before) / 1000) * Number(find("#speed").value);
      before = now;
      if (next >= this.end() && !this.grows()) this.playing = false;
      this.seek(Math.min(next, this.end()));
      requestAnimationFrame(step);
    };
    if (this.playing) requestAnimationFrame(step);
    this.tell();
  },

  // Whether more moments are to come: the program reconstructs, or has not said that it is done.
  grows() {
    const { state: word, message } = state.status;
    return mode === "recorded" && (word === "connecting" || (word === "playback" && Boolean(message)));
  },

  // The frame's depth map as a file, made by the browser itself.
  save() {
    const { moment } = state;
    const { depth, error } = moment.arrays;
    const lines = ["row,column,depth_m,expected_error_m"];
    for (let i = 0; i < depth.data.length; i++) {
      if (!depth.data[i]) continue;
      const depthM = (pictures.cm(depth.data[i]) / 100).toFixed(4);
      const errorM = error ? ((error.data[i] * pictures.errorStepMm) / 1000).toFixed(5) : "";
      lines.push([Math.floor(i / depth.columns), i % depth.columns, depthM, errorM].join(","));
    }
    const name = `frame-${String(moment.frame).padStart(6, "0")}.csv`;
    download(new Blob([`${lines.join("\n")}\n`], { type: "text/csv" }), name);
    tellAnswer(`${name} is in this browser's downloads`);
  },
};

// What a live page saw last: it can be played and saved when the run has ended.
const kept = {
  bench: null,
  moments: [],

  add(moment) {
    const last = this.moments.at(-1);
    if (last && moment.time_s === last.time_s) return; // sent again to a page that came back
    if (last && moment.time_s < last.time_s) this.clear(); // the time began anew, with another bench
    this.moments.push(moment);
    while (moment.time_s - this.moments[0].time_s > KEPT_S) this.moments.shift();
  },

  clear() {
    this.moments = [];
  },

  seconds() {
    return this.moments.length ? this.moments.at(-1).time_s - this.moments[0].time_s : 0;
  },

  // A saved session, as `live --save-view` writes one.
  async session() {
    const parts = [`<!doctype html>\n${SESSION_MARK}\n${source.replace('data-mode="live"', 'data-mode="session"')}`];
    parts.push(element(this.bench));
    for (let at = 0; at < this.moments.length; at += CHUNK_MOMENTS)
      parts.push(element(await this.chunk(this.moments.slice(at, at + CHUNK_MOMENTS))));
    return new Blob(parts, { type: "text/html" });
  },

  async chunk(moments) {
    const stream = new Blob(moments.map((moment) => moment.raw)).stream().pipeThrough(new CompressionStream("deflate"));
    const data = new Uint8Array(await new Response(stream).arrayBuffer());
    const times_s = moments.map((moment) => moment.time_s - this.moments[0].time_s);
    const arrays = { data: [0, data.length] };
    const head = new TextEncoder().encode(JSON.stringify({ kind: "chunk", times_s, arrays }));
    const message = new Uint8Array(8 + head.length + data.length);
    const view = new DataView(message.buffer);
    view.setUint32(0, 4 + head.length + data.length, true);
    view.setUint32(4, head.length, true);
    message.set(head, 8);
    message.set(data, 8 + head.length);
    return message;
  },
};

function element(message) {
  let text = "";
  for (let at = 0; at < message.length; at += 32768) text += String.fromCharCode(...message.subarray(at, at + 32768));
  return MESSAGE_START + btoa(text) + MESSAGE_END;
}

function download(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
