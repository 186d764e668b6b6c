// Numbers, ticks and ranges of the charts, and the data of the page unpacked.
const data = JSON.parse(document.getElementById("report-data").textContent);
const floats = (text) => {
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let k = 0; k < raw.length; k += 1) bytes[k] = raw.charCodeAt(k);
  return new Float32Array(bytes.buffer);
};
const hidden = new Set();
const ranges = {};
const charts = [];
let isWaiting = false;
const drawAll = () => {
  if (isWaiting) return;
  isWaiting = true;
  requestAnimationFrame(() => {
    isWaiting = false;
    charts.forEach((chart) => chart.draw());
  });
};
const readable = (value) => String(Number(value.toPrecision(5))).replace("-", "\u2212");
const linearTicks = (low, high, count) => {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 2.5, 5, 10].find((each) => each * power >= rough * 0.999);
  const ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high * (1 + 1e-12) + 1e-300; k += 1) {
    ticks.push(k * step);
    if (ticks.length > 40) break;
  }
  return ticks.map((at) => [at, readable(Math.abs(at) < step * 1e-6 ? 0 : at)]);
};
const power = (k) => (Math.abs(k) < 4 ? readable(10 ** k) : `1e${k}`.replace("-", "\u2212"));
const logAt = (low, high, mantissas) => {
  const places = [];
  for (let k = Math.floor(low); k <= high; k += 1) {
    for (const m of mantissas) {
      const at = k + Math.log10(m);
      if (at >= low - 1e-9 && at <= high + 1e-9) places.push(at);
    }
  }
  return places;
};
const logTicks = (low, high) => {
  const decades = logAt(low, high, [1]);
  if (decades.length > 2) return decades.map((at) => [at, power(Math.round(at))]);
  const rounded = (at) => [at, readable(Number((10 ** at).toPrecision(1)))];
  const finer = logAt(low, high, [1, 2, 5]);
  if (finer.length > 1) return finer.map(rounded);
  return linearTicks(10 ** low, 10 ** high, 3).map(([at, text]) => [Math.log10(at), text]);
};
const minorLogTicks = (low, high) => logAt(low, high, [2, 3, 4, 5, 6, 7, 8, 9]);
const firstAtLeast = (xs, x) => {
  let low = 0;
  let high = xs.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (xs[middle] < x) low = middle + 1;
    else high = middle;
  }
  return low;
};
// The value of a line between its points; beyond its ends that of the end.
const valueAt = ({ x, y }, at) => {
  const k = firstAtLeast(x, at);
  const [j, i] = [Math.max(0, k - 1), Math.min(k, x.length - 1)];
  const part = x[i] > x[j] ? (at - x[j]) / (x[i] - x[j]) : 0;
  return y[j] + Math.max(0, Math.min(1, part)) * (y[i] - y[j]);
};
// A range made wider or narrower about a place, within the whole, and no narrower than a millionth.
const zoomed = ([low, high], [first, last], at, factor) => {
  const next = [
    Math.max(first, at - (at - low) * factor),
    Math.min(last, at + (high - at) * factor),
  ];
  return next[1] - next[0] < 1e-6 * (last - first) ? [low, high] : next;
};
// A range moved by a share of itself, within the whole.
const panned = ([low, high], [first, last], share) => {
  const move = Math.max(first - low, Math.min(last - high, share * (high - low)));
  return [low + move, high + move];
};
const extent = (values, from, to, seed) => {
  let [low, high] = seed;
  for (let k = from; k < to; k += 1) {
    if (values[k] < low) low = values[k];
    if (values[k] > high) high = values[k];
  }
  return [low, high];
};
const NOTHING = [Infinity, -Infinity];
const LEFT = 58,
  RIGHT = 10,
  TOP = 8,
  BOTTOM = 24;
