import { echarts } from "nicegui-echart";
import { Curves, roundLimits } from "./curves.js";
import { Turns } from "./turns.js";

const LOST_AFTER = 1500; // [ms] without a frame
const HELD_EVERY = 100; // [ms]
const STOPS_WITHIN = 300; // [ms] by the socket that is open; then by a request as well

const CHARTS = [
  {
    id: "position",
    smallest: 0.01,
    title: "Position, and reference (dashed)",
    unit: "position",
    lines: ["position", "reference"],
  },
  { id: "error", smallest: 0.001, title: "Error", unit: "position", lines: ["error"] },
  { id: "effort", smallest: 0.1, title: "Effort", unit: "effort", lines: ["effort"] },
  {
    id: "multiplier",
    smallest: 0.2,
    title: "Multiplier λ, and norm (dashed)",
    unit: "",
    lines: ["multiplier", "norm"],
  },
];

const act = (name) => document.querySelector(`[data-act=${name}]`);

class LivePage {
  constructor() {
    this.curves = new Curves();
    this.marks = [];
    this.page = "";
    this.shown = [];
    this.seconds = 10;
    this.isPaused = false;
    this.heard = performance.now();
    this.turns = new Turns();
    this.isDirty = false;
    this.charts = new Map();
    this.socket = null;
    this.held = null;
    this.frames = 0;
    this.isTaken = false;
    this.onStopped = null;
  }

