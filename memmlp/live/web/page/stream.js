// A trained network that runs on live trackers, by the rules of memmlp.live.stream.Stream and tracker_resampling.
//
// Everything is in OpenXR's frame of reference: metres, Y up, -Z forward; a rotation is a quaternion, the identity for a
// person in T-pose who looks along -Z. A sample is { time, positions, rotations } of head, left and right wrist.

import { aboutVertical, headingOf, IDENTITY, inverse, matrix, minus, multiply, plus, rotate, slerp } from './rotations.js';

const TRACKERS = ['head', 'left', 'right'];
const EACH = [0, 1, 2];
const GAP = 0.5; // seconds without a sample after which everything restarts
const RECOVERY = 0.2; // seconds over which a returning tracker moves to its true pose
const EARLY = 5e-4; // seconds that a frame may be ahead of its sample, for times in whole milliseconds
const MAX_WEIGHT = 1.1; // of the way between two samples; two that arrive together do not show a speed
const SAME = 1e-6; // seconds; a sample this near to a frame is the frame
const FARTHEST = 1e6; // metres; a tracker farther from the origin is lost
const FAR = 0.25; // metres; a device farther from a T-pose's joint is not attached there
const FROZEN = GAP; // seconds; a tracker that repeats its pose for longer, while another moves, is lost
const UNIT = 1e-2; // maximum difference of a quaternion's norm from 1
const APART = 0.1; // minimum metres between the hands in a T-pose
const TILTED = Math.PI / 3; // from upright; a device that is tilted further has no heading
const NEUTRAL = { position: [0, 0, 0], rotation: IDENTITY, lost: true };

const scaled = (vector, factor) => vector.map(x => factor * x);

// The trackers at a time, interpolated between two samples, or extrapolated up to MAX_WEIGHT.
function interpolate(a, b, time) {
  const weight = Math.min((time - a.time) / (b.time - a.time), MAX_WEIGHT);
  return {
    time,
    positions: EACH.map(i => plus(a.positions[i], minus(b.positions[i], a.positions[i]), weight)),
    rotations: EACH.map(i => slerp(a.rotations[i], b.rotations[i], weight)),
  };
}

// Head and wrists of a person in T-pose whose head is at `place`, turned to the left of -Z by `heading` radians.
function tPose(body, place, heading) {
  const turn = aboutVertical(heading);
  const positions = body.rest.map(joint => plus(place, rotate(turn, minus(joint, body.rest[0]))));
  return { time: 0, positions, rotations: EACH.map(() => turn) };
}

// The sample with lost trackers at their last poses relative to the head.
function holdLost(sample, lost, last) {
  const [positions, rotations] = [[...sample.positions], [...sample.rotations]];
  if (lost[0]) [positions[0], rotations[0]] = [last.positions[0], last.rotations[0]];
  const turn = aboutVertical(headingOf(rotations[0]) - headingOf(last.rotations[0]));
  for (const hand of [1, 2].filter(i => lost[i])) {
    positions[hand] = plus(positions[0], rotate(turn, minus(last.positions[hand], last.positions[0])));
    rotations[hand] = multiply(turn, last.rotations[hand]);
  }
  return { time: sample.time, positions, rotations };
}

// Converts samples of three trackers to frames at the network's rate, and holds lost trackers.
class TrackerFrames {
  constructor(body, fps) {
    Object.assign(this, { body, fps });
    this.reset();
  }

  reset() {
    Object.assign(this, { last: null, lost: [false, false, false], origin: 0, count: 0, settled: -Infinity });
    this.returned = EACH.map(() => -Infinity); // time from which each tracker's difference shrinks
    this.shift = EACH.map(() => [0, 0, 0]);
    this.turn = EACH.map(() => IDENTITY);
  }

  get next() { return this.origin + this.count / this.fps; }

  // The frames that are due with a sample, and whether it restarts everything. Without a time, the sample is the next frame.
  take(time, positions, rotations, lost) {
    time ??= this.next;
    const later = this.last ? time - this.last.time : Infinity;
    if (-GAP <= later && later <= 0) return { frames: [], restarted: false };
    const restarted = Math.abs(later) > GAP;
    if (restarted) {
      this.reset();
      this.origin = time;
    }
    const before = this.last;
    const sample = this.fill({ time, positions, rotations }, lost);
    const frames = [];
    for (let due = this.next; due <= time + EARLY; due = this.next) {
      frames.push(Math.abs(due - time) <= SAME ? sample : interpolate(before ?? sample, sample, due));
      this.count++;
    }
    return { frames, restarted };
  }

