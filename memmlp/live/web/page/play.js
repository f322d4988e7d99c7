// Plays test clips through a network in this browser: the truth in grey, the prediction coloured by its error.

import { h, replace, select } from './dom.js';
import { History } from './history.js';
import { fetchFile, NetworkWorker } from './network_worker.js';
import { Stage } from './stage.js';
import { Stream } from './stream.js';

const NUMBERS = 87; // of a frame: see memmlp.live.web.site
const PAUSE = 1000; // milliseconds between two rounds of a clip

export function play(page, site) {
  const view = new Play(page, site);
  view.begin();
  return () => view.leave();
}

// A clip's frames: trackers as a Stream takes them, and true joints.
export class Clip {
  constructor(bytes) {
    this.numbers = new Float32Array(bytes);
    this.length = this.numbers.length / NUMBERS;
  }

  trackers(frame) {
    const at = NUMBERS * frame;
    const part = (start, count) => [...this.numbers.subarray(at + start, at + start + count)];
    return [0, 1, 2].map(i => ({ position: part(3 * i, 3), rotation: part(9 + 4 * i, 4) }));
  }

  truth(frame) { return this.numbers.subarray(NUMBERS * frame + 21, NUMBERS * frame + NUMBERS); }
}

class Play {
  constructor(page, site) {
    Object.assign(this, { site, page, history: new History(), dropped: 0, round: 0 });
    this.network = site.networks.find(network => network.clips.length) ?? site.networks[0];
    this.canvas = h('canvas', { 'aria-label': 'Truth and prediction in 3D' });
    this.layOut();
    this.tick = this.tick.bind(this);
  }

  layOut() {
    const { site } = this;
    const named = id => (this[id] = h('b', { id }, '–'));
    const choices = h('div', { class: 'tools' },
      site.networks.length > 1 && select('Network', site.networks.map(network => [network.key, network.name]), this.network.key, key => {
        this.network = site.networks.find(network => network.key === key);
        this.layOut();
        this.begin();
      }),
      select('Clip', this.clips().map(clip => [clip.key, `${clip.name} (${(clip.frames / 60).toFixed(0)} s)`]), this.clip?.key, key => {
        this.clip = site.clips.find(clip => clip.key === key);
        this.begin();
      }));
    this.pause = h('button', { type: 'button', class: 'primary', id: 'pause', onclick: () => this.togglePause() }, 'Pause');
    this.scrub = h('input', { type: 'range', min: 0, max: 0, value: '0', step: 1, 'aria-label': 'Frame', oninput: event => this.history.choose(event.target.valueAsNumber) });
    this.time = h('output', {}, '0.00 s');
    this.trouble = h('p', { class: 'trouble', hidden: true });
    const facts = [['mean error', 'mean', 'cm'], ['step, median', 'middle', 'ms'], ['step, p95', 'p95', 'ms'], ['frames', 'frames', ''], ['dropped', 'lost', '']];
    const { remark } = this.network;
    replace(this.page, choices,
      remark && h('p', { class: 'warning', id: 'remark' }, `This network is ${remark}.`),
      h('div', { class: 'replay' },
        h('div', { class: 'view' }, h('div', { class: 'view-stage tall' }, this.canvas, this.trouble)),
        h('div', { class: 'transport' }, this.pause, this.scrub, this.time),
        h('dl', { class: 'facts' }, facts.map(([name, id, unit]) => h('div', {}, h('dt', {}, name), h('dd', {}, named(id), ` ${unit}`)))),
        h('p', { class: 'scale' }, '0', h('i', { style: `background: linear-gradient(to right, ${site.heat.join(', ')})` }), `${site.top}+ cm`,
          h('span', { class: 'legend truth' }, 'truth'), h('span', { class: 'legend', style: `--c: ${site.heat[1]}` }, 'prediction')),
        h('p', { class: 'faint' }, 'Computed here, by the full graph in WebAssembly, from head and hands alone. These clips were not in this network’s training.')));
  }

  clips() { return this.site.clips.filter(clip => this.network.clips.includes(clip.key)); }

  // Load network and clip, and play from the start.
  async begin() {
    const round = ++this.round;
    this.worker?.close();
    this.worker = new NetworkWorker();
    this.history.frames = [];
    this.history.resume();
    this.dropped = 0;
    if (!this.clips().includes(this.clip)) this.clip = this.clips()[0];
    if (!this.clip) return this.showProblem('This site has no test clip of this network.');
    this.showProblem('Loading the network.');
    try {
      const [content] = await Promise.all([fetchFile(this.clip.file), this.worker.open(this.network.play)]);
      const clip = new Clip(content.buffer);
      this.showProblem('');
      this.stage ??= this.makeStage();
      this.ticking ??= requestAnimationFrame(this.tick);
      await this.rounds(clip, round);
    } catch (error) {
      if (round === this.round) this.showProblem(error.message);
    }
  }

  makeStage() {
    try {
      return new Stage(this.canvas, this.site);
    } catch (error) {
      this.showProblem(`This browser does not support WebGL (${error.message}); the numbers continue.`);
      return null;
    }
  }

  showProblem(line) {
    this.trouble.textContent = line;
    this.trouble.hidden = !line;
  }

  // Feed the clip to the stream at 60 Hz, repeatedly. Frames that are due during a step are dropped.
  async rounds(clip, round) {
    const { body, fps } = this.network;
    const stream = new Stream({ fps, body, run: frame => this.worker.pose(frame) });
    for (;;) {
      stream.reset();
      const began = performance.now();
      for (let next = 0; next < clip.length; ) {
        const due = Math.floor(((performance.now() - began) * fps) / 1000);
        if (due < next) {
          await new Promise(resolve => setTimeout(resolve, 1));
        } else {
          const frame = Math.min(due, clip.length - 1);
          this.dropped += frame - next;
          next = frame + 1;
          const start = performance.now();
          const pose = await stream.step(...clip.trackers(frame), frame / fps);
          if (round === this.round && pose.fresh) this.keep(pose, clip.truth(frame), performance.now() - start);
        }
        if (round !== this.round) return;
      }
      await new Promise(resolve => setTimeout(resolve, PAUSE));
      if (round !== this.round) return;
    }
  }

  keep(pose, truth, ms) {
    const millimetres = joints => Array.from(joints, x => 1000 * x);
    const number = this.history.frames.length ? this.history.last + 1 : 0;
    const { time, held, restarted } = pose;
    this.history.add({ number, time, held, restarted, ms, positions: millimetres(pose.positions), truth: millimetres(truth) });
  }

  togglePause() { return this.history.paused ? this.history.resume() : this.history.choose(this.history.last); }

  tick() {
    if (!this.canvas.isConnected) return;
    const frame = this.history.shown;
    if (this.stage && frame) {
      this.stage.show(frame);
      this.stage.draw();
      document.documentElement.dataset.shown = frame.number;
    }
    if (frame) this.numbers(frame);
    requestAnimationFrame(this.tick);
  }

  numbers(frame) {
    Object.assign(this.scrub, { min: this.history.first, max: this.history.last, value: frame.number });
    this.pause.textContent = this.history.paused ? 'Play' : 'Pause';
    this.time.textContent = `${frame.time.toFixed(2)} s`;
    this.mean.textContent = frame.mean.toFixed(1);
    const [middle, p95] = this.history.timing('ms');
    this.middle.textContent = middle.toFixed(1);
    this.p95.textContent = p95.toFixed(1);
    this.frames.textContent = frame.number + 1;
    this.lost.textContent = this.dropped;
  }

  leave() {
    this.round++;
    this.worker?.close();
  }
}
