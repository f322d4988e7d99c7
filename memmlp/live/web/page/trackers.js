// From samples of three trackers, each at its own time, to frames at the network's rate: memmlp.live.tracker_resampling, rule by rule.
//
// A sample is { time, positions, rotations }: seconds, and of head, left and right wrist the position (metres, OpenXR's
// axes: Y up, -Z forward) and the rotation (a quaternion, the identity for a person in T-pose who looks along -Z).

import { aboutVertical, headingOf, IDENTITY, inverse, minus, multiply, plus, rotate, slerp, turnedBy } from './rotations.js';

export const GAP = 0.5; // seconds without a sample after which everything begins anew
export const RECOVERY = 0.2; // seconds over which a tracker that returns is led to its true pose
const EARLY = 5e-4; // seconds that a frame may be ahead of its sample, for times that are rounded to milliseconds
const FURTHEST = 1.1; // of the way from one sample to the next; two that came together tell no speed
const SAME = 1e-6; // seconds; a sample this near to a frame is taken as the frame
const WHO = [0, 1, 2];

// The trackers at a time, interpolated between the samples before and after it. A time a little after both is taken as of
// rounded times, but no further than FURTHEST: from two samples that came together, speeds can't be told.
export function between(a, b, time) {
  const weight = Math.min((time - a.time) / (b.time - a.time), FURTHEST);
  return {
    time,
    positions: WHO.map(i => plus(a.positions[i], minus(b.positions[i], a.positions[i]), weight)),
    rotations: WHO.map(i => slerp(a.rotations[i], b.rotations[i], weight)),
  };
}

// Head and wrists of a person in T-pose whose head is at `place`, turned to the left of -Z by `heading` radians.
// body: { rest, floor }: head and wrists of the rest pose, and the height of its lowest joint, metres.
export function tPose(body, place, heading) {
  const turn = aboutVertical(heading);
  const positions = body.rest.map(joint => plus(place, rotate(turn, minus(joint, body.rest[0]))));
  return { time: 0, positions, rotations: WHO.map(() => turn) };
}

// Holds lost trackers at their last poses, and leads them smoothly to their true poses on their return.
export class Hold {
  constructor(body) {
    this.body = body;
    this.reset();
  }

  reset() {
    this.last = null;
    this.lost = [false, false, false];
    this.settled = -Infinity; // time from which all trackers that returned are at their true poses
    this.returned = [-Infinity, -Infinity, -Infinity]; // time from which each tracker's difference shrinks
    this.shift = WHO.map(() => [0, 0, 0]);
    this.turn = WHO.map(() => IDENTITY);
  }

  // The sample with lost trackers filled in, and with returning ones on their way.
  take(sample, lost) {
    const last = this.last ?? this.first(sample, lost);
    const returning = WHO.filter(i => this.lost[i] && !lost[i]);
    this.last = sample;
    this.lost = lost;
    if (returning.length) this.return(returning, last, sample);
    if (sample.time < this.settled) this.last = this.onTheirWay(sample);
    if (lost.includes(true)) this.last = held(this.last, lost, last);
    return this.last;
  }

  // What stands in for the last sample when the first one comes: itself, if nothing is lost; else the T-pose under
  // the head; without a head, that of a person who stands at the origin and looks along +Z.
  first(sample, lost) {
    if (!lost.includes(true)) return sample;
    if (lost[0]) return tPose(this.body, [0, this.body.rest[0][1] - this.body.floor, 0], Math.PI);
    return tPose(this.body, sample.positions[0], headingOf(sample.rotations[0]));
  }

  return(which, last, sample) {
    this.settled = last.time + RECOVERY;
    for (const i of which) {
      this.returned[i] = last.time;
      this.shift[i] = minus(last.positions[i], sample.positions[i]);
      this.turn[i] = multiply(last.rotations[i], inverse(sample.rotations[i]));
    }
  }

  onTheirWay(sample) {
    const left = this.returned.map(time => Math.min(Math.max(1 - (sample.time - time) / RECOVERY, 0), 1));
    return {
      time: sample.time,
      positions: WHO.map(i => plus(sample.positions[i], this.shift[i], left[i])),
      rotations: WHO.map(i => multiply(turnedBy(this.turn[i], left[i]), sample.rotations[i])),
    };
  }
}

// The sample with the lost trackers where they last were, as seen from the head.
function held(sample, lost, last) {
  const positions = [...sample.positions];
  const rotations = [...sample.rotations];
  if (lost[0]) [positions[0], rotations[0]] = [last.positions[0], last.rotations[0]];
  const turn = aboutVertical(headingOf(rotations[0]) - headingOf(last.rotations[0]));
  for (const hand of [1, 2].filter(i => lost[i])) {
    positions[hand] = plus(positions[0], rotate(turn, minus(last.positions[hand], last.positions[0])));
    rotations[hand] = multiply(turn, last.rotations[hand]);
  }
  return { time: sample.time, positions, rotations };
}

// Turns samples into frames at times 1 / fps apart, from the first sample on.
export class Resampler {
  constructor(fps) {
    this.fps = fps;
    this.reset();
  }

  reset() {
    this.last = null;
    this.origin = 0;
    this.count = 0;
  }

  get next() { return this.origin + this.count / this.fps; }

  restarts(time) { return this.last === null || Math.abs(time - this.last.time) > GAP; }

  isOld(time) {
    const passed = this.last === null ? Infinity : time - this.last.time;
    return -GAP <= passed && passed <= 0;
  }

  // The frames that are due with a sample, which must be newer than the last one.
  take(sample) {
    if (this.last === null) [this.origin, this.last] = [sample.time, sample];
    const frames = [];
    for (let time = this.next; time <= sample.time + EARLY; time = this.next) {
      frames.push(Math.abs(time - sample.time) <= SAME ? sample : between(this.last, sample, time));
      this.count++;
    }
    this.last = sample;
    return frames;
  }
}

// Samples of three trackers to frames at the network's rate, by both.
export class TrackerFrames {
  constructor(body, fps) {
    this.hold = new Hold(body);
    this.grid = new Resampler(fps);
  }

  reset() {
    this.hold.reset();
    this.grid.reset();
  }

  // The frames that are due with a sample, and whether everything begins anew with it. Without a time, the sample is
  // the next frame. lost: which of head, left and right wrist do not count.
  take(time, positions, rotations, lost) {
    time ??= this.grid.next;
    if (this.grid.isOld(time)) return { frames: [], restarted: false };
    const restarted = this.grid.restarts(time);
    if (restarted) this.reset();
    return { frames: this.grid.take(this.hold.take({ time, positions, rotations }, lost)), restarted };
  }
}
