// A replay: truth, a run and another run side by side in 3D, at one time, from one view.

import { Stage } from './stage.js';
import { h, replace } from './dom.js';
import { ask, inFile, nameOf } from './store.js';
import { timeline } from './charts.js';
import { number } from './format.js';

const WAIT = 700; // milliseconds between two requests for a prediction

let body = null;

export class Replay {
  constructor(place) {
    this.place = place;
    this.asked = 0;
    this.views = [];
  }

  close() {
    this.asked += 1;
    this.stop();
  }

  stop() {
    cancelAnimationFrame(this.tick);
    for (const view of this.views) view.stage.renderer.dispose();
    for (const view of this.views) view.stage.renderer.forceContextLoss();
    this.views = [];
  }

  async show(run, clip, mode, other) {
    const asked = ++this.asked;
    this.stop();
    replace(this.place, h('p', { class: 'wait' }, 'Computing the network’s prediction for this clip; the first time takes some seconds.'));
    try {
      body ??= await ask('body');
      const mine = await this.piece(asked, run.id, clip, mode);
      if (asked !== this.asked) return;
      this.begin(asked, run, mine, other, null, { clip, mode });
      if (!other) return;
      const begin = mine.from / mine.fps;
      const theirs = await this.piece(asked, other.id, clip, mode, begin).catch(error => ({ state: 'failed', reason: error.message }));
      if (asked !== this.asked) return;
      const same = theirs.state !== 'failed' && theirs.frames === mine.frames && theirs.from === mine.from;
      if (same) this.begin(asked, run, mine, other, theirs, { clip, mode });
      else {
        this.begin(asked, run, mine, null, null, { clip, mode });
        this.remark(`${nameOf(other)}: ${theirs.reason ?? 'its clip has another motion'}`);
      }
    } catch (error) {
      if (asked === this.asked) replace(this.place, h('div', { class: 'empty' }, h('p', { class: 'lead' }, 'This clip cannot be replayed.'), h('p', {}, error.message)));
    }
  }

  // A piece of a prediction, as soon as it is computed.
  async piece(asked, id, clip, mode, begin) {
    for (;;) {
      const path = `replay/${id}?${new URLSearchParams({ clip, mode })}`;
      const found = await ask(begin === undefined || inFile ? path : `${path}&from=${begin}`);
      if (found.state === 'failed') throw new Error(found.reason);
      if (found.state === 'ready' || asked !== this.asked) return found;
      await new Promise(done => setTimeout(done, WAIT));
    }
  }

  remark(text) {
    this.place.append(h('p', { class: 'faint' }, text));
  }

  begin(asked, run, mine, other, theirs, about) {
    const before = this.data ? { time: this.time, playing: this.playing } : {};
    this.stop();
    const same = this.data?.about.clip === about.clip && this.run === run;
    Object.assign(this, { run, other, data: { mine, theirs, about }, top: Math.max(mine.top, theirs?.top ?? 0) });
    const still = matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.speed ??= 0.5;
    this.time = same && before.time !== undefined ? before.time : mine.worst[0].first / mine.fps;
    this.playing = same && before.playing !== undefined ? before.playing : !still;
    this.layout();
    let last = performance.now();
    const tick = now => {
      if (asked !== this.asked) return;
      if (this.playing) this.forward((Math.min(Math.max(now - last, 0), 100) / 1000) * this.speed);
      last = now;
      this.draw();
      this.tick = requestAnimationFrame(tick);
    };
    this.tick = requestAnimationFrame(tick);
  }

  // Advance the time; the worst second repeats.
  forward(seconds) {
    const { mine } = this.data;
    const [start, end] = this.span;
    this.time += seconds;
    if (this.time >= end) { this.time = start; this.jumped = true; }
    if (this.time * mine.fps >= mine.from + mine.joints.length - 1) { this.time = mine.from / mine.fps; this.jumped = true; }
  }

