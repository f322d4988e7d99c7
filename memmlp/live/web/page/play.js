// Plays test clips through a network in this browser: the truth in grey, the prediction coloured by its error.

import { h, replace, select } from './dom.js';
import { fetchFile, openNetwork } from './network.js';
import { Stream } from './stream.js';
import { Viewer } from './viewer.js';

const NUMBERS = 87; // per frame: see memmlp.live.web.site
const PAUSE = 1000; // milliseconds between two rounds of a clip

export function play(page, site) {
  const player = new Player(page, site);
  player.start();
  return () => { player.round++; };
}

class Player {
  constructor(page, site) {
    Object.assign(this, { site, dropped: 0, round: 0 });
    this.network = site.networks.find(network => network.clips.length) ?? site.networks[0];
    this.choices = h('div', { class: 'tools' });
    this.viewer = new Viewer([
      ['mean', 'mean error', 'cm', frame => frame.mean.toFixed(1)],
      ['step', 'pose, median / p95', 'ms', () => this.viewer.timing('ms')],
      ['frames', 'frames', '', frame => frame.number + 1],
      ['dropped', 'dropped', '', () => this.dropped],
    ]);
    replace(page, this.choices, this.viewer.element,
      h('p', { class: 'faint' }, 'Computed here in WebAssembly, from head and hands only. These clips were not in this network’s training.'));
    this.viewer.describe(site);
  }

  get clips() { return this.site.clips.filter(clip => this.network.clips.includes(clip.key)); }

  showChoices() {
    const { networks } = this.site;
    const choose = (name, list) => key => {
      this[name] = list.find(one => one.key === key);
      this.start();
    };
    replace(this.choices,
      networks.length > 1 && select('Network', networks.map(network => [network.key, network.name]), this.network.key, choose('network', networks)),
      select('Clip', this.clips.map(clip => [clip.key, `${clip.name} (${(clip.frames / 60).toFixed(0)} s)`]), this.clip?.key, choose('clip', this.clips)));
  }

  // Load network and clip, and play from the start.
  async start() {
    const round = ++this.round;
    const { viewer, network } = this;
    if (!this.clips.includes(this.clip)) [this.clip] = this.clips;
    this.dropped = 0;
    this.showChoices();
    viewer.clear();
    viewer.showRemark(network.remark);
    if (!this.clip) return viewer.showProblem('This site has no test clip of this network.');
    viewer.showProblem('Loading the network.');
    try {
      const [content, opened] = await Promise.all([fetchFile(this.clip.file), openNetwork(network.play)]);
      if (round === this.round) viewer.showProblem('');
      const stream = new Stream({ ...network, run: frame => opened.pose(frame) });
      while (round === this.round) {
        await this.playOnce(new Float32Array(content.buffer), stream, round);
        await sleep(PAUSE);
      }
      await opened.close();
    } catch (error) {
      if (round === this.round) viewer.showProblem(error.message);
    }
  }

  // Feed the clip to the stream at 60 Hz. Frames that are due during a step are dropped.
  async playOnce(numbers, stream, round) {
    const { fps } = this.network;
    const length = numbers.length / NUMBERS;
    stream.reset();
    const began = performance.now();
    for (let next = 0; next < length && round === this.round; ) {
      const frame = Math.min(Math.floor(((performance.now() - began) * fps) / 1000), length - 1);
      if (frame < next) {
        await sleep(1);
        continue;
      }
      this.dropped += frame - next;
      next = frame + 1;
      const { trackers, truth } = splitFrame([...numbers.subarray(NUMBERS * frame, NUMBERS * next)]);
      const start = performance.now();
      const pose = await stream.step(...trackers, frame / fps);
      if (pose.fresh && round === this.round) this.add(pose, truth, performance.now() - start);
    }
  }

  add({ time, restarted, positions }, truth, ms) {
    const millimetres = joints => Array.from(joints, metres => 1000 * metres);
    const number = this.viewer.frames.length ? this.viewer.last + 1 : 0;
    this.viewer.add({ number, time, restarted, ms, positions: millimetres(positions), truth: millimetres(truth) });
  }
}

// The trackers as a Stream takes them, and the true joints.
function splitFrame(numbers) {
  const trackers = [0, 1, 2].map(i => ({ position: numbers.slice(3 * i, 3 * i + 3), rotation: numbers.slice(9 + 4 * i, 13 + 4 * i) }));
  return { trackers, truth: numbers.slice(21) };
}

const sleep = milliseconds => new Promise(resolve => setTimeout(resolve, milliseconds));
