// Plays samples through the site's stream.js in node: node play.mjs PAGE ORT WASM MODEL JOB; JOB and the answer are JSON.

import { readFileSync, writeFileSync } from 'node:fs';
import { pathToFileURL } from 'node:url';

const [page, runtime, wasm, model, job] = process.argv.slice(2);
const load = path => import(pathToFileURL(path).href);
const [{ OnnxStream }, { Stream }, ort] = await Promise.all([load(`${page}/onnx_stream.js`), load(`${page}/stream.js`), load(runtime)]);
Object.assign(ort.env.wasm, { numThreads: 1, wasmBinary: readFileSync(wasm) });
const session = await OnnxStream.open(ort, new Uint8Array(readFileSync(model)));
const { body, parts } = JSON.parse(readFileSync(job));
const answers = [];
for (const { calibrate, height, samples } of parts) {
  const scale = height ? body.height / height : 1;
  const stream = new Stream({ fps: 60, body, scale, run: frame => session.pose(frame) });
  let refused = null;
  try {
    if (calibrate) stream.calibrate(...calibrate);
  } catch (error) {
    refused = error.message;
  }
  const poses = [];
  for (const { trackers, time } of samples) {
    const pose = await stream.step(...trackers, time);
    poses.push({ ...pose, positions: [...pose.positions], rotations: [...pose.rotations], joints: [...pose.joints] });
  }
  answers.push({ offsets: stream.offsets, refused, poses });
}
writeFileSync(`${job}.answer`, JSON.stringify(answers));