  get span() {
    const { mine } = this.data;
    const [low, high] = [mine.from / mine.fps, (mine.from + mine.joints.length - 1) / mine.fps];
    if (!this.loop) return [low, high];
    const first = this.loop.first / mine.fps;
    return [Math.max(first, low), Math.min(first + 1, high)];
  }

  layout() {
    const { mine, theirs } = this.data;
    const stages = [['Truth', null], [nameOf(this.run), mine], ...(theirs ? [[nameOf(this.other), theirs]] : [])];
    const waiting = this.other && !theirs ? h('div', { class: 'view' }, h('div', { class: 'view-stage' }, h('p', { class: 'wait', role: 'status' }, 'computing …')), h('p', { class: 'view-name' }, h('span', {}, nameOf(this.other)))) : null;
    const panels = stages.map(([name, data]) => {
      const canvas = h('canvas', { 'aria-label': `${name} in 3D` });
      const error = h('b', { class: 'n' });
      return { name, data, canvas, error, element: h('div', { class: 'view' }, h('div', { class: 'view-stage' }, canvas), h('p', { class: 'view-name' }, h('span', {}, name), data ? [error, ' cm'] : null)) };
    });
    this.loop ??= mine.worst[0];
    if (!mine.worst.some(one => one.first === this.loop.first)) this.loop = mine.worst[0];
    this.play = h('button', { type: 'button', class: 'primary', onclick: () => this.toggle() });
    this.slider = h('input', { type: 'range', 'aria-label': 'Time in the clip', min: mine.from, max: mine.from + mine.joints.length - 1, step: 1, oninput: event => this.go(event.target.valueAsNumber / mine.fps) });
    this.clock = h('output', { class: 'n' });
    const worst = mine.worst.map((one, i) => h('button', { type: 'button', class: 'small', 'aria-pressed': 'false', onclick: () => { this.loop = one; this.go(one.first / mine.fps); this.playing = true; this.mark(); } }, `${i ? `${i + 1}.` : 'Worst second'} at ${number(one.first / mine.fps, 1)} s: `, h('b', {}, number(one.mean, 1)), ' cm'));
    const whole = h('button', { type: 'button', class: 'small', 'aria-pressed': 'false', onclick: () => { this.loop = null; this.mark(); } }, mine.joints.length < mine.frames ? `${Math.round(mine.joints.length / mine.fps)} s around it` : 'Whole clip');
    this.pieces = [...worst, whole];
    const speeds = h('select', { 'aria-label': 'Speed', onchange: event => { this.speed = Number(event.target.value); } }, [0.1, 0.25, 0.5, 1].map(speed => h('option', { value: speed, selected: speed === this.speed }, `${speed}×`)));
    const chart = timeline([mine, ...(theirs ? [theirs] : [])].map((one, i) => ({ errors: one.errors, name: i ? nameOf(this.other) : nameOf(this.run) })), {
      fps: mine.fps, label: 'error [cm] by second', at: () => this.time, go: time => this.go(time), marks: mine.worst, colours: ['var(--series0)', 'var(--series1)'],
    });
    this.chart = chart;
    const ramp = h('div', { class: 'scale' }, h('span', {}, '0'), h('i', { style: `background:linear-gradient(to right, ${body.heat.join(', ')})` }), h('span', {}, `${this.top}+ cm`));
    const element = h('div', { class: 'replay', tabindex: 0, role: 'group', 'aria-label': 'Replay; space plays, arrows step a frame', onkeydown: event => this.key(event) },
      h('div', { class: `views of${waiting ? 3 : panels.length}` }, panels.map(panel => panel.element), waiting), h('div', { class: 'transport' }, this.play, this.slider, this.clock, speeds), h('div', { class: 'pieces' }, this.pieces, ramp),
      h('div', { class: 'keys' }, h('span', { class: 'key still' }, h('i', { style: 'background:var(--series0)' }), nameOf(this.run)), theirs ? h('span', { class: 'key still' }, h('i', { style: 'background:var(--series1)' }), nameOf(this.other)) : null), chart);
    replace(this.place, element);
    try {
      this.views = panels.map(panel => ({ ...panel, stage: new Stage(panel.canvas, { limbs: body.limbs, heat: body.heat, top: this.top }) }));
    } catch (error) {
      for (const panel of panels) replace(panel.element.firstChild, h('p', { class: 'wait' }, `This browser draws no WebGL (${error.message}).`));
      this.views = [];
    }
    for (const view of this.views) view.stage.controls.addEventListener('start', () => { this.leader = view; });
    this.leader = this.views[0];
    this.jumped = true;
    this.mark();
  }