  // The sample with lost trackers filled in, and returning trackers on their way to their true poses.
  fill(sample, lost) {
    const last = this.last ?? this.standIn(sample, lost);
    const returning = EACH.filter(i => this.lost[i] && !lost[i]);
    if (returning.length) this.settled = last.time + RECOVERY;
    for (const i of returning) {
      this.returned[i] = last.time;
      this.shift[i] = minus(last.positions[i], sample.positions[i]);
      this.turn[i] = multiply(last.rotations[i], inverse(sample.rotations[i]));
    }
    if (sample.time < this.settled) {
      const share = this.returned.map(since => Math.min(Math.max(1 - (sample.time - since) / RECOVERY, 0), 1));
      sample = {
        time: sample.time,
        positions: EACH.map(i => plus(sample.positions[i], this.shift[i], share[i])),
        rotations: EACH.map(i => multiply(slerp(IDENTITY, this.turn[i], share[i]), sample.rotations[i])),
      };
    }
    this.lost = lost;
    this.last = lost.includes(true) ? holdLost(sample, lost, last) : sample;
    return this.last;
  }

  // What precedes the first sample: the sample itself if no tracker is lost, else a T-pose under the head; without a head, at
  // the origin looking along +Z.
  standIn(sample, lost) {
    if (!lost.includes(true)) return sample;
    if (lost[0]) return tPose(this.body, [0, this.body.rest[0][1] - this.body.floor, 0], Math.PI);
    return tPose(this.body, sample.positions[0], headingOf(sample.rotations[0]));
  }
}

export class Stream {
  // body: { rest, floor }: head and wrists in the rest pose of the network's body, and its lowest joint's height, metres.
  // run: takes { positions (9 numbers), rotations (27), fresh } of a frame; `fresh` forgets the past. Resolves to
  //      { positions (66), rotations (198), joints (66) }. offsets: as `calibrate` finds them, or null.
  // scale: the network's body height over the person's (memmlp.live.wearer); the floor is at height 0.
  constructor({ fps, body, run, offsets = null, scale = 1 }) {
    Object.assign(this, { body, run, offsets, scale });
    this.trackers = new TrackerFrames(body, fps);
    this.reset();
  }

  // Restart. The next sample counts as the first sample. Its frame waits for the frames in progress.
  reset() {
    Object.assign(this, { still: [0, 0, 0], poses: [], sampled: -Infinity });
    this.trackers.reset();
    const forget = () => null;
    this.newest = (this.newest ?? Promise.resolve()).then(forget, forget);
  }

  read(trackers) { return trackers.map((tracker, i) => read(tracker, TRACKERS[i], this.still[i])); }

  // Measure how long each tracker has repeated its pose while another moved, seconds.
  measureStill(trackers, time) {
    const poses = trackers.map(tracker => (isLost(tracker) ? null : [...tracker.position, ...tracker.rotation].join()));
    const moved = poses.map((pose, i) => pose !== null && pose !== this.poses[i]);
    const elapsed = time === null ? 1 / this.trackers.fps : time - this.sampled;
    const longer = moved.includes(true) && elapsed > 0 && elapsed <= GAP ? elapsed : 0;
    this.still = this.still.map((seconds, i) => (moved[i] ? 0 : seconds + longer));
    this.poses = poses.map((pose, i) => pose ?? this.poses[i]);
    this.sampled = time ?? this.sampled + 1 / this.trackers.fps;
  }

  // Take one sample, { position, rotation } of each tracker or null if it is lost, at a time in seconds of any clock; without
  // a time, one frame after the last. Resolves to the newest frame's pose: { time, positions, rotations, joints, held, fresh,
  // restarted }, positions by forward kinematics, joints of the network's position branch. Samples are processed in turn.
  step(head, left, right, time = null) {
    if (time !== null && !Number.isFinite(time)) throw new Error(`time=${time}: must be a number of seconds, or null`);
    this.measureStill([head, left, right], time);
    const devices = this.read([head, left, right]);
    const { offsets: on, scale } = this;
    const positions = devices.map(({ position, rotation }, i) =>
      scaled(on ? plus(position, rotate(rotation, on.positions[i])) : position, scale));
    const rotations = devices.map(({ rotation }, i) => (on ? multiply(rotation, on.rotations[i]) : rotation));
    const lost = devices.map(device => device.lost);
    const { frames, restarted } = this.trackers.take(time, positions, rotations, lost);
    const held = TRACKERS.filter((_, i) => lost[i]);
    this.newest = this.newest.then(last => this.compute(frames, { restarted, held, scale }, last));
    return this.newest;
  }

