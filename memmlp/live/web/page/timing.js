// Times of steps, in turn, round by round, so that a machine that grows warm slows all equally.

export const ROUNDS = 5;
const WARM_UP = 30; // untimed steps of each at the start
const SETTLING = 3; // untimed steps of each at the start of a round, in which caches fill

// steps: { key: async () => anything }, each timed ROUNDS times `each` times from its call until its outputs were read.
// Resolves to { key: [[milliseconds of a round's steps]] }; progress(share) reports the share that is done.
export async function timeInTurn(steps, each, progress) {
  const keys = Object.keys(steps);
  const times = Object.fromEntries(keys.map(key => [key, []]));
  for (const key of keys) await repeat(steps[key], WARM_UP);
  for (let round = 0; round < ROUNDS; round++) {
    for (const [index, key] of keys.entries()) {
      await repeat(steps[key], SETTLING);
      times[key].push(await repeat(steps[key], each));
      progress((round + (index + 1) / keys.length) / ROUNDS);
    }
  }
  return times;
}

async function repeat(step, count) {
  const times = new Array(count);
  for (let i = 0; i < count; i++) {
    const start = performance.now();
    await step();
    times[i] = performance.now() - start;
  }
  return times;
}

export const median = numbers => percentile(numbers, 50);

// As numpy.percentile: between the two nearest numbers, linearly.
export function percentile(numbers, percent) {
  const sorted = Float64Array.from(numbers).sort();
  const place = (percent / 100) * (sorted.length - 1);
  const below = Math.floor(place);
  const above = Math.min(below + 1, sorted.length - 1);
  return sorted[below] + (place - below) * (sorted[above] - sorted[below]);
}

// The median over rounds of the rounds' medians, over those of a base.
export const ratio = (times, base) => median(times.map((round, i) => median(round) / median(base[i])));

// The clock's step, milliseconds: browsers make it coarse, so that no page learns secrets by it.
export function clockStep() {
  let least = Infinity;
  for (let i = 0; i < 20; i++) {
    const start = performance.now();
    let now = start;
    while (now === start) now = performance.now();
    least = Math.min(least, now - start);
  }
  return least;
}