  mark() {
    const { mine } = this.data;
    this.pieces.forEach((button, i) => button.setAttribute('aria-pressed', String(i < mine.worst.length ? this.loop === mine.worst[i] : this.loop === null)));
  }

  toggle() {
    this.playing = !this.playing;
  }

  go(time) {
    const { mine } = this.data;
    const [low, high] = [mine.from / mine.fps, (mine.from + mine.joints.length - 1) / mine.fps];
    this.time = Math.min(Math.max(time, low), high);
    if (this.loop && (this.time < this.loop.first / mine.fps || this.time > this.loop.first / mine.fps + 1)) { this.loop = null; this.mark(); }
    this.jumped = true;
  }

  key(event) {
    if (event.target !== event.currentTarget) return;
    const step = by => { this.playing = false; this.go(this.time + by / this.data.mine.fps); };
    const action = { ' ': () => this.toggle(), ArrowLeft: () => step(-1), ArrowRight: () => step(1), Home: () => this.go(this.data.mine.worst[0].first / this.data.mine.fps) }[event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }

  draw() {
    const { mine } = this.data;
    const index = Math.min(Math.max(Math.round(this.time * mine.fps) - mine.from, 0), mine.joints.length - 1);
    const truth = metres(mine.truth[index]);
    for (const view of this.views) {
      const frame = view.data ? measured(metres(view.data.joints[index]), truth) : { positions: truth, truth: null, errors: null };
      view.stage.show({ ...frame, restarted: this.jumped });
      if (view.data) view.error.textContent = number(frame.mean, 1);
    }
    this.together();
    for (const view of this.views) view.stage.draw();
    this.jumped = false;
    if (document.activeElement !== this.slider) this.slider.value = index + mine.from;
    this.clock.textContent = `${this.time.toFixed(2)} s`;
    this.play.textContent = this.playing ? 'Pause' : 'Play';
    document.documentElement.dataset.replayed = `${this.run.id} ${index + mine.from} ${this.views.length}`;
    this.needle(mine);
  }

  // All cameras follow that of the stage that was touched last.
  together() {
    if (!this.leader) return;
    const { camera, controls } = this.leader.stage;
    for (const { stage } of this.views) {
      if (stage === this.leader.stage) continue;
      stage.controls.target.copy(controls.target);
      stage.camera.position.copy(camera.position);
    }
  }

  needle(mine) {
    const line = this.chart.querySelector('.now line');
    const svg = this.chart.querySelector('svg');
    if (!line || !svg) return;
    const width = Number(svg.getAttribute('width'));
    const x = 56 + (this.time / (Math.max(mine.frames - 1, 1) / mine.fps)) * (width - 72);
    line.setAttribute('x1', x);
    line.setAttribute('x2', x);
  }
}

const metres = millimetres => Float32Array.from(millimetres, mm => mm / 1000);

function measured(positions, truth) {
  const errors = new Float32Array(positions.length / 3);
  for (let j = 0; j < errors.length; j++) errors[j] = 100 * Math.hypot(...[0, 1, 2].map(i => positions[3 * j + i] - truth[3 * j + i]));
  return { positions, truth, errors, mean: errors.reduce((a, b) => a + b) / errors.length };
}
