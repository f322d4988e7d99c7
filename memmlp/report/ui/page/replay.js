// A replay: truth, a run and another run side by side in 3D, at one time, from one view.

import { colourScale, measureErrors, Stage } from './stage.js';
import { h, replace } from './dom.js';
import { ask, inFile, nameOf } from './store.js';
import { timeline } from './charts.js';
import { number } from './format.js';

const WAIT = 700; // milliseconds between two requests for a prediction
const COLOURS = ['var(--series0)', 'var(--series1)'];
const SPEED = 0.5; // of the motion
const still = matchMedia('(prefers-reduced-motion: reduce)');

export class Replay {
  constructor(place) {
    Object.assign(this, { place, asked: 0, views: [] });
  }

  close() {
    this.asked += 1;
    this.stop();
  }

  stop() {
    cancelAnimationFrame(this.tick);
    for (const { stage } of this.views) {
      stage.renderer.dispose();
      stage.renderer.forceContextLoss();
    }
    this.views = [];
  }

  // Show a run's clip in a mode, beside the truth and beside another run, at a second; null for the worst second.
  async show(run, clip, mode, other, second = null) {
    const asked = ++this.asked;
    this.stop();
    replace(this.place, h('p', { class: 'wait' }, 'Computing the networks’ predictions for this clip; the first time takes some seconds.'));
    try {
      this.body ??= await ask('body');
      const mine = await this.fetch(asked, run.id, clip, mode, second === null ? undefined : Math.max(second - 4.5, 0));
      const theirs = other && await this.fetch(asked, other.id, clip, mode, mine.from / mine.fps).catch(error => ({ reason: error.message }));
      if (asked !== this.asked) return;
      const comparable = theirs?.frames === mine.frames && theirs.from === mine.from;
      const shown = [[run, mine], ...(comparable ? [[other, theirs]] : [])];
      Object.assign(this, { run, mine, shown, playing: !still.matches });
      this.showAt = moment => this.show(run, clip, mode, other, moment);
      this.layout(second);
      if (other && !comparable) this.place.append(h('p', { class: 'faint' }, `${nameOf(other)}: ${theirs.reason ?? 'its clip has another motion'}`));
      this.animate(asked);
    } catch (error) {
      if (asked === this.asked) replace(this.place, h('div', { class: 'empty' }, h('p', { class: 'lead' }, 'This clip cannot be replayed.'), h('p', {}, error.message)));
    }
  }

  // A piece of a prediction, as soon as it is computed.
  async fetch(asked, id, clip, mode, begin) {
    const path = `replay/${id}?${new URLSearchParams({ clip, mode })}`;
    for (;;) {
      const found = await ask(begin === undefined || inFile ? path : `${path}&from=${begin}`);
      if (found.state === 'failed') throw new Error(found.reason);
      if (found.state === 'ready' || asked !== this.asked) return found;
      await new Promise(done => setTimeout(done, WAIT));
    }
  }

  animate(asked) {
    let last = performance.now();
    const tick = now => {
      if (asked !== this.asked) return;
      if (this.playing) this.forward((Math.min(Math.max(now - last, 0), 100) / 1000) * SPEED);
      last = now;
      this.draw();
      this.tick = requestAnimationFrame(tick);
    };
    this.tick = requestAnimationFrame(tick);
  }

  forward(seconds) {
    this.time += seconds;
    if (this.time >= this.loop[1]) [this.time] = this.loop;
  }

