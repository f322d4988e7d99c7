// A whole body from head and hands: node full_body.mjs body.onnx trackers.csv > joints.csv
//
// body.onnx is what `memmlp export RUN --scope full --space SPACE --out body.onnx` writes. trackers.csv has a
// header and one row for each frame at 60 Hz: x, y, z in metres and a quaternion qx, qy, qz, qw of head, left
// and right wrist, in SPACE. What comes out are the 22 joints of each frame, metres, in SPACE.
import { readFileSync, writeFileSync } from "node:fs";
import * as ort from "onnxruntime-web/wasm";

// Their order is that of the ONNX file, whose metadata have it too, but ONNX Runtime's JavaScript does not show it.
export const JOINTS = [
  "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
  "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head",
  "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
];

/** The network with its memory: one step for each frame at 60 Hz. */
export class FullBody {
  /** Open the bytes of an ONNX file. */
  static async open(bytes) {
    const session = await ort.InferenceSession.create(bytes, { executionProviders: ["wasm"] });
    if (!session.inputNames.includes("tracker_positions"))
      throw new Error("not written by memmlp export with --scope full");
    return new FullBody(session);
  }

  constructor(session) {
    this.session = session;
    this.reset();
  }

  /** Forget the past: a fresh start is zeros. */
  reset() {
    const states = this.session.inputMetadata.filter((input) => input.name.startsWith("state."));
    this.state = Object.fromEntries(states.map(({ name, shape }) => [name, zeros(shape)]));
  }

  /**
   * Take in one frame: positions (9 numbers: head, left, right) in metres, rotations (27: row by row) matrices.
   *
   * Returns Float32Arrays: rotations (22 x 9), each relative to its parent's and the root's global, or
   * quaternions (22 x 4) of a file that was exported so; positions (22 x 3), metres, by forward kinematics;
   * joints (22 x 3), the network's own guess of the positions.
   */
  async step(positions, rotations) {
    const made = await this.session.run({
      tracker_positions: new ort.Tensor("float32", Float32Array.from(positions), [1, 3, 3]),
      tracker_rotations: new ort.Tensor("float32", Float32Array.from(rotations), [1, 3, 3, 3]),
      ...this.state,
    });
    for (const name in this.state) this.state[name] = made[`${name}.next`];
    return { rotations: made.rotations.data, positions: made.positions.data, joints: made.joints.data };
  }
}

function zeros(shape) {
  return new ort.Tensor("float32", new Float32Array(shape.reduce((a, b) => a * b, 1)), shape);
}

/** The matrix, row by row, of a unit quaternion. */
export function matrix([x, y, z, w]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
    2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
    2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
  ];
}

/** The frames of a CSV file, each three trackers of 7 numbers. */
function readTrackers(path) {
  const lines = readFileSync(path, "utf8").trim().split(/\r?\n/).slice(1);
  return lines.map((line, index) => {
    const row = line.split(",").map((word) => (word.trim() ? Number(word) : NaN));
    const frame = [0, 7, 14].map((start) => row.slice(start, start + 7));
    // A lost tracker is refused: NaN would stay in the network's memory for ever.
    if (row.length !== 21 || !frame.every(isPose))
      throw new Error(`${path}: line ${index + 2}: not 3 x (three metres and a unit quaternion)`);
    return frame;
  });
}

function isPose(pose) {
  return pose.every(Number.isFinite) && Math.abs(Math.hypot(...pose.slice(3)) - 1) < 1e-2;
}

async function main([network, trackers]) {
  const frames = readTrackers(trackers);
  ort.env.wasm.numThreads = 1; // quicker than more for so small a network
  const body = await FullBody.open(readFileSync(network));
  const rows = [JOINTS.flatMap((joint) => ["x", "y", "z"].map((axis) => `${joint}.${axis}`)).join()];
  for (const frame of frames) {
    const positions = frame.flatMap((pose) => pose.slice(0, 3));
    const made = await body.step(positions, frame.flatMap((pose) => matrix(pose.slice(3))));
    rows.push(Array.from(made.positions, (value) => value.toFixed(6)).join());
  }
  writeFileSync(1, rows.join("\n") + "\n");
}

if (process.argv.length !== 4) {
  console.error("usage: node full_body.mjs body.onnx trackers.csv > joints.csv");
  process.exit(2);
}
try {
  await main(process.argv.slice(2));
} catch (error) {
  console.error(error.message);
  process.exit(1);
}
