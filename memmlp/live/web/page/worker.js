// Runs one network in ONNX Runtime on one thread: opens its graph, then computes poses.

import { OnnxStream } from './onnx_stream.js';
import { fetchFile } from './network_worker.js';

let onnxStream = null;

const calls = {
  async open(file) {
    const [ort, wasm, model] = await Promise.all([import('./ort/wasm.js'), fetchFile('ort/wasm.wasm.gz'), fetchFile(file)]);
    Object.assign(ort.env.wasm, { numThreads: 1, wasmBinary: wasm });
    onnxStream = await OnnxStream.open(ort, model);
  },

  pose: frame => onnxStream.pose(frame),
};

onmessage = async ({ data: { name, argument } }) => {
  try {
    postMessage({ value: await calls[name](argument) });
  } catch (error) {
    postMessage({ error: String(error?.message ?? error) });
  }
};