  layout(second) {
    const { mine, shown, body } = this;
    const frames = mine.joints.length;
    this.whole = [mine.from / mine.fps, (mine.from + frames - 1) / mine.fps];
    this.top = Math.max(...shown.map(([, data]) => data.top));
    const panels = [['Truth', null], ...shown.map(([one, data]) => [nameOf(one), data])].map(([name, data]) => {
      const canvas = h('canvas', { 'aria-label': `${name} in 3D` });
      const error = h('b', { class: 'n' });
      return { data, canvas, error, element: h('div', { class: 'view' }, h('div', { class: 'view-stage' }, canvas), h('p', { class: 'view-name' }, h('span', {}, name), data ? [error, ' cm'] : null)) };
    });
    const piece = (loop, ...text) => ({ loop, button: h('button', { type: 'button', class: 'small', onclick: () => this.start(loop) }, text) });
    this.pieces = [
      ...mine.worst.slice(0, inFile ? 1 : undefined).map((one, i) => piece([one.first / mine.fps, one.first / mine.fps + 1], `${i ? `${i + 1}.` : 'Worst second'} at ${number(one.first / mine.fps, 1)} s: `, h('b', {}, number(one.mean, 1)), ' cm')),
      piece(this.whole, frames < mine.frames ? `${Math.round(frames / mine.fps)} s around it` : 'Whole clip'),
    ];
    this.play = h('button', { type: 'button', class: 'primary', onclick: () => { this.playing = !this.playing; } });
    this.slider = h('input', { type: 'range', 'aria-label': 'Time in the clip', min: mine.from, max: mine.from + frames - 1, step: 1, oninput: event => this.go(event.target.valueAsNumber / mine.fps) });
    this.clock = h('output', { class: 'n' });
    this.chart = timeline(shown.map(([one, data]) => ({ errors: data.errors, name: nameOf(one) })), { fps: mine.fps, label: 'error [cm] by second', go: time => this.go(time), marks: mine.worst, colours: COLOURS });
    const keys = h('div', { class: 'keys' }, shown.map(([one], i) => h('span', { class: 'key still' }, h('i', { style: `background:${COLOURS[i]}` }), nameOf(one))));
    replace(this.place, h('div', { class: 'replay', tabindex: 0, role: 'group', 'aria-label': 'Replay; space plays, arrows step a frame', onkeydown: event => this.press(event) },
      h('div', { class: `views of${panels.length}` }, panels.map(panel => panel.element)), h('div', { class: 'transport' }, this.play, this.slider, this.clock),
      h('div', { class: 'pieces' }, this.pieces.map(one => one.button), h('div', { class: 'scale' }, colourScale(body.heat, this.top))), keys, this.chart));
    try {
      this.views = panels.map(panel => ({ ...panel, stage: new Stage(panel.canvas, { limbs: body.limbs, heat: body.heat, top: this.top }) }));
    } catch (error) {
      for (const panel of panels) replace(panel.element.firstChild, h('p', { class: 'wait' }, `This browser draws no WebGL (${error.message}).`));
    }
    for (const view of this.views) view.stage.controls.addEventListener('start', () => { this.leader = view; });
    this.leader = this.views[0];
    this.repeat((this.pieces.find(({ loop }) => loop[0] === second) ?? this.pieces[0]).loop);
  }

  // Play a piece, after loading it if the loaded frames do not contain it.
  start(loop) {
    if (loop[0] < this.whole[0] || loop[0] > this.whole[1]) return this.showAt(loop[0]);
    this.playing = true;
    this.repeat(loop);
  }

  // Play from a start to an end, seconds, again and again.
  repeat(loop) {
    this.loop = loop;
    [this.time] = loop;
    for (const piece of this.pieces) piece.button.setAttribute('aria-pressed', String(piece.loop === loop));
  }

  go(time) {
    if (time < this.loop[0] || time > this.loop[1]) this.repeat(this.whole);
    this.time = Math.min(Math.max(time, this.loop[0]), this.loop[1]);
  }

  press(event) {
    if (event.target !== event.currentTarget) return;
    const step = by => { this.playing = false; this.go(this.time + by / this.mine.fps); };
    const action = { ' ': () => { this.playing = !this.playing; }, ArrowLeft: () => step(-1), ArrowRight: () => step(1), Home: () => this.go(this.mine.worst[0].first / this.mine.fps) }[event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }

  draw() {
    const { mine } = this;
    const index = Math.min(Math.max(Math.round(this.time * mine.fps) - mine.from, 0), mine.joints.length - 1);
    for (const { data, stage, error } of this.views) {
      const frame = measureErrors(data ? { positions: data.joints[index], truth: mine.truth[index] } : { positions: mine.truth[index] });
      stage.show(frame);
      if (data) error.textContent = number(frame.mean, 1);
    }
    for (const { stage } of this.views) { // all cameras follow that of the stage that was touched last
      if (stage !== this.leader.stage) {
        stage.controls.target.copy(this.leader.stage.controls.target);
        stage.camera.position.copy(this.leader.stage.camera.position);
      }
      stage.draw();
    }
    if (document.activeElement !== this.slider) this.slider.value = index + mine.from;
    this.clock.textContent = `${this.time.toFixed(2)} s`;
    this.play.textContent = this.playing ? 'Pause' : 'Play';
    document.documentElement.dataset.replayed = `${this.run.id} ${index + mine.from} ${this.views.length}`;
    this.chart.style.setProperty('--now', (this.time * mine.fps) / Math.max(mine.frames - 1, 1));
  }
}
