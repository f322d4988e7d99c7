// Keeps the frames of the last minutes, and knows which is shown: the newest one, or one that was chosen.

const KEPT = 60 * 180; // the largest number of frames, which is three minutes

export class History {
  frames = [];
  chosen = null; // number of the frame that is shown while paused; null: the newest

  add(frame) {
    this.frames.push(measured(frame));
    if (this.frames.length > KEPT) this.frames.shift();
  }

  get first() { return this.frames[0]?.number ?? 0; }
  get last() { return this.frames.at(-1)?.number ?? 0; }
  get paused() { return this.chosen !== null; }

  get shown() {
    if (!this.paused) return this.frames.at(-1);
    return this.frames[Math.min(Math.max(this.chosen - this.first, 0), this.frames.length - 1)];
  }

  choose(number) { this.chosen = Math.min(Math.max(number, this.first), this.last); }
  resume() { this.chosen = null; }

  // The median and 95th percentile of a key's milliseconds over the last frames that have it.
  timing(key, count = 300) {
    return percentiles(this.frames.slice(-count).map(frame => frame[key]).filter(ms => ms !== undefined));
  }
}

// The median and the 95th percentile; null without values.
export function percentiles(values) {
  const sorted = [...values].sort((a, b) => a - b);
  const at = part => sorted[Math.min(Math.floor(part * sorted.length), sorted.length - 1)];
  return sorted.length ? [at(0.5), at(0.95)] : null;
}

// Returns the frame in metres, with the joints' errors in cm where the truth is known.
function measured(frame) {
  const positions = Float32Array.from(frame.positions, mm => mm / 1000);
  if (frame.turns) frame.turns = Int16Array.from(frame.turns);
  if (!frame.truth) return { ...frame, positions, errors: null, mean: null };
  const truth = Float32Array.from(frame.truth, mm => mm / 1000);
  const errors = new Float32Array(positions.length / 3);
  for (let j = 0; j < errors.length; j++) {
    const [x, y, z] = [0, 1, 2].map(i => positions[3 * j + i] - truth[3 * j + i]);
    errors[j] = 100 * Math.hypot(x, y, z);
  }
  return { ...frame, positions, truth, errors, mean: errors.reduce((a, b) => a + b) / errors.length };
}
