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
    Object.assign(this, { session, inputs: {}, zeros: {} });
    for (const { name, type, shape } of session.inputMetadata) {
      const tensor = new ort.Tensor(type, new Float32Array(shape.reduce((a, b) => a * b, 1)), shape);
      (name.startsWith(STATE) ? this.zeros : this.inputs)[name] = tensor;
    }
    this.reset();
  }

  // A fresh start.
  reset() { this.state = { ...this.zeros }; }

  // One step of the inputs, arrays by name; resolves to the outputs, arrays by name.
  async step(inputs) {
    for (const [name, values] of Object.entries(inputs)) this.inputs[name].data.set(values);
    const made = await this.session.run({ ...this.inputs, ...this.state });
    const outputs = {};
    for (const [name, tensor] of Object.entries(made)) {
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
