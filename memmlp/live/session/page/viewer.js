// Frames of bodies in 3D with their numbers. It pauses, goes back up to three minutes, and continues with the newest frame.

import { h, replace } from './dom.js';
import { colourScale, measureErrors, Stage } from './stage.js';

const KEPT = 60 * 180; // frames in memory
const TIMED = 300; // newest frames whose times are summarised
const REFRESH = 100; // milliseconds between two updates of the numbers

export class Viewer {
  // facts: see Facts; names: of views beside each other; refresh(frame): called with each update of the numbers.
  constructor(facts, { names = [''], refresh = () => {} } = {}) {
    Object.assign(this, { frames: [], chosen: null, refresh, refreshed: 0, failure: '' });
    this.remark = h('p', { class: 'warning', id: 'remark', hidden: true });
    this.views = names.map(name => ({ name, canvas: h('canvas', { 'aria-label': `${name || 'Truth and prediction'} in 3D` }), error: h('b', { class: 'n' }) }));
    this.problem = h('p', { class: 'trouble', hidden: true });
    this.pause = h('button', { type: 'button', class: 'primary', id: 'pause', onclick: () => this.togglePause() }, 'Pause');
    this.scrub = h('input', { type: 'range', id: 'scrub', min: 0, max: 0, step: 1, 'aria-label': 'Frame', oninput: () => this.choose(this.scrub.valueAsNumber) });
    this.time = h('output', {}, '0.00 s');
    this.newest = h('button', { type: 'button', id: 'newest', onclick: () => this.resume() }, 'Newest');
    this.transport = h('div', { class: 'transport' }, this.pause, this.scrub, this.time, this.newest);
    this.facts = new Facts(facts);
    this.scale = h('p', { class: 'scale', hidden: true });
    const panels = this.views.map(({ name, canvas, error }) =>
      h('div', { class: 'view' }, h('div', { class: 'view-stage' }, canvas), name && h('p', { class: 'view-name' }, h('span', {}, name), error)));
    this.element = h('div', { class: 'replay' }, this.remark, h('div', { class: `views of${names.length}`, id: 'stage' }, panels, this.problem),
      this.transport, this.facts.element, this.scale);
    this.tick = this.tick.bind(this);
    requestAnimationFrame(this.tick);
  }

  // description: { limbs, heat, top } of a body and its colour scale.
  describe({ limbs, heat, top }) {
    replace(this.scale, colourScale(heat, top), h('span', { class: 'legend' }, 'truth'),
      h('span', { class: 'legend', style: `--colour: ${heat[1]}` }, 'prediction'));
    try {
      for (const view of this.views) {
        view.stage = new Stage(view.canvas, { limbs, heat, top });
        view.stage.controls.addEventListener('start', () => { this.stage = view.stage; });
      }
      this.stage = this.views[0].stage; // the one that was touched last; all cameras follow it
    } catch (error) {
      this.failure = `This browser does not support WebGL (${error.message}); the numbers continue.`;
      this.showProblem('');
    }
  }

  showRemark(remark) {
    this.remark.hidden = !remark;
    this.remark.textContent = `This network is ${remark}.`;
  }

  // Show a line in place of the picture; '' for the picture.
  showProblem(line) {
    this.problem.textContent = line || this.failure;
    this.problem.hidden = !this.problem.textContent;
  }

  // frame: { number, time, positions, truth }, with consecutive numbers, seconds and millimetres, and what the facts read.
  add(frame) {
    this.frames.push(measureErrors(frame));
    if (this.frames.length > KEPT) this.frames.shift();
  }

  clear() { Object.assign(this, { frames: [], chosen: null }); }

  get first() { return this.frames[0]?.number ?? 0; }
  get last() { return this.frames.at(-1)?.number ?? 0; }
  get paused() { return this.chosen !== null; }
  get shown() { return this.paused ? this.frames[Math.max(this.chosen - this.first, 0)] : this.frames.at(-1); }

  choose(number) { this.chosen = Math.min(Math.max(number, this.first), this.last); }
  resume() { this.chosen = null; }
  togglePause() { return this.paused ? this.resume() : this.choose(this.shown?.number ?? 0); }

  // The median and 95th percentile of a time of the newest frames, as text; null without times.
  timing(key) {
    const found = percentiles(this.frames.slice(-TIMED).map(frame => frame[key]).filter(ms => ms !== undefined));
    return found && found.map(ms => ms.toFixed(ms < 10 ? 2 : 0)).join(' / ');
  }

  tick(now) {
    if (!this.element.isConnected) return;
    const frame = this.shown;
    if (this.stage && frame) {
      this.draw(frame);
      document.documentElement.dataset.shown = frame.number;
    }
    if (now - this.refreshed > REFRESH) {
      this.refreshed = now;
      this.showNumbers(frame);
    }
    requestAnimationFrame(this.tick);
  }

  draw(frame) {
    this.views.forEach(({ name, stage, error }, i) => {
      const shown = frame.views?.[i] ?? frame;
      stage.show(shown);
      if (name && shown.errors) error.textContent = `${shown.mean.toFixed(1)} cm`;
    });
    for (const { stage } of this.views) stage.draw(this.stage);
  }

  showNumbers(frame) {
    this.pause.textContent = this.paused ? 'Play' : 'Pause';
    this.newest.disabled = !this.paused;
    this.refresh(frame);
    if (!frame) return;
    Object.assign(this.scrub, { min: this.first, max: this.last, value: frame.number });
    this.time.textContent = `${frame.time.toFixed(2)} s`;
    this.scale.hidden = frame.errors === null;
    this.facts.show(frame);
  }
}

// A list of numbers. A fact is [id, name, unit, function of the frame]; it is hidden while the function returns null.
export class Facts {
  constructor(facts) {
    this.facts = facts.map(([id, name, unit, read]) => ({ name, unit, read, value: h('b', { id }, '–') }));
    this.element = h('dl', { class: 'facts' }, this.facts.map(({ name, unit, value }) => h('div', {}, h('dt', {}, name), h('dd', {}, value, ` ${unit}`))));
  }

  show(frame) {
    this.facts.forEach(({ read, value }, i) => {
      const text = read(frame) ?? null;
      this.element.children[i].hidden = text === null;
      value.textContent = text;
    });
  }
}

// The median and 95th percentile; null without values.
export function percentiles(values) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted.length ? [0.5, 0.95].map(part => sorted[Math.floor(part * (sorted.length - 1))]) : null;
}
