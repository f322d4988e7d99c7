// The worker as an object, whose calls resolve to the worker's answers; and the files that both load.

// The bytes of a file of the site, decompressed unless the server did that already.
export async function fetched(address) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(`${address}: the server answers ${answer.status}`);
  const content = new Uint8Array(await answer.arrayBuffer());
  if (content[0] !== 0x1f || content[1] !== 0x8b) return content;
  const stream = new Blob([content]).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

export class WorkerProxy {
  constructor() {
    this.worker = new Worker('worker.js', { type: 'module' });
    this.waiting = new Map();
    this.count = 0;
    this.worker.addEventListener('message', ({ data }) => this.receive(data));
    this.worker.addEventListener('error', event => this.fail(event.message || 'the worker could not be loaded'));
  }

  // progress(share) reports a long call's progress.
  call(name, args, progress = () => {}) {
    return new Promise((resolve, reject) => {
      this.waiting.set(++this.count, { resolve, reject, progress });
      this.worker.postMessage({ id: this.count, call: name, args });
    });
  }

  receive({ id, value, error, share }) {
    const waits = this.waiting.get(id);
    if (!waits) return;
    if (share !== undefined) return waits.progress(share);
    this.waiting.delete(id);
    if (error === undefined) waits.resolve(value);
    else waits.reject(new Error(error));
  }

  fail(reason) {
    for (const { reject } of this.waiting.values()) reject(new Error(reason));
    this.waiting.clear();
  }

  close() {
    this.worker.terminate();
    this.fail('stopped');
  }
}
