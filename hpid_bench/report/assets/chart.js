// Charts: lines on a canvas that zoom and tell their values.
//
// Mouse: move to read, drag to zoom, double click for the whole. Keys on a focused chart: arrows
// move the cursor, with shift the range; + and - zoom; 0 or Escape show the whole.
// Charts of one group share the range of x, and those of one figure the cursor.
class Chart {
  constructor(figure, panel, place) {
    this.figure = figure;
    this.panel = panel;
    this.own = null;
    const log = (values, is) => (is ? values.map((v) => Math.log10(Math.max(v, 1e-12))) : values);
    this.lines = panel.lines.map((line) => ({
      run: line.run,
      x: log(floats(line.x), figure.xLog),
      y: log(floats(line.y), figure.yLog),
    }));
    this.title = document.createElement("div");
    this.title.className = "title";
    this.title.textContent = panel.title;
    this.readout = document.createElement("output");
    this.canvas = document.createElement("canvas");
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute(
      "aria-label",
      `${figure.caption} ${panel.title}. ` +
        "Arrow keys read values, + and - zoom, 0 shows the whole.",
    );
    const box = document.createElement("div");
    box.className = "panel";
    box.append(this.title, this.canvas, this.readout);
    place.append(box);
    this.whole = this.lines.reduce(
      (seed, line) => extent(line.x, 0, line.x.length, seed),
      NOTHING,
    );
    if (!(this.whole[0] < this.whole[1])) {
      const at = Number.isFinite(this.whole[0]) ? this.whole[0] : 0;
      this.whole = [at - 0.5, at + 0.5];
    }
    if (figure.free) {
      const air = 0.06 * (this.whole[1] - this.whole[0]);
      this.whole = [this.whole[0] - air, this.whole[1] + air];
    }
    this.listen();
    charts.push(this);
  }
  get shown() {
    return this.lines.filter((line) => !hidden.has(line.run));
  }
  get range() {
    if (this.figure.free) return this.own ?? this.whole;
    return ranges[this.figure.group] ?? this.whole;
  }
  set range(range) {
    if (this.figure.free) this.own = range;
    else ranges[this.figure.group] = range;
    drawAll();
  }
  reset() {
    this.own = null;
    this.height = null;
    delete ranges[this.figure.group];
    drawAll();
  }
  zoomBy(factor) {
    const [low, high] = this.range;
    const cursor = this.figure.free ? null : this.figure.cursor;
    const at = cursor != null && cursor > low && cursor < high ? cursor : (low + high) / 2;
    this.range = zoomed(this.range, this.whole, at, factor);
  }
  pan(share) {
    this.range = panned(this.range, this.whole, share);
  }
  yRange() {
    if (this.figure.free && this.height) return this.height;
    const [from, to] = this.range;
    let seed = this.panel.level == null ? NOTHING : [this.panel.level, this.panel.level];
    for (const { x, y } of this.shown) {
      const free = this.figure.free;
      const first = free ? 0 : Math.max(0, firstAtLeast(x, from) - 1);
      const stop = free ? x.length : Math.min(x.length, firstAtLeast(x, to) + 1);
      seed = extent(y, first, stop, seed);
    }
    if (!Number.isFinite(seed[0])) seed = [0, 1];
    const air = 0.06 * (seed[1] - seed[0] || Math.abs(seed[0]) || 1);
    return [seed[0] - air, seed[1] + air];
  }
  draw() {
    const width = this.canvas.clientWidth,
      height = this.canvas.clientHeight;
    if (!width) return;
    const ratio = devicePixelRatio || 1;
    this.canvas.width = width * ratio;
    this.canvas.height = height * ratio;
    const pen = this.canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const style = getComputedStyle(root);
    const color = (name) => style.getPropertyValue(name).trim();
    const [x0, x1] = this.range,
      [y0, y1] = this.yRange();
    const wide = width - LEFT - RIGHT,
      high = height - TOP - BOTTOM;
    this.toX = (x) => LEFT + (wide * (x - x0)) / (x1 - x0);
    this.toY = (y) => TOP + high * (1 - (y - y0) / (y1 - y0));
    this.fromX = (px) => x0 + ((px - LEFT) * (x1 - x0)) / wide;
    this.fromY = (py) => y0 + (1 - (py - TOP) / high) * (y1 - y0);
    this.axes(pen, color, width, height, [x0, x1], [y0, y1]);
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, TOP, wide, high);
    pen.clip();
    for (const mark of this.panel.marks) {
      pen.strokeStyle = color(mark.run < 0 ? "--soft" : `--run-${data.runs[mark.run].style}`);
      const x = this.figure.xLog ? Math.log10(mark.x) : mark.x;
      this.segment(pen, x, y0, x, y1, [2, 3], 1);
    }
    const order = [...this.shown].sort((a, b) => (a.run < 0 ? -1 : b.run < 0 ? 1 : 0));
    for (const line of order) this.line(pen, color, line, x0, x1);
    this.cursorLine(pen, color, y0, y1);
    pen.restore();
    if (this.drag) {
      pen.fillStyle = color("--selection");
      const [left, right] = [this.drag.from[0], this.drag.to[0]].sort((a, b) => a - b);
      const [top, low] = [this.drag.from[1], this.drag.to[1]].sort((a, b) => a - b);
      if (this.figure.free) pen.fillRect(left, top, right - left, low - top);
      else pen.fillRect(left, TOP, right - left, high);
    }
  }
  axes(pen, color, width, height, xs, ys) {
    pen.font = "12px system-ui, sans-serif";
    pen.lineWidth = 1;
    const few = Math.max(2, Math.floor((width - LEFT) / 60));
    const xTicks = this.figure.xLog ? logTicks(...xs) : linearTicks(...xs, few);
    const yTicks = this.figure.yLog ? logTicks(...ys) : linearTicks(...ys, 4);
    pen.fillStyle = color("--soft");
    pen.strokeStyle = color("--grid");
    pen.textAlign = "center";
    pen.textBaseline = "top";
    const right = width - RIGHT,
      floor = height - BOTTOM;
    for (const at of this.figure.xLog ? minorLogTicks(...xs) : []) {
      this.tick(pen, color, this.toX(at), floor, 0, 3);
    }
    for (const at of this.figure.yLog ? minorLogTicks(...ys) : []) {
      this.tick(pen, color, LEFT, this.toY(at), -3, 0);
    }
    let free = 0;
    for (const [at, text] of xTicks) {
      const x = this.toX(at),
        half = pen.measureText(text).width / 2;
      if (x < LEFT - 1 || x > right + 1) continue;
      this.segment(pen, at, ys[0], at, ys[1], [], 1);
      this.tick(pen, color, x, floor, 0, 5);
      if (x - half < free || x + half > width) continue;
      pen.fillText(text, x, height - BOTTOM + 6);
      free = x + half + 8;
    }
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    let ceiling = height;
    for (const [at, text] of yTicks) {
      this.segment(pen, xs[0], at, xs[1], at, [], 1);
      this.tick(pen, color, LEFT, this.toY(at), -5, 0);
      if (this.toY(at) > ceiling - 14) continue;
      pen.fillText(text, LEFT - 6, this.toY(at));
      ceiling = this.toY(at);
    }
    pen.strokeStyle = color("--soft");
    this.segment(pen, xs[0], ys[1], xs[0], ys[0], [], 1);
    this.segment(pen, xs[0], ys[0], xs[1], ys[0], [], 1);
    const { level } = this.panel;
    if (level != null) this.segment(pen, xs[0], level, xs[1], level, [], 0.6);
  }
  tick(pen, color, x, y, wide, high) {
    pen.save();
    pen.strokeStyle = color("--soft");
    pen.beginPath();
    pen.moveTo(x, y);
    pen.lineTo(x + wide, y + high);
    pen.stroke();
    pen.restore();
  }
  segment(pen, x0, y0, x1, y1, dashes, width) {
    pen.setLineDash(dashes);
    pen.lineWidth = width;
    pen.beginPath();
    pen.moveTo(this.toX(x0), this.toY(y0));
    pen.lineTo(this.toX(x1), this.toY(y1));
    pen.stroke();
    pen.setLineDash([]);
  }
  line(pen, color, { run, x, y }, from, to) {
    const style = run < 0 ? null : data.runs[run];
    pen.strokeStyle = pen.fillStyle = color(style ? `--run-${style.style}` : "--reference");
    pen.lineJoin = "round";
    if (this.figure.points) {
      if (x.length > 1) this.segment(pen, x[0], y[0], x[1], y[1], [], 1.5);
      else this.marker(pen, style.style, this.toX(x[0]), this.toY(y[0]));
      return;
    }
    const free = this.figure.free;
    const first = free ? 0 : Math.max(0, firstAtLeast(x, from) - 1);
    const stop = free ? x.length : Math.min(x.length, firstAtLeast(x, to) + 2);
    pen.setLineDash(style ? style.dashes : []);
    pen.lineWidth = style ? 1.5 : 5;
    pen.beginPath();
    let isDown = false; // a line is torn where there is no number
    for (let k = first; k < stop; k += 1) {
      const isThere = !Number.isNaN(y[k]);
      if (isThere && isDown) pen.lineTo(this.toX(x[k]), this.toY(y[k]));
      else if (isThere) pen.moveTo(this.toX(x[k]), this.toY(y[k]));
      isDown = isThere;
    }
    pen.stroke();
    pen.setLineDash([]);
  }
  marker(pen, kind, x, y) {
    pen.beginPath();
    const sides = [24, 4, 3, 4, 5, 6, 7, 8][kind];
    for (let k = 0; k < sides; k += 1) {
      const angle = (2 * Math.PI * (k + (kind === 1 ? 0.5 : 0))) / sides - Math.PI / 2;
      pen.lineTo(x + 6 * Math.cos(angle), y + 6 * Math.sin(angle));
    }
    pen.closePath();
    pen.fill();
  }
  cursorLine(pen, color, y0, y1) {
    const cursor = this.figure.free ? this.at : this.figure.cursor;
    if (cursor == null) {
      this.readout.textContent = "";
      return;
    }
    pen.strokeStyle = color("--ink");
    const shown = (value, isLog) => readable(isLog ? 10 ** value : value);
    const { xLog, yLog, xName, free } = this.figure;
    const label = (line) => (line.run < 0 ? "reference" : data.runs[line.run].label);
    if (free) {
      const near = this.nearest(cursor);
      if (!near) return;
      const [x, y] = [near.line.x[near.k], near.line.y[near.k]];
      this.segment(pen, x, y0, x, y1, [2, 2], 1);
      this.readout.textContent = `${label(near.line)}: ${shown(x, xLog)}, ${shown(y, yLog)}`;
      return;
    }
    this.segment(pen, cursor, y0, cursor, y1, [2, 2], 1);
    const values = this.shown
      .filter((line) => line.x.length)
      .map((line) => `${label(line)} ${shown(valueAt(line, cursor), yLog)}`);
    this.readout.textContent = `${xName} ${shown(cursor, xLog)}: ${values.join(", ")}`;
  }
  nearest([px, py]) {
    let best = null,
      least = Infinity;
    for (const line of this.shown) {
      for (let k = 0; k < line.x.length; k += 1) {
        const distance = (this.toX(line.x[k]) - px) ** 2 + (this.toY(line.y[k]) - py) ** 2;
        if (distance < least) {
          least = distance;
          best = { line, k };
        }
      }
    }
    return best;
  }
  place(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }
  listen() {
    const on = (name, does) => this.canvas.addEventListener(name, does);
    on("pointerdown", (event) => {
      if (event.button || !this.fromX) return; // a chart that is not drawn yet has no scale
      this.canvas.setPointerCapture(event.pointerId);
      this.from = this.place(event);
    });
    on("pointermove", (event) => {
      if (!this.fromX) return;
      const at = this.place(event);
      if (this.from && Math.abs(at[0] - this.from[0]) > 4) this.drag = { from: this.from, to: at };
      if (this.figure.free) this.at = at;
      else this.figure.cursor = this.fromX(at[0]);
      drawAll();
    });
    on("pointerleave", () => {
      if (this.from) return;
      this.at = null;
      this.figure.cursor = null;
      drawAll();
    });
    on("pointercancel", () => {
      this.from = this.drag = null;
      drawAll();
    });
    on("pointerup", () => {
      const drag = this.drag;
      this.from = this.drag = null;
      if (drag) this.zoomTo(drag);
      drawAll();
    });
    on("dblclick", () => this.reset());
    on("keydown", (event) => this.key(event));
  }
  zoomTo({ from, to }) {
    const sorted = (a, b) => (a < b ? [a, b] : [b, a]);
    const [first, last] = this.whole;
    const within = ([px]) => Math.max(first, Math.min(last, this.fromX(px)));
    const [low, high] = sorted(within(from), within(to));
    if (this.figure.free && Math.abs(from[1] - to[1]) > 4) {
      this.height = sorted(this.fromY(from[1]), this.fromY(to[1]));
    }
    if (high - low > 1e-6 * (last - first)) this.range = [low, high];
  }
  key(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (step && event.shiftKey) this.pan(0.1 * step);
    else if (step) this.moveCursor(step);
    else if (event.key === "+" || event.key === "=") this.zoomBy(0.5);
    else if (event.key === "-") this.zoomBy(2);
    else if (event.key === "0" || event.key === "Escape") this.reset();
    else return;
    event.preventDefault();
  }
  moveCursor(step) {
    const [low, high] = this.range;
    if (this.figure.free) {
      const middle = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2];
      const [px, py] = this.at ?? middle;
      this.at = [px + 5 * step, py];
    } else {
      const cursor = this.figure.cursor ?? (low + high) / 2;
      this.figure.cursor = Math.max(low, Math.min(high, cursor + 0.01 * step * (high - low)));
    }
    drawAll();
  }
}
