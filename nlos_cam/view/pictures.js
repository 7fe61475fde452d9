"use strict";
// Pictures from arrays of bytes: color maps, contours, differences, and the quads of the hidden surface.

const INSIDE = [255, 255, 255], MISSED = [90, 170, 255], INVENTED = [255, 140, 60];
const DIFFERENCE_SPAN_CM = 5;
const DARKEST = 60; // where in the color map the farthest surface starts, so that it stands out from the background
const MAX_ERROR_MM = 30;
const GREY = 0.8; // brightness of a certain surface, on which the line at 50 % is seen
const find = (selector) => document.querySelector(selector);
const escape = (text) => String(text).replace(/[&<>"]/g, (sign) => `&#${sign.charCodeAt(0)};`);

class Pictures {
  constructor(bench) {
    this.box = bench.box;
    this.errorStepMm = 1e3 * bench.error_step_m;
    this.ground = bench.background;
    this.maps = { depth: bench.arrays.map_depth, error: bench.arrays.map_error };
    this.fit = null;
    const pale = (rgb) => rgb.map((value) => 0.35 * value + 0.65 * ((rgb[0] + rgb[1] + rgb[2]) / 3));
    this.tables = {
      depth: this.table((byte) => this.depthRgb(byte)),
      faded: this.table((byte) => (byte ? pale(this.depthRgb(byte)) : this.ground)),
      error: this.table((byte) => this.errorRgb(byte)),
      grey: this.table((byte) => Array(3).fill(GREY * byte)),
      lidar: this.table((byte) => this.depthRgb(byte)),
      signed: this.table((byte) => this.signedRgb(byte)),
      signs: this.table((index) => [INSIDE, INVENTED, MISSED][index] || INSIDE),
    };
  }

  color(map, share) {
    const at = 3 * Math.round(255 * Math.min(Math.max(share, 0), 1)), { data } = this.maps[map];
    return [data[at], data[at + 1], data[at + 2]];
  }

  // Distance from the wall in cm of a byte of depth, 1 (near) to 255 (far).
  cm(byte) {
    return 100 * (this.box[4] + ((byte - 1) / 254) * (this.box[5] - this.box[4]));
  }

  // Bright near the wall.
  depthRgb(byte) {
    return byte ? this.color("depth", (DARKEST + (1 - (0.9 * (byte - 1)) / 254) * (255 - DARKEST)) / 255) : this.ground;
  }

  errorRgb(byte) {
    return this.color("error", (byte * this.errorStepMm) / MAX_ERROR_MM);
  }

  signedRgb(byte) {
    if (!byte) return this.ground;
    const share = (byte - 128) / 127, end = share < 0 ? [255, 70, 50] : [60, 155, 255], middle = [52, 58, 62];
    return middle.map((value, i) => value + Math.abs(share) * (end[i] - value));
  }

  // Color of each byte as one number, as a canvas holds it.
  table(rgbAt) {
    const bytes = new Uint8ClampedArray(4 * 256);
    for (let i = 0; i < 256; i++) bytes.set([...rgbAt(i), 255], 4 * i);
    return new Uint32Array(bytes.buffer);
  }

  clear(figure) {
    const canvas = figure.querySelector("canvas");
    canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height);
  }

  // Paint (rows, columns) pixels, scaled by a whole number; `colorAt` gives each one's number from a table.
  paint(figure, rows, columns, colorAt, scale = 1) {
    const canvas = figure.querySelector("canvas");
    const small = (figure.small ||= Object.assign(document.createElement("canvas"), { width: 0 }));
    if (small.width !== columns || small.height !== rows) {
      Object.assign(small, { width: columns, height: rows });
      figure.image = small.getContext("2d").createImageData(columns, rows);
    }
    const pixels = new Uint32Array(figure.image.data.buffer);
    for (let i = 0; i < pixels.length; i++) pixels[i] = colorAt(i);
    small.getContext("2d").putImageData(figure.image, 0, 0);
    if (canvas.width !== columns * scale || canvas.height !== rows * scale) Object.assign(canvas, { width: columns * scale, height: rows * scale });
    const large = canvas.getContext("2d");
    large.imageSmoothingEnabled = false;
    large.drawImage(small, 0, 0, canvas.width, canvas.height);
    return large;
  }

  // Paint an array of bytes by a table of colors.
  bytes(figure, { data, rows, columns }, table, scale = 1) {
    return this.paint(figure, rows, columns, (i) => table[data[i]], scale);
  }

  hidden(figure, depth, moment) {
    const pen = this.bytes(figure, depth, moment && !moment.trusted ? this.tables.faded : this.tables.depth, 8);
    if (moment && moment.arrays.surface)
      for (const [level, dash, width] of [[51, [4, 4], 1.5], [128, [], 2.5], [204, [10, 4], 1.5]])
        contour(pen, moment.arrays.surface, level, 8, dash, width);
  }

  // Red: reconstructed nearer to the wall than the truth; blue: farther; where only one has a surface, its own
  // color and hatch.
  difference(figure, depth, truth) {
    const step = this.cm(2) - this.cm(1);
    const { signed, signs } = this.tables;
    const perCount = (127 * step) / DIFFERENCE_SPAN_CM;
    const only = []; // cells where only one has a surface: [index, whether it is extra]
    let both = 0;
    let sum = 0;
    const pen = this.paint(figure, depth.rows, depth.columns, (i) => {
      const a = depth.data[i];
      const b = truth.data[i];
      if (!a && !b) return signed[0];
      if (!a || !b) {
        only.push([i, a > 0]);
        return a ? signs[1] : signs[2];
      }
      both++;
      sum += Math.abs(a - b);
      return signed[Math.max(1, Math.min(255, Math.round(128 + perCount * (a - b))))];
    }, 8);
    hatch(pen, only, depth.columns, 8);
    const either = both + only.length;
    return { overlap: either ? both / either : 1, errorMm: both ? (10 * step * sum) / both : null };
  }

  error(figure, error) {
    this.bytes(figure, error, this.tables.error, 8);
  }

  probability(figure, surface) {
    contour(this.bytes(figure, surface, this.tables.grey, 8), surface, 128, 8, [], 2.5);
  }

  lidar(figure, depth) {
    this.bytes(figure, depth, this.tables.lidar);
  }

  // Contrast from the 1st to the 99th percentile of the counts, which follows slowly so that it does not flicker.
  infrared(figure, image) {
    const counts = new Float64Array(256), { data } = image;
    for (let i = 0; i < data.length; i += 3) counts[data[i]]++;
    const total = Math.ceil(data.length / 3), limit = (share) => {
      let sum = 0, value = 0;
      while (value < 255 && (sum += counts[value]) < share * total) value++;
      return value;
    };
    const [low, high] = [limit(0.01), limit(0.99)];
    this.fit = this.fit ? [0.9 * this.fit[0] + 0.1 * low, 0.9 * this.fit[1] + 0.1 * high] : [low, high];
    const [black, white] = this.fit, span = Math.max(white - black, 8);
    this.bytes(figure, image, this.table((value) => Array(3).fill((255 * (value - black)) / span)));
    return [Math.round(black), Math.round(black + span)];
  }

  signed(figure, map) {
    this.bytes(figure, map, this.tables.signed);
  }

  rgb(figure, { data, rows, columns }) {
    this.paint(figure, rows, columns, (i) => 0xff000000 | (data[3 * i + 2] << 16) | (data[3 * i + 1] << 8) | data[3 * i]);
  }

  // Squares between neighbouring pixels that are surface without a jump in depth, shaded by their slope.
  quads(moment, colored) {
    const { depth, error } = moment.arrays, [x0, x1, y0, y1] = this.box, n = depth.rows, jump = 27, quads = [];
    const at = (row, column) => [
      x0 + ((column + 0.5) / n) * (x1 - x0), y1 - ((row + 0.5) / n) * (y1 - y0), this.cm(depth.data[row * n + column]) / 100,
    ];
    for (let row = 0; row + 1 < n; row++) for (let column = 0; column + 1 < n; column++) {
      const i = row * n + column, four = [i, i + 1, i + n + 1, i + n], bytes = four.map((k) => depth.data[k]);
      if (Math.min(...bytes) === 0 || Math.max(...bytes) - Math.min(...bytes) > jump) continue;
      const corners = [at(row, column), at(row, column + 1), at(row + 1, column + 1), at(row + 1, column)];
      const right = (corners[1][2] - corners[0][2]) / (corners[1][0] - corners[0][0]);
      const up = (corners[0][2] - corners[3][2]) / (corners[0][1] - corners[3][1]);
      const light = (1 - 0.5 * right + 0.5 * up) / Math.hypot(1, right, up) / 1.22, shade = 0.4 + 0.6 * Math.max(light, 0);
      let rgb = (colored === "error" && error ? this.errorRgb(error.data[i]) : this.depthRgb(depth.data[i]));
      if (!moment.trusted) { const grey = (rgb[0] + rgb[1] + rgb[2]) / 3; rgb = rgb.map((value) => grey + 0.35 * (value - grey)); }
      quads.push({ corners, rgb: rgb.map((value) => Math.round(value * shade)) });
    }
    return quads;
  }

  // Color bar: upright, or lying on a phone.
  bar(figure) {
    const lying = matchMedia("(max-width: 820px)").matches, [rows, columns] = lying ? [1, 256] : [256, 1];
    this.paint(figure, rows, columns, (i) => this.tables.depth[Math.max(i, 1)]);
  }

  // Its colors beside a title, from the least value to the largest.
  swatch(name) {
    const colors = {
      signed: (share) => this.signedRgb(1 + Math.round(254 * share)),
      grey: (share) => Array(3).fill(255 * share),
      surface: (share) => Array(3).fill(GREY * 255 * share),
      lidar: (share) => this.depthRgb(1 + Math.round(254 * share)),
      error: (share) => this.color("error", share),
    };
    const stops = [0, 0.25, 0.5, 0.75, 1].map((share) => `rgb(${colors[name](share).map(Math.round)})`);
    return `<i style="background: linear-gradient(90deg, ${stops.join(", ")})"></i>`;
  }
}

// Lines through cells, rising where the surface is extra and falling where it is missing.
function hatch(pen, cells, columns, scale) {
  pen.beginPath();
  for (const [i, extra] of cells) {
    const x = (i % columns) * scale;
    const y = Math.floor(i / columns) * scale;
    pen.moveTo(x, extra ? y + scale : y);
    pen.lineTo(x + scale, extra ? y : y + scale);
  }
  pen.strokeStyle = "#0d1011";
  pen.lineWidth = 2;
  pen.stroke();
}

// Lines where a map crosses a level: marching squares over pixel centres.
function contour(pen, map, level, scale, dash, width) {
  const { data, rows, columns } = map;
  pen.beginPath();
  for (let y = 0; y + 1 < rows; y++) for (let x = 0; x + 1 < columns; x++) {
    const i = y * columns + x, corners = [data[i], data[i + 1], data[i + columns + 1], data[i + columns]];
    const places = [[x, y], [x + 1, y], [x + 1, y + 1], [x, y + 1]], ends = [];
    for (let k = 0; k < 4; k++) {
      const a = corners[k], b = corners[(k + 1) % 4];
      if (a < level === b < level) continue;
      const share = (level - a) / (b - a), [p, q] = [places[k], places[(k + 1) % 4]];
      ends.push([(p[0] + share * (q[0] - p[0]) + 0.5) * scale, (p[1] + share * (q[1] - p[1]) + 0.5) * scale]);
    }
    for (let k = 0; k + 1 < ends.length; k += 2) { pen.moveTo(...ends[k]); pen.lineTo(...ends[k + 1]); }
  }
  pen.setLineDash(dash);
  pen.strokeStyle = `rgb(${INSIDE})`;
  pen.lineWidth = width;
  pen.stroke();
  pen.setLineDash([]);
}
