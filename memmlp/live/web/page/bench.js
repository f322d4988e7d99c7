// Times every network of the site in this browser, and gives the measurement as rows for Table 17.

import { h, replace, say } from './dom.js';
import { WorkerProxy } from './worker_proxy.js';
import { median, percentile, ratio, ROUNDS } from './timing.js';

const STEPS = [500, 1000, 2500];
const GRAPHS = { naive: 'as published', streaming: 'stream' };
const YARDSTICK = 'yardstick';
const COLUMNS = [['network'], ['graph'], ['step', 'median, ms', 'n'], ['', 'p95, ms', 'n wide'], ['ratio', 'to AvatarPoser', 'n'],
  ['whole pose', 'median, ms', 'n'], ['', 'p95, ms', 'n wide']];

export function bench(page, site) {
  const view = new Bench(page, site);
  view.describe();
  const hidden = () => { if (document.hidden && view.proxy) view.stop('Stopped: browsers slow down a page in the background.'); };
  document.addEventListener('visibilitychange', hidden);
  return () => {
    document.removeEventListener('visibilitychange', hidden);
    view.stop();
  };
}

class Bench {
  constructor(page, site) {
    Object.assign(this, { page, site, results: new Map(), failures: new Map(), proxy: null, clock: 0 });
    // What is timed: { key, network, graph, precision, step, whole }, the graphs of the base first.
    this.items = [site.base, ...site.networks].flatMap(network =>
      network.graphs.map(part => ({ key: `${network.key} ${part.graph} ${part.precision}`, network, ...part })));
    this.device = h('input', { type: 'text', id: 'device', maxLength: 60, placeholder: 'such as Quest 3', autocomplete: 'off' });
    this.steps = h('select', { id: 'steps' }, STEPS.map(count => h('option', { value: count }, `${count} steps`)));
    this.gpu = h('input', { type: 'checkbox', id: 'webgpu', disabled: true });
    this.start = h('button', { type: 'button', class: 'primary', id: 'start', onclick: () => (this.proxy ? this.stop('Stopped.') : this.measure()) }, 'Start');
    this.copy = h('button', { type: 'button', id: 'copy', disabled: true, onclick: () => this.copied() }, 'Copy as Table 17 row');
    this.save = h('button', { type: 'button', id: 'save', disabled: true, onclick: () => this.saved() }, 'Save as file');
    this.note = h('p', { class: 'faint', id: 'progress' }, 'Nothing is measured yet. Keep this page in front, and the device on its charger.');
    this.bar = h('progress', { max: 1, value: 0, hidden: true });
    this.body = h('tbody');
    const head = COLUMNS.map(([name, unit, kind]) => h('th', { class: kind }, name, unit && h('small', {}, unit)));
    replace(page,
      h('h1', {}, 'The time of a step here'),
      h('p', { class: 'faint' }, `One step of each network at 60 Hz on one thread, the networks in turn over ${ROUNDS} rounds. Each step is `
        + 'awaited and its outputs are read. The ratio is to AvatarPoser as published, in this browser on the same backend. The whole pose '
        + 'goes from trackers to joints: resampling, features, network, forward kinematics. Weights are random, which does not matter.'),
      h('div', { class: 'tools' },
        h('label', { class: 'field' }, h('span', {}, 'Device'), this.device),
        h('label', { class: 'field' }, h('span', {}, 'Each network'), this.steps),
        h('label', { class: 'tick' }, this.gpu, h('span', { id: 'gpu' }, 'WebGPU')),
        this.start, this.copy, this.save),
      this.note, this.bar,
      h('div', { class: 'scroll' }, h('table', { class: 'times' }, h('thead', {}, h('tr', {}, head)), this.body)));
    this.rows();
  }

  // Find the device, the browser, and whether WebGPU is available.
  async describe() {
    this.about = await machine();
    if (!this.device.value) this.device.value = this.about.device;
    const problem = !this.site.backends.includes('webgpu') ? 'not on this site' : await noWebGPU();
    this.gpu.disabled = problem !== null;
    this.gpu.checked = problem === null;
    document.getElementById('gpu').textContent = problem === null ? 'WebGPU' : `WebGPU: ${problem}`;
    document.documentElement.dataset.bench = 'ready';
  }

  stop(words) {
    this.proxy?.close();
    this.proxy = null;
    this.start.textContent = 'Start';
    this.bar.hidden = true;
    if (words) this.note.textContent = words;
  }

  async measure() {
    this.results.clear();
    this.failures.clear();
    this.rows();
    this.copy.disabled = this.save.disabled = true;
    this.start.textContent = 'Stop';
    this.bar.hidden = false;
    const each = Math.ceil(this.steps.value / ROUNDS);
    try {
      for (const backend of this.gpu.checked ? ['wasm', 'webgpu'] : ['wasm']) await this.backend(backend, each);
      this.stop(`Measured ${this.results.size} rows, ${each * ROUNDS} steps each.`);
      say(this.note.textContent);
      document.documentElement.dataset.bench = 'done';
    } catch (error) {
      if (error.message !== 'stopped') this.stop(`Failed: ${error.message}`);
    }
    this.copy.disabled = this.save.disabled = this.results.size === 0;
  }

