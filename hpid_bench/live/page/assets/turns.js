const DRAWN_EVERY = 50; // [ms]
const STRETCH = 12; // [ms], and the drawing under way: then timers, keys and messages have a turn
const SHARE = 4; // pauses are so many times as long: a slow computer does not draw all the time
const HELD_SHARE = 12; // so while a button is held, whose every beat counts

/** Rounds of drawing: each chart once, a few milliseconds at a stretch, and then a pause. */
export class Turns {
  constructor() {
    this.left = [];
    this.spent = 0;
    this.pauseEnds = 0;
  }

  /** Begin a new round, whatever was left of the last one. */
  restart() {
    this.left = [];
    this.pauseEnds = 0;
  }

  /**
   * Draw what it is time for; to be called for every frame of the screen.
   * @template T
   * @param {T[]} charts all of them
   * @param {boolean} isWanted whether there is anything new
   * @param {boolean} isHeld whether a button is held
   * @param {(chart: T) => void} draw
   * @param {() => number} clock in [ms]
   * @returns {boolean} whether a round has begun
   */
  take(charts, isWanted, isHeld, draw, clock = () => performance.now()) {
    const began = clock();
    const isNew = !this.left.length && isWanted && began >= this.pauseEnds;
    if (isNew) {
      this.left = [...charts];
      this.spent = 0;
    }
    if (!this.left.length) {
      return false;
    }
    let now = began;
    while (this.left.length && now - began < STRETCH) {
      draw(this.left.shift());
      now = clock();
    }
    this.spent += now - began;
    this.pauseEnds = now + Math.max(DRAWN_EVERY, (isHeld ? HELD_SHARE : SHARE) * this.spent);
    return isNew;
  }
}
