// A network in a worker of its own, so that drawing does not wait for it; and the files that both load.

// The bytes of a file of the site, decompressed unless the server did that already.
export async function fetchFile(address) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(`${address}: the server answers ${answer.status}`);
  const content = new Uint8Array(await answer.arrayBuffer());
  if (content[0] !== 0x1f || content[1] !== 0x8b) return content;
  const stream = new Blob([content]).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

export class NetworkWorker {
  constructor() {
    this.worker = new Worker('worker.js', { type: 'module' });
  }

  open(file) { return this.call('open', file); }
  pose(frame) { return this.call('pose', frame); }

  // One call at a time. After `close`, a pending call never settles.
  call(name, argument) {
    this.worker.postMessage({ name, argument });
    return new Promise((resolve, reject) => {
      this.worker.onmessage = ({ data }) => ('error' in data ? reject(new Error(data.error)) : resolve(data.value));
      this.worker.onerror = event => reject(new Error(event.message || 'the worker could not be loaded'));
    });
  }

  close() { this.worker.terminate(); }
}
