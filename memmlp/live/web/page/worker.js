// Runs networks beside the page, which goes on drawing: opens graphs, computes poses, times steps.

import { OnnxStream } from './onnx_stream.js';
import { Stream } from './stream.js';
import { clockStep, timeInTurn } from './timing.js';
import { fetched } from './worker_proxy.js';

const onnxStreams = new Map();
let runtime = null;

// ONNX Runtime on one thread; its SIMD is part of the build.
function load() {
  runtime ??= (async () => {
    const [ort, wasm] = await Promise.all([import('./ort/wasm.js'), fetched('ort/wasm.wasm.gz')]);
    Object.assign(ort.env.wasm, { numThreads: 1, wasmBinary: wasm });
    return ort;
  })();
  return runtime;
}

const calls = {
  async open(key, file) {
    const [ort, model] = await Promise.all([load(), fetched(file)]);
    onnxStreams.set(key, await OnnxStream.open(ort, model));
  },

  pose: (key, frame) => onnxStreams.get(key).pose(frame),

  // plan: [{ key, kind, body, fps }] of open graphs; kind: step, whole (from trackers to joints) or plain (no state).
  async time(plan, each, id) {
    const steps = Object.fromEntries(plan.map(part => [part.key, steppers[part.kind](onnxStreams.get(part.key), part)]));
    const times = await timeInTurn(steps, each, share => postMessage({ id, share }));
    for (const part of plan) await check(steps[part.key], part.key);
    return { times, clock: clockStep() };
  },
};

const steppers = {
  step(onnxStream) {
    const sparse = Float32Array.from({ length: 54 }, (_, i) => Math.sin(12.9898 * (i + 1)));
    return () => onnxStream.step({ sparse });
  },
  plain(onnxStream) {
    const inputs = Object.fromEntries(Object.entries(onnxStream.inputs).map(([name, tensor]) => [name, tensor.data.map(() => 1)]));
    return () => onnxStream.step(inputs);
  },
  // A sample of a person who sways, resampled, held and with the devices' offsets, to joints.
  whole(onnxStream, { body, fps }) {
    const offsets = { positions: [[0, -0.07, 0.09], [0, 0, 0], [0, 0, 0]], rotations: Array(3).fill([0, 0, 0, 1]) };
    const stream = new Stream({ fps, body, offsets, run: frame => onnxStream.pose(frame) });
    let count = 0;
    return () => {
      const angle = 0.4 * Math.sin(count++ / 20);
      const rotation = [0, Math.sin(angle / 2), 0, Math.cos(angle / 2)];
      const at = (x, y) => ({ position: [x + 0.1 * angle, y, 0.2 * angle], rotation });
      return stream.step(at(0, 1.6), at(-0.3, 1), at(0.3, 1));
    };
  },
};

// NaN or infinity could make a step quicker or slower than the network's.
async function check(step, key) {
  const arrays = Object.values(await step()).filter(value => value instanceof Float32Array);
  if (!arrays.length || !arrays.every(array => array.every(Number.isFinite))) throw new Error(`${key}: its outputs are not finite`);
}

onmessage = async ({ data: { id, call, args } }) => {
  try {
    postMessage({ id, value: await calls[call](...args, id) });
  } catch (error) {
    postMessage({ id, error: String(error?.message ?? error) });
  }
};
