// Times every network of the site in this browser, and gives the measurement as rows for Table 17.

import { h, replace, say } from './dom.js';
import { WorkerProxy } from './worker_proxy.js';
import { median, percentile, ratio, ROUNDS } from './timing.js';

const STEPS = [500, 1000, 2500];
const GRAPHS = { naive: 'as published', streaming: 'stream' };
const YARDSTICK = 'yardstick';
const BACKEND = 'wasm';
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
    Object.assign(this, { site, results: new Map(), proxy: null, clock: 0 });
    // What is timed: { key, network, graph, precision, step, whole }, the graphs of the base first.
    this.items = [site.base, ...site.networks].flatMap(network =>
      network.graphs.map(part => ({ key: `${network.key} ${part.graph} ${part.precision}`, network, ...part })));
    this.device = h('input', { type: 'text', id: 'device', maxLength: 60, placeholder: 'such as Quest 3', autocomplete: 'off' });
    this.steps = h('select', { id: 'steps' }, STEPS.map(count => h('option', { value: count }, `${count} steps`)));
    this.start = h('button', { type: 'button', class: 'primary', id: 'start', onclick: () => (this.proxy ? this.stop('Stopped.') : this.measure()) }, 'Start');
    this.save = h('button', { type: 'button', id: 'save', disabled: true, onclick: () => this.download() }, 'Save as file');
    this.note = h('p', { class: 'faint', id: 'progress' }, 'Nothing is measured yet. Keep this page in front, and the device on its charger.');
    this.bar = h('progress', { max: 1, value: 0, hidden: true });
    this.body = h('tbody');
    const head = COLUMNS.map(([name, unit, kind]) => h('th', { class: kind }, name, unit && h('small', {}, unit)));
    replace(page,
      h('h1', {}, 'The time of a step here'),
      h('p', { class: 'faint' }, `One step of each network at 60 Hz on one thread, the networks in turn over ${ROUNDS} rounds. Each step is `
        + 'awaited and its outputs are read. The ratio is to AvatarPoser as published, in this browser. The whole pose '
        + 'goes from trackers to joints: resampling, features, network, forward kinematics. Weights are random, which does not matter.'),
      h('div', { class: 'tools' },
        h('label', { class: 'field' }, h('span', {}, 'Device'), this.device),
        h('label', { class: 'field' }, h('span', {}, 'Each network'), this.steps),
        this.start, this.save),
      this.note, this.bar,
      h('div', { class: 'scroll' }, h('table', { class: 'times' }, h('thead', {}, h('tr', {}, head)), this.body)));
    this.rows();
  }

  async describe() {
    this.about = await machine();
    this.device.value ||= this.about.device;
    document.documentElement.dataset.bench = 'ready';
  }

  stop(line) {
    this.proxy?.close();
    this.proxy = null;
    this.start.textContent = 'Start';
    this.bar.hidden = true;
    if (line) this.note.textContent = line;
  }

  async measure() {
    this.results.clear();
    this.rows();
    this.save.disabled = true;
    this.start.textContent = 'Stop';
    this.bar.hidden = false;
    const each = Math.ceil(this.steps.value / ROUNDS);
    try {
      await this.time(each);
      this.stop(`Measured ${this.results.size} rows, ${each * ROUNDS} steps each.`);
      say(this.note.textContent);
      document.documentElement.dataset.bench = 'done';
    } catch (error) {
      if (error.message !== 'stopped') this.stop(`Failed: ${error.message}`);
    }
    this.save.disabled = this.results.size === 0;
    this.rows();
  }

  async time(each) {
    const proxy = (this.proxy = new WorkerProxy());
    const plan = [];
    const open = async (key, file, part) => {
      this.note.textContent = `loading ${key}`;
      await proxy.call('open', [key, file]);
      plan.push({ key, ...part });
    };
    await open(YARDSTICK, this.site.yardstick, { kind: 'plain' });
    for (const { key, network, step, whole } of this.items) {
      await open(key, step, { kind: 'step' });
      if (whole) await open(`${key} whole`, whole, { kind: 'whole', body: network.body, fps: network.fps });
    }
    this.note.textContent = `${each * ROUNDS} steps of ${this.items.length} graphs, alone and as a whole pose`;
    const { times, clock } = await proxy.call('time', [plan, each], share => { this.bar.value = share; });
    this.clock = clock;
    const base = times[this.items[0].key];
    for (const { key, network, graph, precision } of this.items) {
      const [alone, whole] = [times[key], times[`${key} whole`]];
      this.results.set(key, {
        network: network.name, run: network.run, frames: network.frames, parameters: network.parameters,
        graph, precision, backend: BACKEND, threads: 1, steps: each * ROUNDS,
        median_ms: median(alone.flat()), p95_ms: percentile(alone.flat(), 95),
        ratio_to_avatar_poser: ratio(alone, base), ratio_to_yardstick: ratio(alone, times[YARDSTICK]),
        whole_median_ms: whole ? median(whole.flat()) : null, whole_p95_ms: whole ? percentile(whole.flat(), 95) : null,
      });
    }
  }

  rows() {
    const most = Math.max(...[...this.results.values()].map(row => row.ratio_to_avatar_poser), 1);
    replace(this.body, this.items.map(({ key, network, graph, precision }) => {
      const found = this.results.get(key);
      const number = (name, kind = 'n') => h('td', { class: kind }, found?.[name]?.toFixed(2) ?? '–');
      const share = h('i', { style: `width: ${(100 * (found?.ratio_to_avatar_poser ?? 0)) / most}%` });
      const compared = number('ratio_to_avatar_poser');
      compared.append(h('span', { class: 'share' }, share));
      return h('tr', {},
        h('th', { scope: 'row' }, network.name, h('small', {}, `${(network.parameters / 1e6).toFixed(2)} M`)),
        h('td', {}, `${GRAPHS[graph]}, ${precision}`),
        number('median_ms'), number('p95_ms', 'n wide'), compared, number('whole_median_ms'), number('whole_p95_ms', 'n wide'));
    }));
  }

  // Save the measurement as a file for `memmlp table 17 --add`.
  download() {
    const content = JSON.stringify({
      format: 'memmlp web bench 1', memmlp: this.site.memmlp, date: new Date().toISOString().slice(0, 19) + '+00:00',
      device: this.device.value.trim() || 'unknown device', browser: this.about.browser, agent: navigator.userAgent,
      onnxruntime_web: this.site.packages['onnxruntime-web'], cores: navigator.hardwareConcurrency ?? null, clock_ms: this.clock,
      rounds: ROUNDS, rows: [...this.results.values()],
    }, null, 1);
    h('a', { href: `data:application/json,${encodeURIComponent(content)}`, download: 'table17.json' }).click();
    this.note.textContent = 'Show it with memmlp table 17 --add table17.json.';
  }
}

// Device and browser, as far as the browser reports them.
async function machine() {
  const agent = navigator.userAgent;
  const known = await navigator.userAgentData?.getHighEntropyValues?.(['model', 'platform']).catch(() => null);
  const quest = /Quest ?(\d\w*|Pro)/.exec(agent)?.[0];
  const [browser] = /(OculusBrowser|Firefox|Edg|Chrome|Version)\/[\d.]+/.exec(agent) ?? ['unknown browser'];
  return {
    device: quest || known?.model || known?.platform || navigator.platform || '',
    browser: browser.replace('Version', 'Safari').replace('/', ' '),
  };
}
