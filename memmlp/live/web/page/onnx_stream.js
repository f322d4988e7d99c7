// An exported step in ONNX Runtime (memmlp.deploy.onnx_stream.OnnxStream), whatever build of it `ort` is.
//
// The inputs `state.*` are fed by the outputs `state.*.next` of the step before, zeros at first.

const STATE = 'state.';
const NEXT = '.next';

export class OnnxStream {
  // model: the ONNX file's bytes.
  static async open(ort, model) {
    const options = { executionProviders: ['wasm'], graphOptimizationLevel: 'all', logSeverityLevel: 3 };
    return new OnnxStream(ort, await ort.InferenceSession.create(model, options));
  }

  constructor(ort, session) {
    Object.assign(this, { session });
    this.makers = Object.fromEntries(session.inputMetadata.map(({ name, type, shape }) =>
      [name, (values = new Float32Array(shape.reduce((a, b) => a * b, 1))) => new ort.Tensor(type, values, shape)]));
    this.reset();
  }

  // A fresh start.
  reset() { this.state = Object.fromEntries(Object.keys(this.makers).filter(name => name.startsWith(STATE)).map(name => [name, this.makers[name]()])); }

  close() { return this.session.release(); }

  // One step of the inputs, arrays by name, which it takes over; resolves to the outputs, arrays by name.
  async step(inputs) {
    const tensors = Object.fromEntries(Object.entries(inputs).map(([name, values]) => [name, this.makers[name](values)]));
    const outputs = {};
    for (const [name, tensor] of Object.entries(await this.session.run({ ...tensors, ...this.state }))) {
      if (name.endsWith(NEXT)) this.state[name.slice(0, -NEXT.length)] = tensor;
      else outputs[name] = tensor.data;
    }
    return outputs;
  }

  // One frame of the full graph, as a Stream's `run`.
  async pose({ positions, rotations, fresh }) {
    if (fresh) this.reset();
    return this.step({ tracker_positions: positions, tracker_rotations: rotations });
  }
}
