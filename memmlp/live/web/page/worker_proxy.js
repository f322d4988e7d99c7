// The worker as an object: a call by name resolves to the worker's answer.

export class WorkerProxy {
  constructor() {
    this.worker = new Worker('worker.js', { type: 'module' });
    this.waiting = new Map();
    this.count = 0;
    this.worker.addEventListener('message', ({ data }) => this.answered(data));
    this.worker.addEventListener('error', event => this.failed(event.message || 'the worker could not be loaded'));
  }

  // progress(share) reports a long call's progress.
  call(name, args, progress = () => {}) {
    return new Promise((resolve, reject) => {
      this.waiting.set(++this.count, { resolve, reject, progress });
      this.worker.postMessage({ id: this.count, call: name, args });
    });
  }

  open(key, entry, backend = 'wasm') { return this.call('open', [key, entry, backend]); }

  answered({ id, value, error, share }) {
    const waits = this.waiting.get(id);
    if (!waits) return;
    if (share !== undefined) return waits.progress(share);
    this.waiting.delete(id);
    if (error === undefined) waits.resolve(value);
    else waits.reject(new Error(error));
  }

  failed(reason) {
    for (const { reject } of this.waiting.values()) reject(new Error(reason));
    this.waiting.clear();
  }

  close() {
    this.worker.terminate();
    this.failed('stopped');
  }
}