  start(page) {
    if (this.page) {
      return; // NiceGUI has connected again: this is the same page
    }
    this.page = page;
    this.connect();
    setInterval(() => this.look(), 250);
    const draw = () => {
      this.draw();
      requestAnimationFrame(draw);
    };
    requestAnimationFrame(draw);
    document.addEventListener("keydown", (event) => this.onKey(event), true);
    document.addEventListener("visibilitychange", () => this.release());
    window.addEventListener("blur", () => this.release());
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
      window.addEventListener(name, () => this.release(), true);
    }
    // A menu takes the release away, and a pointer that comes back may have been let go elsewhere.
    window.addEventListener("contextmenu", (event) => this.onMenu(event), true);
    window.addEventListener("pointermove", (event) => this.onMove(event), true);
    document.addEventListener("keyup", (event) => this.onKeyUp(event), true);
  }

  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/frames?page=${this.page}`);
    this.socket.onmessage = (message) => this.hear(JSON.parse(message.data));
    this.socket.onclose = () => {
      this.release();
      setTimeout(() => this.connect(), 1000);
    };
  }

  hear(message) {
    this.heard = performance.now();
    if (message.stopped === undefined) {
      this.take(message);
    } else {
      this.onStopped?.(message.stopped === true);
    }
  }

  take(frame) {
    this.frames += 1;
    const isBack = (node) => frame.now[node] < this.curves.now.get(node);
    this.marks = this.marks.filter((mark) => !isBack(mark.node)); // they are of another time
    this.curves.take(frame);
    this.marks.push(...frame.marks);
    this.marks = this.marks.slice(-200);
    this.isDirty = true;
  }

  look() {
    const isLost = performance.now() - this.heard > LOST_AFTER;
    document.body.classList.toggle("lost", isLost);
    if (isLost) {
      this.release();
    }
  }

  // Stopping and holding

  async stop() {
    this.release();
    document.body.classList.add("stopping");
    const isStopped = await this.stopped();
    document.body.classList.toggle("not-stopped", !isStopped);
    document.body.classList.remove("stopping");
  }

  /** Ask on the socket that is open, which needs no new connection; if in vain, by a request. */
  stopped() {
    return new Promise((resolve) => {
      const ask = async () => {
        try {
          const answer = await fetch("/stop", { method: "POST" });
          resolve((await answer.json()).stopped === true);
        } catch {
          resolve(false);
        }
      };
      if (this.socket?.readyState !== WebSocket.OPEN) {
        ask();
        return;
      }
      const timer = setTimeout(ask, STOPS_WITHIN);
      this.onStopped = (isStopped) => {
        clearTimeout(timer);
        resolve(isStopped);
      };
      this.socket.send("stop");
    });
  }

  holdBy(event) {
    if (event.button === 0 && !event.ctrlKey) {
      this.hold(event.currentTarget, true);
    }
  }

  onMenu(event) {
    if (event.target.closest?.("[data-act=hold]")) {
      event.preventDefault();
      if (event.pointerType === "touch") {
        return; // a long press, which opens none now
      }
    }
    this.release();
  }

  onMove(event) {
    if (this.held?.isByPointer && !event.buttons) {
      this.release();
    }
  }

  hold(button, isByPointer) {
    if (this.held || button.disabled) {
      return;
    }
    button.classList.add("held");
    const tell = () => {
      if (this.socket?.readyState === WebSocket.OPEN) {
        this.socket.send("hold");
      }
    };
    tell();
    this.held = { button, isByPointer, timer: setInterval(tell, HELD_EVERY) };
  }

  release() {
    if (!this.held) {
      return;
    }
    clearInterval(this.held.timer);
    this.held.button.classList.remove("held");
    this.held = null;
    if (this.socket?.readyState === WebSocket.OPEN) {
      this.socket.send("release");
    }
  }

  onKey(event) {
    if (event.key === "Escape") {
      event.preventDefault();
      event.stopPropagation();
      this.stop();
      return;
    }
    const isHold =
      document.activeElement?.dataset.act === "hold" && [" ", "Enter"].includes(event.key);
    if (isHold) {
      event.preventDefault();
      if (!event.repeat) {
        this.hold(document.activeElement, false);
      }
      return;
    }
    const isTyping = ["INPUT", "TEXTAREA"].includes(document.activeElement?.tagName);
    if (event.ctrlKey && event.key === "Enter") {
      event.preventDefault(); // nor does what has the focus take it for a click
      event.stopPropagation();
      this.isTaken = true;
      act("apply")?.click();
    } else if (event.ctrlKey && event.key.toLowerCase() === "z" && !isTyping) {
      act("undo")?.click();
    }
  }

  onKeyUp(event) {
    this.release();
    if (this.isTaken && event.key === "Enter") {
      event.stopPropagation();
      this.isTaken = false;
    }
  }

  // Drawing

  /** @param {{node: string, label: string, colour: string, position: string, effort: string}[]} shown */
  show(shown, seconds) {
    this.shown = shown;
    this.seconds = seconds;
    this.isDirty = true;
    this.isPaused = false;
    this.turns.restart();
    for (const chart of this.charts.values()) {
      chart.clear();
    }
  }

  pause(isPaused) {
    this.isPaused = isPaused;
    this.isDirty = true;
  }

  chart(id) {
    const place = document.querySelector(`[data-chart=${id}]`);
    if (!place) {
      return null;
    }
    const known = this.charts.get(id);
    if (known && known.getDom() === place) {
      return known;
    }
    known?.dispose();
    const chart = echarts.init(place, null, { renderer: "canvas" });
    new ResizeObserver(() => chart.resize()).observe(place);
    this.charts.set(id, chart);
    return chart;
  }

  draw() {
    const isDark = document.body.classList.contains("body--dark");
    const draw = (each) => {
      const chart = this.chart(each.id);
      if (chart && chart.getWidth() > 0) {
        this.drawOne(chart, each, isDark);
      }
    };
    const isWanted = this.isDirty && !this.isPaused;
    if (this.turns.take(CHARTS, isWanted, this.held !== null, draw)) {
      this.isDirty = false;
    }
  }

  drawOne(chart, kind, isDark) {
    const ink = isDark ? "#d5d9de" : "#30363d";
    const grid = isDark ? "#3a424c" : "#dde1e6";
    let least = Number.POSITIVE_INFINITY;
    let largest = Number.NEGATIVE_INFINITY;
    const series = [];
    this.shown.forEach((joint) => {
      kind.lines.forEach((signal, number) => {
        const data = this.curves.last(joint.node, signal, this.seconds);
        for (const [, value] of data) {
          least = Math.min(least, value);
          largest = Math.max(largest, value);
        }
        const suffix = kind.lines.length > 1 ? ` ${signal}` : "";
        series.push({
          name: joint.label + suffix,
          type: "line",
          data,
          showSymbol: false,
          silent: true,
          itemStyle: { color: joint.colour },
          lineStyle: { width: number ? 1.2 : 1.6, type: number ? "dashed" : "solid" },
        });
      });
    });
    if (series.length) {
      series[0].markLine = this.markLine(ink);
    }
    const [low, high] = roundLimits(least, largest, kind.smallest);
    const unit = kind.unit ? this.unit(kind.unit) : "";
    chart.setOption(
      {
        animation: false,
        textStyle: { color: ink },
        title: {
          text: kind.title + unit,
          left: 6,
          top: 2,
          textStyle: { color: ink, fontSize: 13, fontWeight: 600 },
        },
        grid: { left: 58, right: 12, top: 28, bottom: 24 },
        tooltip: {
          trigger: "axis",
          confine: true,
          valueFormatter: (value) => (value === undefined ? "" : Number(value).toPrecision(4)),
        },
        xAxis: {
          type: "value",
          min: -this.seconds,
          max: 0,
          axisLabel: { color: ink, formatter: (value) => `${value} s` },
          splitLine: { lineStyle: { color: grid } },
          axisLine: { onZero: false },
        },
        yAxis: {
          type: "value",
          min: low,
          max: high,
          axisLabel: { color: ink, formatter: (value) => String(Number(value.toPrecision(4))) },
          splitLine: { lineStyle: { color: grid } },
        },
        series,
      },
      { replaceMerge: ["series"] },
    );
  }

  unit(kind) {
    const units = [...new Set(this.shown.map((joint) => joint[kind]))];
    return units.length ? ` [${units.join(", ")}]` : "";
  }

  markLine(ink) {
    const data = [];
    for (const mark of this.marks) {
      const now = this.curves.now.get(mark.node);
      const isShown = this.shown.some((joint) => joint.node === mark.node);
      if (isShown && now !== undefined && mark.time > now - this.seconds) {
        data.push({ xAxis: mark.time - now, name: mark.text });
      }
    }
    return {
      silent: true,
      symbol: "none",
      animation: false,
      label: { show: false },
      lineStyle: { color: ink, type: "dotted", width: 1.2 },
      data,
    };
  }
}

window.hpidLive = new LivePage();
window.dispatchEvent(new Event("hpid-live"));
