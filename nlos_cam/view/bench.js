"use strict";
// Drawing of the bench in 3D on a 2D canvas: wall frame in metres, perspective, parts sorted from far to near.

class Bench {
  constructor(host) {
    this.host = host;
    this.canvas = host.querySelector("canvas");
    this.parts = null;
    this.quads = [];
    this.labels = [];
    this.marks = [];
    this.reset();
    this.listen();
    new ResizeObserver(() => this.draw()).observe(host);
  }

  reset() {
    Object.assign(this, { yaw: -0.46, pitch: 0.48, away: 1.15 });
  }

  listen() {
    const pointers = new Map();
    const spread = () => {
      const [a, b] = [...pointers.values()];
      return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
    };
    this.canvas.addEventListener("pointerdown", (event) => {
      pointers.set(event.pointerId, event);
      this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener("pointermove", (event) => {
      const last = pointers.get(event.pointerId);
      if (!last) return;
      const before = pointers.size === 2 ? spread() : 0;
      pointers.set(event.pointerId, event);
      if (pointers.size === 2) this.zoom(before / Math.max(spread(), 1));
      else {
        this.yaw -= (event.clientX - last.clientX) * 0.008;
        this.pitch = Math.min(1.5, Math.max(-1.5, this.pitch + (event.clientY - last.clientY) * 0.008));
      }
      this.draw();
    });
    for (const name of ["pointerup", "pointercancel"])
      this.canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY * 0.001));
      this.draw();
    }, { passive: false });
    this.canvas.addEventListener("dblclick", () => {
      this.reset();
      this.draw();
    });
    this.canvas.addEventListener("keydown", (event) => {
      if (!this.key(event.key)) return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  // Turn, zoom or reset by a key; return false for another key.
  key(key) {
    const turns = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
    const zooms = { "+": 0.9, "=": 0.9, "-": 1.1 };
    if (key in turns) {
      this.yaw += turns[key][0];
      this.pitch = Math.min(1.5, Math.max(-1.5, this.pitch + turns[key][1]));
    } else if (key in zooms) this.zoom(zooms[key]);
    else if (key === "0") this.reset();
    else return false;
    this.draw();
    return true;
  }

  zoom(factor) {
    this.away = Math.min(5, Math.max(0.3, this.away * factor));
  }

  setBench(parts, box) {
    this.parts = parts;
    this.box = box;
    this.middle = [box[1] / 2 + 0.03, 0, parts.lidar[2] / 2 + 0.04];
    this.draw();
  }

  // Quads of the hidden surface: {corners: [[x, y, z] x 4], rgb}.
  setSurface(quads) {
    this.quads = quads;
    this.draw();
  }

  // Points to mark: {point: [x, y, z], color}; two ends of a measurement are joined.
  setMarks(marks) {
    this.marks = marks;
    this.draw();
  }

  drawMarks() {
    const ends = this.marks.filter((mark) => mark.end);
    if (ends.length === 2) this.line(ends.map((mark) => mark.point), "#ffd250", 2, [5, 4]);
    for (const { point, end } of this.marks) {
      const [x, y] = this.project(point);
      this.pen.beginPath();
      this.pen.arc(x, y, 6, 0, 7);
      this.pen.strokeStyle = "#0d1011";
      this.pen.lineWidth = 5;
      this.pen.stroke();
      this.pen.strokeStyle = end ? "#ffd250" : "#ffffff";
      this.pen.lineWidth = 2;
      this.pen.stroke();
    }
  }

  // Perspective from a point on a sphere about the middle; returns [x, y, distance] in pixels.
  look(width, height) {
    const { yaw, pitch, away, middle } = this;
    const back = [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)];
    const right = [Math.cos(yaw), 0, -Math.sin(yaw)];
    const up = [-Math.sin(yaw) * Math.sin(pitch), Math.cos(pitch), -Math.cos(yaw) * Math.sin(pitch)];
    const focal = Math.min(width, height * 1.1) * 1.34;
    const eye = middle.map((value, i) => value + away * back[i]);
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    this.eye = eye;
    return (point) => {
      const from = point.map((value, i) => value - eye[i]);
      const distance = Math.max(-dot(from, back), 0.02);
      return [width / 2 + focal * dot(from, right) / distance, height / 2 - focal * dot(from, up) / distance, distance];
    };
  }

  draw() {
    const scale = window.devicePixelRatio || 1, width = this.host.clientWidth, height = this.host.clientHeight;
    if (!this.parts || !width || !height) return;
    if (this.canvas.width !== Math.round(width * scale) || this.canvas.height !== Math.round(height * scale)) {
      this.canvas.width = Math.round(width * scale);
      this.canvas.height = Math.round(height * scale);
    }
    const pen = (this.pen = this.canvas.getContext("2d"));
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    this.project = this.look(width, height);
    this.labels = [];
    const { parts } = this, [x0, x1, y0, y1, z0, z1] = this.box;
    this.area(parts.wall, "rgba(120,130,140,0.30)");
    if (parts.footprint) this.line(parts.footprint, "#f0f0f0", 1.2);
    this.boxEdges([x0, x1], [y0, y1], [z0, z1]);
    const drawOccluder = () => parts.occluder && this.area(parts.occluder, "rgba(90,150,255,0.34)", "#5a96ff");
    const occluderInFront = parts.occluder && this.eye[0] < parts.occluder[0][0];
    if (!occluderInFront) drawOccluder();
    this.surface();
    if (occluderInFront) drawOccluder();
    this.frustum();
    this.light();
    this.name("relay wall", [parts.wall[2][0], parts.wall[2][1], 0], -42, 12);
    if (parts.occluder) this.name("occluder", parts.occluder[2], 0, -9);
    this.name("object box", [x1, y0, z1], 0, 12);
    if (this.quads.length) this.name("hidden surface", this.quads[0].corners[0], 24, -14, "#ffd27a");
    this.name("lidar", parts.lidar, -22, 14, "#ff8f7d");
    this.drawMarks();
  }

  area(corners, fill, stroke) {
    const { pen } = this;
    pen.beginPath();
    for (const corner of corners) pen.lineTo(...this.project(corner).slice(0, 2));
    pen.closePath();
    pen.fillStyle = fill;
    pen.fill();
    if (stroke) { pen.strokeStyle = stroke; pen.lineWidth = 1; pen.stroke(); }
  }

  line(points, color, width, dash = []) {
    const { pen } = this;
    pen.beginPath();
    for (const point of points) pen.lineTo(...this.project(point).slice(0, 2));
    pen.setLineDash(dash);
    pen.strokeStyle = color;
    pen.lineWidth = width;
    pen.stroke();
    pen.setLineDash([]);
  }

  boxEdges(xs, ys, zs) {
    for (const a of [0, 1]) for (const b of [0, 1]) {
      this.line([[xs[0], ys[a], zs[b]], [xs[1], ys[a], zs[b]]], "#8c98a0", 1);
      this.line([[xs[a], ys[0], zs[b]], [xs[a], ys[1], zs[b]]], "#8c98a0", 1);
      this.line([[xs[a], ys[b], zs[0]], [xs[a], ys[b], zs[1]]], "#8c98a0", 1);
    }
  }

  surface() {
    const { pen } = this;
    const shown = this.quads.map(({ corners, rgb }) => {
      const places = corners.map(this.project);
      return { places, rgb, far: places[0][2] + places[2][2] };
    });
    shown.sort((a, b) => b.far - a.far);
    pen.lineWidth = 0.8;
    for (const { places, rgb } of shown) {
      pen.beginPath();
      for (const [x, y] of places) pen.lineTo(x, y);
      pen.closePath();
      pen.fillStyle = pen.strokeStyle = `rgb(${rgb[0]},${rgb[1]},${rgb[2]})`;
      pen.fill();
      pen.stroke(); // closes the seams between neighbours
    }
  }

  frustum() {
    const { lidar, frustum } = this.parts;
    for (const corner of frustum) this.line([lidar, corner], "#ff6e5a", 1);
    this.line([...frustum, frustum[0]], "#ff6e5a", 1);
    const [x, y] = this.project(lidar);
    this.pen.fillStyle = "#ff6e5a";
    this.pen.fillRect(x - 5, y - 5, 10, 10);
  }

  light() {
    const path = this.parts.light, { pen } = this;
    this.line(path, "#ffd250", 2);
    for (let i = 0; i + 1 < path.length; i++) this.arrow(path[i], path[i + 1]);
    for (const i of [1, 2, 3]) {
      const [x, y] = this.project(path[i]);
      pen.beginPath();
      pen.arc(x, y, 9, 0, 7);
      pen.fillStyle = "#ffd250";
      pen.fill();
      this.text(String(i), x, y, "#0d1011", 12, false);
      this.labels.push(`bounce ${i}`);
    }
  }

  arrow(from, to) {
    const [x, y] = this.project(from.map((value, i) => value + 0.55 * (to[i] - value)));
    const [a, b] = this.project(from), [c, d] = this.project(to), angle = Math.atan2(d - b, c - a), { pen } = this;
    pen.beginPath();
    for (const [along, across] of [[7, 0], [-5, 5], [-5, -5]])
      pen.lineTo(x + along * Math.cos(angle) - across * Math.sin(angle), y + along * Math.sin(angle) + across * Math.cos(angle));
    pen.fillStyle = "#ffd250";
    pen.fill();
  }

  name(text, point, dx, dy, color = "#d6e0e6") {
    const [x, y] = this.project(point), half = text.length * 3.4 + 4;
    const inside = (value, low, high) => Math.min(Math.max(value, low), Math.max(low, high));
    this.text(text, inside(x + dx, half, this.host.clientWidth - half), inside(y + dy, 10, this.host.clientHeight - 28), color, 12);
    this.labels.push(text);
  }

  text(text, x, y, color, size, backed = true) {
    const { pen } = this;
    pen.font = `${backed ? "" : "bold "}${size}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    if (backed) {
      const width = pen.measureText(text).width + 6;
      pen.fillStyle = "rgba(13,16,17,0.7)";
      pen.fillRect(x - width / 2, y - 8, width, 16);
    }
    pen.fillStyle = color;
    pen.fillText(text, x, y);
  }
}
