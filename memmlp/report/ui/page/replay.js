// A replay: truth, a run and another run side by side in 3D, at one time, from one view.

import { h, replace } from './dom.js';
import { ask, inFile, nameOf } from './store.js';
import { timeline } from './charts.js';
import { number } from './format.js';
import { measureErrors } from './stage.js';
import { Viewer } from './viewer.js';

const WAIT = 700; // milliseconds between two requests for a prediction
const COLOURS = ['var(--series0)', 'var(--series1)'];
const SPEED = 0.5; // of the motion
const still = matchMedia('(prefers-reduced-motion: reduce)');

export class Replay {
  constructor(place) {
    Object.assign(this, { place, asked: 0 });
  }

  close() {
    this.asked += 1;
    for (const { stage } of this.player?.views ?? []) {
      stage?.renderer.dispose();
      stage?.renderer.forceContextLoss();
    }
    this.player = null;
  }

  // Show a run's clip in a mode, beside the truth and beside another run, at a second; null for the worst second.
  async show(run, clip, mode, other, second = null) {
    this.close();
    const { asked } = this;
    replace(this.place, h('p', { class: 'wait' }, 'Computing the networks’ predictions for this clip; the first time takes some seconds.'));
    try {
      this.body ??= await ask('body');
      const mine = await this.fetch(asked, run.id, clip, mode, second === null ? undefined : Math.max(second - 4.5, 0));
      const theirs = other && await this.fetch(asked, other.id, clip, mode, mine.from / mine.fps).catch(error => ({ reason: error.message }));
      if (asked !== this.asked) return;
      const comparable = theirs?.frames === mine.frames && theirs.from === mine.from;
      const shown = [[run, mine], ...(comparable ? [[other, theirs]] : [])];
      this.player = new Player(this.body, shown, moment => this.show(run, clip, mode, other, moment));
      replace(this.place, this.player.element, other && !comparable && h('p', { class: 'faint' }, `${nameOf(other)}: ${theirs.reason ?? 'its clip has another motion'}`));
      this.player.repeat(second === null ? mine.worst[0].first : Math.round(second * mine.fps), mine.fps);
      document.documentElement.dataset.replayed = `${run.id} ${shown.length + 1}`;
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
}

class Player extends Viewer {
  // shown: [run, piece of its prediction], one or two; load(second): loads another piece.
  constructor(body, shown, load) {
    super([], { names: ['Truth', ...shown.map(([run]) => nameOf(run))], refresh: frame => this.chart.style.setProperty('--now', frame.number / (frames - 1)) });
    const [[, { fps, from, truth, frames, worst }]] = shown;
    Object.assign(this, { fps, load, began: 0 });
    this.frames = truth.map((positions, i) => ({
      number: from + i, time: (from + i) / fps,
      views: [measureErrors({ positions }), ...shown.map(([, { joints }]) => measureErrors({ positions: joints[i], truth: positions }))],
    }));
    const piece = (first, count, ...text) => ({ first, count, button: h('button', { type: 'button', class: 'small', onclick: () => this.repeat(first, count) }, text) });
    this.pieces = [
      ...worst.slice(0, inFile ? 1 : undefined).map(({ first, mean }, i) => piece(first, fps, `${i ? `${i + 1}.` : 'Worst second'} at ${number(first / fps, 1)} s: `, h('b', {}, number(mean, 1)), ' cm')),
      piece(from, truth.length, truth.length < frames ? `${Math.round(truth.length / fps)} s around it` : 'Whole clip'),
    ];
    this.chart = timeline(shown.map(([run, { errors }]) => ({ errors, name: nameOf(run) })),
      { fps, label: 'error [cm] by second', go: time => this.choose(Math.round(time * fps)), marks: worst, colours: COLOURS });
    this.newest.remove();
    this.element.append(h('div', { class: 'pieces' }, this.pieces.map(({ button }) => button)),
      h('div', { class: 'keys' }, shown.map(([run], i) => h('span', { class: 'key' }, h('i', { style: `background:${COLOURS[i]}` }), nameOf(run)))), this.chart);
    this.describe({ ...body, top: Math.max(...shown.map(([, { top }]) => top)) });
  }

  // Play some frames again and again, after loading them if they are not there.
  repeat(start, count) {
    if (start < this.first || start > this.last) return this.load(start / this.fps);
    Object.assign(this, { start, count, chosen: start });
    for (const { first, count: length, button } of this.pieces) button.setAttribute('aria-pressed', String(first === start && length === count));
    if (!still.matches) this.resume();
  }

  get shown() {
    if (this.paused) return super.shown;
    const position = Math.floor(((performance.now() - this.began) / 1000) * this.fps * SPEED) % this.count;
    return this.frames[Math.min(this.start + position - this.first, this.frames.length - 1)];
  }

  // Continue at the chosen frame; outside the repeated frames, with all frames.
  resume() {
    const inside = this.chosen >= this.start && this.chosen < this.start + this.count;
    if (!inside) Object.assign(this, { start: this.first, count: this.frames.length });
    this.began = performance.now() - (1000 * (this.chosen - this.start)) / (this.fps * SPEED);
    super.resume();
  }
}
