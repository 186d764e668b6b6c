/** The newest samples of every signal of every joint, as typed rows of time and value. */
export class Curves {
  /** @param {number} longest seconds that are kept */
  constructor(longest = 60) {
    this.longest = longest;
    this.rows = new Map();
    this.now = new Map();
  }

  /** Take a frame: {now: {node: time}, curves: {node: {signal: [time, value, ...]}}}. */
  take(frame) {
    for (const [node, time] of Object.entries(frame.now)) {
      const before = this.now.get(node);
      if (before !== undefined && time < before) {
        this.forget(node);
      }
      this.now.set(node, time);
    }
    for (const [node, signals] of Object.entries(frame.curves)) {
      for (const [signal, flat] of Object.entries(signals)) {
        this.append(node, signal, flat);
      }
    }
  }

  forget(node) {
    for (const key of [...this.rows.keys()]) {
      if (key.startsWith(`${node} `)) {
        this.rows.delete(key);
      }
    }
  }

  append(node, signal, flat) {
    const key = `${node} ${signal}`;
    const rows = this.rows.get(key) ?? [];
    for (let at = 0; at < flat.length; at += 2) {
      rows.push([flat[at], flat[at + 1]]);
    }
    const end = (this.now.get(node) ?? 0) - this.longest;
    let old = 0;
    while (old < rows.length && rows[old][0] < end) {
      old += 1;
    }
    // Not at every frame: moving all rows is dear, a few too many are not.
    this.rows.set(key, old > 200 ? rows.slice(old) : rows);
  }

  /** Samples of a signal, with time before now (negative), of the last seconds. */
  last(node, signal, seconds) {
    const rows = this.rows.get(`${node} ${signal}`) ?? [];
    const now = this.now.get(node) ?? 0;
    let first = rows.length;
    while (first > 0 && rows[first - 1][0] >= now - seconds) {
      first -= 1;
    }
    return rows.slice(first).map(([time, value]) => [time - now, value]);
  }
}

/**
 * Round limits around values, so that an axis does not tremble with every sample.
 * @param {number} smallest the least way from one limit to the other: less is noise
 */
export function roundLimits(least, largest, smallest) {
  if (!(largest >= least)) {
    return [-smallest, smallest];
  }
  const middle = (least + largest) / 2;
  const half = Math.max(largest - least, smallest) / 2;
  const step = 10 ** Math.floor(Math.log10(2 * half)) / 2;
  const low = Math.floor((middle - 1.05 * half) / step) * step;
  const high = Math.ceil((middle + 1.05 * half) / step) * step;
  return [low, high];
}
