// A trained network that is fed live: three trackers' poses in, a body's pose out, as memmlp.live.stream.Stream.
//
// Everything is in OpenXR's frame of reference: metres, Y up, -Z forward; a rotation is the identity for a person in
// T-pose who looks along -Z. This module knows neither three.js nor what runs the network: `run` does one frame of the
// full graph (memmlp.live.trackers_to_body_graph, space openxr), and its caller is a page, a worker or node.

import { headingOf, inverse, matrix, minus, multiply, plus, rotate } from './rotations.js';
import { tPose, TrackerFrames } from './trackers.js';

export const TRACKERS = ['head', 'left', 'right'];
const FARTHEST = 1e6; // metres; a tracker farther from the origin is taken as lost
const FAR = 0.25; // metres from a T-pose's joint, beyond which a device is not worn there
const UNIT = 1e-2; // how far a quaternion's norm may be from 1
const APART = 0.1; // metres between the hands, at least, in a T-pose
const TILTED = Math.PI / 3; // from upright; which way a device that is tilted further looks, nobody knows
const NEUTRAL = { position: [0, 0, 0], rotation: [0, 0, 0, 1], lost: true };

export class Stream {
  // fps: the network's frames a second.
  // body: { rest, floor }: head and wrists in the rest pose of the network's body, and its lowest joint's height, metres.
  // run: takes { positions (9 numbers), rotations (27), fresh } of a frame and resolves to { positions (66),
  //      rotations (198), joints (66) } as the full graph gives them; `fresh` says that the past is to be forgotten.
  // offsets: { positions, rotations } of the joints on the devices, as `calibrate` finds them; null for none.
  // scale: the height of the network's body over the person's, as memmlp.live.wearer has it; the floor is at height 0.
  constructor({ fps, body, run, offsets = null, scale = 1 }) {
    Object.assign(this, { body, run, offsets, scale });
    this.trackers = new TrackerFrames(body, fps);
    this.reset();
  }

  // Begin anew: the next sample is the first. Its frame still waits for those that are being worked on.
  reset() {
    this.trackers.reset();
    const forget = () => null;
    this.newest = (this.newest ?? Promise.resolve()).then(forget, forget);
  }

  // Take in one sample, { position, rotation } of each tracker or null where it is lost, at a time in seconds of any
  // clock; without one, exactly one frame after the last. Resolves to the newest frame's pose:
  // { time, positions, rotations, joints, held, fresh, restarted }, positions by forward kinematics, joints of the
  // network's position branch. Samples may be given before the last one's pose is there: they are worked on in turn.
  step(head, left, right, time = null) {
    if (time !== null && !Number.isFinite(time)) throw new Error(`time=${time}: allowed is a number of seconds, or null`);
    const { positions, rotations, lost } = this.joints([head, left, right].map(read));
    const { frames, restarted } = this.trackers.take(time, positions, rotations, lost);
    const held = TRACKERS.filter((_, i) => lost[i]);
    const { scale } = this;
    this.newest = this.newest.then(last => this.posed(frames, { restarted, held, scale }, last));
    return this.newest;
  }

  // Learn the offsets from a person who stands upright in T-pose, and use them from now on. The line between the hands
  // tells which way the person looks; the network's body in that pose is laid as near to the devices as possible.
  // scale: the one to use from now on, as in the constructor. An error leaves offsets and scale as they were.
  calibrate(head, left, right, scale = this.scale) {
    const devices = [head, left, right].map(read);
    const missing = TRACKERS.filter((_, i) => devices[i].lost);
    if (missing.length) throw new Error(`no pose of ${missing.join(', ')}; all three are needed`);
    const world = devices.map(device => times(device.position, scale));
    const across = minus(world[1], world[2]);
    if (Math.hypot(across[0], across[2]) < APART) throw new Error('the hands are not apart; stand in T-pose, the arms to the sides');
    const heading = Math.atan2(across[2], -across[0]);
    if (looksBack(devices[0].rotation, heading)) {
      throw new Error("the head looks backwards as seen from the hands; left and right look exchanged, or the head's device is mounted backwards");
    }
    const pose = tPose(this.body, world[0], heading);
    const away = [0, 1, 2].map(axis => mean(world.map((place, i) => place[axis] - pose.positions[i][axis])));
    const offsets = {
      positions: devices.map((device, i) =>
        rotate(inverse(device.rotation), minus(times(plus(pose.positions[i], away), 1 / scale), device.position))),
      rotations: devices.map((device, i) => multiply(inverse(device.rotation), pose.rotations[i])),
    };
    checkWorn(offsets);
    Object.assign(this, { offsets, scale });
    this.reset();
    return offsets;
  }

  // The joints on the devices, in metres of the network's body.
  joints(devices) {
    const rotations = devices.map(device => device.rotation);
    const positions = devices.map(device => device.position);
    const on = this.offsets;
    return {
      positions: positions.map((place, i) => times(on ? plus(place, rotate(rotations[i], on.positions[i])) : place, this.scale)),
      rotations: rotations.map((rotation, i) => (on ? multiply(rotation, on.rotations[i]) : rotation)),
      lost: devices.map(device => device.lost),
    };
  }

  async posed(frames, { restarted, held, scale }, last) {
    if (!frames.length) return { ...last, held, fresh: false, restarted: false };
    let made = null;
    for (const [index, { positions, rotations }] of frames.entries()) {
      made = await this.run({
        positions: Float32Array.from(positions.flat()),
        rotations: Float32Array.from(rotations.flatMap(matrix)),
        fresh: restarted && index === 0,
      });
    }
    const metres = joints => joints.map(x => x / scale);
    return {
      time: frames.at(-1).time, positions: metres(made.positions), rotations: made.rotations, joints: metres(made.joints),
      held, fresh: true, restarted,
    };
  }
}

// Whether a head's device looks away from a heading by over 90 degrees. One that is far from upright is not asked.
const looksBack = (rotation, heading) =>
  rotate(rotation, [0, 1, 0])[1] > Math.cos(TILTED) && Math.cos(headingOf(rotation) - heading) < 0;

// Throw an error if a device is farther from its joint than it can be on a person in T-pose.
function checkWorn({ positions }) {
  const distances = positions.map(place => Math.hypot(...place));
  const worst = distances.indexOf(Math.max(...distances));
  if (distances[worst] <= FAR) return;
  throw new Error(`${TRACKERS[worst]} is ${(100 * distances[worst]).toFixed(0)} cm from where a T-pose has it; stand upright, arms straight to the sides`);
}

// The heading of a head, radians to the left of -Z.
export const heading = tracker => headingOf(tracker.rotation);

const times = (vector, factor) => vector.map(x => factor * x);
const mean = numbers => numbers.reduce((a, b) => a + b, 0) / numbers.length;

// A tracker with a unit quaternion; one that is null, far away, or has NaN or a quaternion of zeros is lost.
function read(tracker, index) {
  if (!tracker) return NEUTRAL;
  const numbers = [...tracker.position, ...tracker.rotation];
  if (numbers.length !== 7) throw new Error(`${TRACKERS[index]}: allowed are a position of 3 and a rotation of 4 numbers`);
  const norm = Math.hypot(...tracker.rotation);
  if (norm === 0 || !numbers.every(x => Math.abs(x) <= FARTHEST)) return NEUTRAL;
  if (Math.abs(norm - 1) > UNIT) throw new Error(`${TRACKERS[index]}: a quaternion of norm ${norm.toPrecision(3)}; allowed is 1`);
  return { position: [...tracker.position], rotation: tracker.rotation.map(x => x / norm), lost: false };
}
