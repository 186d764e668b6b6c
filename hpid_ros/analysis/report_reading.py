"""How the report's charts are read: cursor, values, zoom by mouse and keys, in JavaScript.

Mouse: move to read, drag to zoom, double click for the whole. Keys on a focused chart: arrows
move the cursor, with shift the range; + and - zoom; 0 or Escape show the whole.
"""

from __future__ import annotations

READING = r"""
  cursorLine(pen, color, y0, y1) {
    const cursor = this.figure.free ? this.at : this.figure.cursor;
    if (cursor == null) { this.readout.textContent = ""; return; }
    pen.strokeStyle = color("--ink");
    const shown = (value, isLog) => readable(isLog ? 10 ** value : value);
    const {xLog, yLog, xName, free} = this.figure;
    const label = (line) => (line.run < 0 ? "reference" : data.runs[line.run].label);
    if (free) {
      const near = this.nearest(cursor);
      if (!near) return;
      const [x, y] = [near.line.x[near.k], near.line.y[near.k]];
      this.stroke(pen, [[x, y0], [x, y1]], [2, 2], 1);
      this.readout.textContent = `${label(near.line)}: ${shown(x, xLog)}, ${shown(y, yLog)}`;
      return;
    }
    this.stroke(pen, [[cursor, y0], [cursor, y1]], [2, 2], 1);
    const values = this.shown.filter((line) => line.x.length).map((line) => {
      const k = firstAtLeast(line.x, cursor);
      const j = Math.max(0, k - 1), i = Math.min(k, line.x.length - 1);
      const part = line.x[i] > line.x[j] ? (cursor - line.x[j]) / (line.x[i] - line.x[j]) : 0;
      const value = line.y[j] + Math.max(0, Math.min(1, part)) * (line.y[i] - line.y[j]);
      return `${label(line)} ${shown(value, yLog)}`;
    });
    this.readout.textContent = `${xName} ${shown(cursor, xLog)}: ${values.join(", ")}`;
  }
  nearest([px, py]) {
    let best = null, least = Infinity;
    for (const line of this.shown) {
      for (let k = 0; k < line.x.length; k += 1) {
        const distance = (this.toX(line.x[k]) - px) ** 2 + (this.toY(line.y[k]) - py) ** 2;
        if (distance < least) { least = distance; best = {line, k}; }
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
      if (event.button) return;
      this.canvas.setPointerCapture(event.pointerId);
      this.from = this.place(event);
    });
    on("pointermove", (event) => {
      const at = this.place(event);
      if (this.from && Math.abs(at[0] - this.from[0]) > 4) this.drag = {from: this.from, to: at};
      if (this.figure.free) this.at = at; else this.figure.cursor = this.fromX(at[0]);
      drawAll();
    });
    on("pointerleave", () => {
      if (this.from) return;
      this.at = null;
      this.figure.cursor = null;
      drawAll();
    });
    on("pointercancel", () => { this.from = this.drag = null; drawAll(); });
    on("pointerup", () => {
      const drag = this.drag;
      this.from = this.drag = null;
      if (drag) this.zoomTo(drag);
      drawAll();
    });
    on("dblclick", () => this.reset());
    on("keydown", (event) => this.key(event));
  }
  zoomTo({from, to}) {
    const sorted = (a, b) => (a < b ? [a, b] : [b, a]);
    const [low, high] = sorted(this.fromX(from[0]), this.fromX(to[0]));
    if (this.figure.free && Math.abs(from[1] - to[1]) > 4) {
      this.height = sorted(this.fromY(from[1]), this.fromY(to[1]));
    }
    this.range = [Math.max(low, this.whole[0]), Math.min(high, this.whole[1])];
  }
  key(event) {
    const step = {ArrowLeft: -1, ArrowRight: 1}[event.key];
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
"""
"""The second half of the chart's class."""
