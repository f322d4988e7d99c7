// A network in ONNX Runtime, which computes in its own worker, so that drawing does not wait for it.

import { OnnxStream } from './onnx_stream.js';

// The bytes of a file of the site, decompressed unless the server did that already.
export async function fetchFile(address) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(`${address}: the server answers ${answer.status}`);
  const content = new Uint8Array(await answer.arrayBuffer());
  if (content[0] !== 0x1f || content[1] !== 0x8b) return content;
  const stream = new Blob([content]).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

export async function openNetwork(file) {
  const [ort, wasmBinary, model] = await Promise.all([import('./ort/wasm.js'), fetchFile('ort/wasm.wasm.gz'), fetchFile(file)]);
  Object.assign(ort.env.wasm, { numThreads: 1, proxy: true, wasmBinary });
  return OnnxStream.open(ort, model);
}
