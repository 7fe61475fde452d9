"use strict";
// The point under the pointer: its values, its marks in all maps and on the bench, and the distance between two.

const POINT_HINT = "Point at a map for its values; a click enlarges it.";
const HIDDEN_MAPS = ["#found", "#truth", "#wrong", "#error", "#surface"];
const LIDAR_MAPS = ["#depth", "#infrared", "#other"];

class Inspector {
  // `read(point)` gives the texts of a point; `pointOf(family, u, v)` its place in the wall frame.
  constructor(read, pointOf, bench) {
    Object.assign(this, { read, pointOf, bench });
    this.pointed = null; // {family: "hidden" or "lidar", u, v}: shares of the map's width and height
    this.ends = [];
    this.measuring = false;
    for (const figure of document.querySelectorAll("figure.map")) this.listen(figure);
    find("#measure").addEventListener("click", () => this.toggleMeasure());
    addEventListener("resize", () => this.draw());
    this.draw();
  }

  listen(figure) {
    const family = HIDDEN_MAPS.includes(`#${figure.id}`) ? "hidden" : "lidar";
    const box = figure.querySelector("div");
    box.tabIndex = 0;
    box.setAttribute("role", "group");
    box.addEventListener("pointermove", (event) => this.point(this.at(figure, family, event)));
    box.addEventListener("pointerleave", () => this.point(null));
    box.addEventListener("click", (event) => {
      if (this.measuring) this.addEnd(this.at(figure, family, event));
      else this.enlarge(figure);
    });
    box.addEventListener("keydown", (event) => {
      if (!this.key(figure, family, event.key)) return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  // The picture's own place in its box: it is fitted into it.
  frame(figure) {
    const box = figure.querySelector("div");
    const canvas = figure.querySelector("canvas");
    const { clientWidth: width, clientHeight: height } = box;
    const scale = Math.min(width / canvas.width, height / canvas.height);
    const [wide, high] = [scale * canvas.width, scale * canvas.height];
    return { left: (width - wide) / 2, top: (height - high) / 2, wide, high };
  }

  at(figure, family, event) {
    const { left, top, wide, high } = this.frame(figure);
    const box = figure.querySelector("div").getBoundingClientRect();
    const u = (event.clientX - box.left - left) / wide;
    const v = (event.clientY - box.top - top) / high;
    return u >= 0 && u < 1 && v >= 0 && v < 1 ? { family, u, v } : null;
  }

  // Arrow keys move the point, Enter enlarges, M takes an end of a measurement.
  key(figure, family, key) {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (key in steps) {
      const last = this.pointed && this.pointed.family === family ? this.pointed : { u: 0.5, v: 0.5 };
      const inside = (value) => Math.min(0.999, Math.max(0, value));
      const [right, down] = steps[key];
      this.point({ family, u: inside(last.u + right / 64), v: inside(last.v + down / 64) });
      find("#spoken").textContent = this.text();
    } else if (key === "Enter") this.enlarge(figure);
    else if ((key === "m" || key === "M") && this.pointed) this.addEnd(this.pointed);
    else return false;
    return true;
  }

  point(pointed) {
    this.pointed = pointed;
    this.draw();
  }

  toggleMeasure() {
    this.measuring = !this.measuring;
    this.ends = [];
    find("#measure").setAttribute("aria-pressed", this.measuring);
    this.draw();
  }

  addEnd(end) {
    if (!end) return;
    this.ends = this.ends.length === 2 ? [end] : [...this.ends, end];
    this.measuring = true;
    find("#measure").setAttribute("aria-pressed", true);
    this.draw();
  }

  enlarge(figure) {
    const others = [...document.querySelectorAll("figure.large")].filter((each) => each !== figure);
    for (const other of others) other.classList.remove("large");
    figure.classList.toggle("large");
    find("#readout").classList.toggle("over", figure.classList.contains("large"));
    this.draw();
  }

  // Close what is open; return whether there was anything.
  close() {
    const large = find("figure.large");
    if (large) this.enlarge(large);
    else if (this.measuring) this.toggleMeasure();
    else return false;
    return true;
  }

  place(end) {
    return this.pointOf(end.family, end.u, end.v);
  }

  text() {
    const parts = [];
    if (this.measuring) parts.push(this.distance());
    if (this.pointed) parts.push(...this.read(this.pointed));
    return parts.filter(Boolean).join(" · ") || POINT_HINT;
  }

  distance() {
    const points = this.ends.map((end) => this.place(end));
    if (points.includes(null)) return "no distance: there is no surface at one of the points";
    if (points.length < 2) return points.length ? "Click the second point" : "Click two points of the maps";
    const [a, b] = points;
    const cm = 100 * Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
    return `distance ${cm.toFixed(1)} cm`;
  }

  // Marks in every map of the point's family and on the bench, and the values in words.
  draw() {
    for (const old of document.querySelectorAll(".mark")) old.remove();
    const marks = [...this.ends.map((end) => ({ ...end, end: true })), ...(this.pointed ? [this.pointed] : [])];
    for (const mark of marks)
      for (const id of mark.family === "hidden" ? HIDDEN_MAPS : LIDAR_MAPS) this.mark(find(id), mark);
    const placed = marks.map((mark) => ({ point: this.place(mark), end: mark.end }));
    this.bench.setMarks(placed.filter((mark) => mark.point));
    find("#readout output").textContent = this.text();
  }

  mark(figure, { u, v, end }) {
    const { left, top, wide, high } = this.frame(figure);
    const mark = document.createElement("b");
    mark.className = end ? "mark end" : "mark";
    mark.style.left = `${left + u * wide}px`;
    mark.style.top = `${top + v * high}px`;
    figure.querySelector("div").append(mark);
  }
}