  // Time everything on a backend. The row of a graph that does not run there shows the reason.
  async backend(backend, each) {
    const proxy = (this.proxy = new WorkerProxy());
    const plan = [];
    const open = async (key, entry, part) => {
      this.note.textContent = `${backend}: loading ${key}`;
      try {
        await proxy.open(key, entry, backend);
        plan.push({ key, ...part });
      } catch (error) {
        if (error.message === 'stopped') throw error;
        this.failures.set(`${key} ${backend}`, error.message);
      }
    };
    await open(YARDSTICK, this.site.yardstick, { kind: 'plain' });
    for (const item of this.items) {
      const { body, fps } = item.network;
      await open(item.key, item.step, { kind: 'step' });
      if (item.whole) await open(`${item.key} whole`, item.whole, { kind: 'whole', body, fps });
    }
    this.note.textContent = `${backend}: ${each * ROUNDS} steps of ${this.items.length} graphs, alone and as a whole pose`;
    const { times, clock } = await proxy.call('time', [plan, each], share => { this.bar.value = share; });
    this.clock = Math.max(clock, this.clock);
    const [base, yardstick] = [times[this.items[0].key], times[YARDSTICK]];
    for (const { key, network, graph, precision } of this.items) {
      const [alone, whole] = [times[key], times[`${key} whole`]];
      if (!alone) continue;
      this.results.set(`${key} ${backend}`, {
        network: network.name, run: network.run, frames: network.frames, parameters: network.parameters,
        graph, precision, backend, threads: 1, steps: each * ROUNDS,
        median_ms: median(alone.flat()), p95_ms: percentile(alone.flat(), 95),
        ratio_to_avatar_poser: base ? ratio(alone, base) : null,
        ratio_to_yardstick: yardstick ? ratio(alone, yardstick) : null,
        whole_median_ms: whole ? median(whole.flat()) : null, whole_p95_ms: whole ? percentile(whole.flat(), 95) : null,
      });
    }
    proxy.close();
    this.rows();
  }

  rows() {
    const gpu = this.failures.size || [...this.results.keys()].some(key => key.endsWith('webgpu'));
    const most = Math.max(...[...this.results.values()].map(row => row.ratio_to_avatar_poser ?? 0), 1);
    replace(this.body, this.items.flatMap(item => (gpu ? ['wasm', 'webgpu'] : ['wasm']).map(backend => this.row(item, backend, most))));
  }

  row({ key, network, graph, precision }, backend, most) {
    const found = this.results.get(`${key} ${backend}`);
    const reason = this.failures.get(`${key} ${backend}`);
    const number = (value, kind = 'n') => h('td', { class: kind }, value?.toFixed(2) ?? '–');
    const start = [
      h('th', { scope: 'row' }, network.name, h('small', {}, `${(network.parameters / 1e6).toFixed(2)} M`)),
      h('td', {}, `${GRAPHS[graph]}, ${precision}, ${backend}`),
    ];
    if (reason) return h('tr', {}, start, h('td', { colSpan: 5, class: 'faint' }, reason));
    const share = h('i', { style: `width: ${(100 * (found?.ratio_to_avatar_poser ?? 0)) / most}%` });
    return h('tr', {}, start, number(found?.median_ms), number(found?.p95_ms, 'n wide'),
      h('td', { class: 'n' }, found?.ratio_to_avatar_poser?.toFixed(2) ?? '–', h('span', { class: 'share' }, share)),
      number(found?.whole_median_ms), number(found?.whole_p95_ms, 'n wide'));
  }

  // The measurement as a file for `memmlp table 17 --add`.
  file() {
    const { browser, agent } = this.about;
    return JSON.stringify({
      format: 'memmlp web bench 1', memmlp: this.site.memmlp, date: new Date().toISOString().slice(0, 19) + '+00:00',
      device: this.device.value.trim() || 'unknown device', browser, agent, onnxruntime_web: this.site.packages['onnxruntime-web'],
      cores: navigator.hardwareConcurrency ?? null, clock_ms: this.clock, rounds: ROUNDS, rows: [...this.results.values()],
    }, null, 1);
  }

  async copied() {
    try {
      await navigator.clipboard.writeText(this.file());
      this.note.textContent = 'Copied. Paste it into a file, and show it with memmlp table 17 --add FILE.';
    } catch {
      this.note.textContent = 'This browser does not allow the clipboard here; save it as a file instead.';
    }
    say(this.note.textContent);
  }

  saved() {
    h('a', { href: `data:application/json,${encodeURIComponent(this.file())}`, download: 'table17.json' }).click();
    this.note.textContent = 'Show it with memmlp table 17 --add table17.json.';
  }
}

// Device and browser, as far as the browser reports them.
async function machine() {
  const agent = navigator.userAgent;
  const known = await navigator.userAgentData?.getHighEntropyValues?.(['model', 'platform', 'fullVersionList']).catch(() => null);
  const quest = /Quest ?(\d\w*|Pro)/.exec(agent)?.[0];
  const brands = known?.fullVersionList?.filter(({ brand }) => !/not.?a.?brand/i.test(brand)) ?? [];
  const brand = brands.find(({ brand }) => brand !== 'Chromium') ?? brands[0];
  const [, name, version] = /(OculusBrowser|Firefox|Edg|Chrome|Version)\/([\d.]+)/.exec(agent) ?? [];
  return {
    agent,
    device: quest || known?.model || known?.platform || navigator.platform || '',
    browser: brand ? `${brand.brand} ${brand.version}` : name ? `${name === 'Version' ? 'Safari' : name} ${version}` : 'unknown browser',
  };
}

// The reason why WebGPU is not available; null if it is.
async function noWebGPU() {
  if (!navigator.gpu) return window.isSecureContext ? 'not in this browser' : 'only at https or localhost';
  const adapter = await navigator.gpu.requestAdapter().catch(() => null);
  return adapter ? null : 'no device';
}