  async compute(frames, { restarted, held, scale }, last) {
    if (!frames.length) return { ...last, held, fresh: false, restarted: false };
    let made = null;
    for (const [index, { positions, rotations }] of frames.entries()) {
      made = await this.run({
        positions: Float32Array.from(positions.flat()),
        rotations: Float32Array.from(rotations.flatMap(matrix)),
        fresh: restarted && index === 0,
      });
    }
    return { time: frames.at(-1).time, positions: made.positions.map(x => x / scale), rotations: made.rotations, joints: made.joints.map(x => x / scale), held, fresh: true, restarted };
  }

  // Learn the offsets from a person who stands upright in T-pose, and use them from now on. The line between the hands
  // gives the heading; the network's body in that pose is placed as near to the devices as possible.
  // scale: the one to use from now on, as in the constructor. An error leaves offsets and scale unchanged.
  calibrate(head, left, right, scale = this.scale) {
    const devices = this.read([head, left, right]);
    const missing = TRACKERS.filter((_, i) => devices[i].lost);
    if (missing.length) throw new Error(`needs all three trackers; lost: ${missing.join(', ')}`);
    const world = devices.map(device => scaled(device.position, scale));
    const across = minus(world[1], world[2]);
    if (Math.hypot(across[0], across[2]) < APART) throw new Error('the hands are not apart; stand in a T-pose with the arms to the sides');
    const heading = Math.atan2(across[2], -across[0]);
    const { rotation } = devices[0];
    const upright = rotate(rotation, [0, 1, 0])[1] > Math.cos(TILTED);
    if (upright && Math.cos(headingOf(rotation) - heading) < 0) {
      throw new Error("the head looks backwards relative to the hands; check that left and right are not exchanged, and the head's device");
    }
    const pose = tPose(this.body, world[0], heading);
    const away = EACH.map(axis => EACH.reduce((sum, i) => sum + (world[i][axis] - pose.positions[i][axis]) / 3, 0));
    const offsets = {
      positions: devices.map((device, i) =>
        rotate(inverse(device.rotation), minus(scaled(plus(pose.positions[i], away), 1 / scale), device.position))),
      rotations: devices.map((device, i) => multiply(inverse(device.rotation), pose.rotations[i])),
    };
    const distances = offsets.positions.map(place => Math.hypot(...place));
    const farthest = Math.max(...distances);
    if (farthest > FAR) {
      throw new Error(`${TRACKERS[distances.indexOf(farthest)]} is ${(100 * farthest).toFixed(0)} cm from its joint in a T-pose; stand upright with straight arms to the sides`);
    }
    Object.assign(this, { offsets, scale });
    this.reset();
    return offsets;
  }
}

// Whether a tracker is lost: the same rules as memmlp.live.tracker_input.find_lost. It is null, has NaN, is far away, at the
// exact origin or without a rotation, or it was still for some seconds in which another tracker moved.
export function isLost(tracker, still = 0) {
  if (!tracker?.position || !tracker.rotation || still > FROZEN) return true;
  const { position, rotation } = tracker;
  return ![...position, ...rotation].every(x => Number.isFinite(x) && Math.abs(x) <= FARTHEST) || !position.some(Boolean) || Math.hypot(...rotation) < UNIT;
}

// A tracker with a unit quaternion, or NEUTRAL.
function read(tracker, name, still) {
  if (tracker?.position && tracker.rotation && (tracker.position.length !== 3 || tracker.rotation.length !== 4)) throw new Error(`${name}: must be a position of 3 numbers and a rotation of 4 numbers`);
  const norm = Math.hypot(...(tracker?.rotation ?? IDENTITY));
  if (Math.abs(norm - 1) > UNIT && norm >= UNIT && norm < Infinity) throw new Error(`${name}: quaternion has norm ${norm.toPrecision(3)}; must be 1`);
  if (isLost(tracker, still)) return NEUTRAL;
  return { position: [...tracker.position], rotation: scaled(tracker.rotation, 1 / norm), lost: false };
}
