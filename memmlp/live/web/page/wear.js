// Enter VR or AR: a body follows the wearer's head and hands, computed here, in front of a mirror.

import { h, replace, select } from './dom.js';
import { percentiles } from './history.js';
import { kindsOf, trackersOf, usualOffsets } from './headset.js';
import { WornScene } from './worn_scene.js';
import { NetworkWorker } from './network_worker.js';
import { headingOf } from './rotations.js';
import { Stream } from './stream.js';

const MODES = { 'immersive-vr': 'Enter VR', 'immersive-ar': 'Enter AR' };
const COUNTDOWN = 3; // seconds from the trigger to the calibration
const AWAITED = 2; // samples that may wait for the network; later ones are skipped
const TIMED = 600; // the newest poses whose times are shown
const USUAL = 91; // the newest frames of the display, whose median gives its rate
const [SHORTEST, TALLEST] = [0.9, 2.4]; // metres; outside of them a floor or a height is wrong
const INVITE = ['Pull a trigger or pinch, then stand upright in T-pose:', 'arms to the sides, palms down, eyes forward'];

export function wear(page, site) {
  const view = new Wear(page, site);
  return () => view.leave();
}

class Wear {
  constructor(page, site) {
    Object.assign(this, { page, site, network: site.networks[0], worn: null });
    this.canvas = h('canvas', { 'aria-label': 'The view in the mirror' });
    this.trouble = h('p', { class: 'trouble' }, 'Loading the network.');
    this.height = h('input', { type: 'number', id: 'height', min: 100, max: 230, step: 'any', placeholder: 'by headset' });
    this.buttons = Object.entries(MODES).map(([mode, name]) =>
      h('button', { type: 'button', class: 'primary', id: mode, disabled: true, onclick: () => this.enter(mode) }, name));
    this.layOut();
    try {
      this.mirror = new WornScene(this.canvas, site);
    } catch (error) {
      this.trouble.textContent = `This browser does not support WebGL: ${error.message}`;
      return;
    }
    this.ready();
  }

  layOut() {
    const facts = [['display', 'rate', 'Hz'], ['frames', 'frames', ''], ['skipped samples', 'skipped', ''], ['pose, median', 'middle', 'ms'], ['pose, p95', 'p95', 'ms'], ['height', 'tall', 'm']];
    const named = id => (this[`${id}Text`] = h('b', { id }, '–'));
    replace(this.page,
      h('h1', {}, 'Your body, from head and hands'),
      h('div', { class: 'entry' }, this.buttons,
        this.site.networks.length > 1 && select('Network', this.site.networks.map(({ key, name }) => [key, name]), this.network.key, key => {
          this.worn?.session.end();
          this.network = this.site.networks.find(network => network.key === key);
          this.showRemark();
          this.ready();
        }),
        h('label', { class: 'field' }, h('span', {}, 'Your height [cm]'), this.height)),
      this.remark = h('p', { class: 'warning', id: 'remark' }),
      h('p', { class: 'faint', id: 'support' }, ''),
      this.seen = h('div', { class: 'replay' }, h('div', { class: 'view' }, h('div', { class: 'view-stage' }, this.canvas, this.trouble)),
        h('dl', { class: 'facts' }, facts.map(([name, id, unit]) => h('div', {}, h('dt', {}, name), h('dd', {}, named(id), ` ${unit}`))))),
      h('ol', { class: 'steps' },
        h('li', {}, 'Put on the headset, open this page in its browser, and choose Enter VR (or AR, to see your room).'),
        h('li', {}, 'Pull a trigger, or pinch, and stand in T-pose within three seconds: upright, arms to the sides, palms down, eyes forward.'),
        h('li', {}, 'Look into the mirror. Pull again to repeat the calibration, such as after changing between controllers and hands.')));
    this.showRemark();
  }

  showRemark() {
    const { remark } = this.network;
    this.remark.hidden = !remark;
    this.remark.textContent = remark ? `This network is ${remark}.` : '';
  }

  // Load the network, and ask the browser what it can enter.
  async ready() {
    this.worker?.close();
    const worker = (this.worker = new NetworkWorker());
    try {
      await worker.open(this.network.play);
    } catch (error) {
      if (worker === this.worker) this.trouble.textContent = `The network did not load: ${error.message}`;
      return;
    }
    const can = await Promise.all(Object.keys(MODES).map(mode => navigator.xr?.isSessionSupported(mode).catch(() => false) ?? false));
    if (worker !== this.worker) return;
    this.buttons.forEach((button, i) => { button.disabled = !can[i]; });
    const why = !window.isSecureContext ? 'This address is not secure: VR needs https or localhost.'
      : !navigator.xr ? 'This browser has no WebXR. Open this page in a headset’s browser.'
      : can.some(Boolean) ? '' : 'There is no headset. Open this page in a headset’s browser.';
    document.getElementById('support').textContent = why;
    this.trouble.hidden = true;
    this.seen.hidden = this.worn === null;
    document.documentElement.dataset.wear = 'ready';
  }

  async enter(mode) {
    if (!this.height.reportValidity()) return;
    try {
      const session = await navigator.xr.requestSession(mode, { requiredFeatures: ['local-floor'], optionalFeatures: ['hand-tracking'] });
      this.begin(session, mode);
      this.mirror.renderer.xr.setReferenceSpaceType('local-floor');
      await this.mirror.renderer.xr.setSession(session);
    } catch (error) {
      document.getElementById('support').textContent = `VR was not entered: ${error.message}`;
    }
  }

  begin(session, mode) {
    const { body, fps } = this.network;
    const tall = this.tall(null);
    this.worn = {
      session, network: this.network, tall, kinds: [null, null], placed: false, calibrated: false, due: null, waiting: 0, frames: 0, skipped: 0, last: null, passed: [], times: [],
      stream: new Stream({ fps, body, offsets: usualOffsets([null, null]), scale: body.height / tall, run: frame => this.worker.pose(frame) }),
    };
    this.seen.hidden = false;
    this.mirror.through(mode === 'immersive-ar');
    this.mirror.write(...INVITE);
    session.addEventListener('select', () => { this.worn.due ??= performance.now() + 1000 * COUNTDOWN; });
    session.addEventListener('visibilitychange', () => { this.worn.last = null; });
    session.addEventListener('end', () => this.end());
    this.mirror.renderer.setAnimationLoop((time, frame) => this.tick(time, frame));
  }

  tick(time, frame) {
    const space = this.mirror.renderer.xr.getReferenceSpace();
    if (frame && space && this.worn) {
      this.count(time);
      const trackers = trackersOf(frame, space, this.worn.session.inputSources);
      this.change(kindsOf(this.worn.session.inputSources));
      if (trackers[0] && !this.worn.placed) this.placeMirror(trackers[0]);
      this.calibrate(trackers);
      this.feed(trackers, time / 1000);
    }
    this.mirror.draw();
  }

  count(time) {
    const { worn } = this;
    if (worn.last !== null) worn.passed.push(time - worn.last);
    if (worn.passed.length > USUAL) worn.passed.shift();
    worn.last = time;
    worn.frames++;
    if (worn.frames % 20 === 0) this.showFacts();
  }

  // Controllers and hands have other offsets, so a calibration with one does not hold for the other. A side without
  // either keeps its kind.
  change(seen) {
    const { worn } = this;
    const kinds = seen.map((kind, side) => kind ?? worn.kinds[side]);
    if (kinds.every((kind, side) => kind === worn.kinds[side])) return;
    if (worn.calibrated) this.mirror.write(`Now ${[...new Set(kinds)].join(' and ')}:`, ...INVITE);
    Object.assign(worn, { kinds, calibrated: false });
    delete document.documentElement.dataset.calibrated;
    worn.stream.offsets = usualOffsets(kinds);
    worn.stream.reset();
  }

  placeMirror(head) {
    this.mirror.stand(head.position, headingOf(head.rotation));
    this.worn.placed = true;
  }

  // When the countdown is over, calibrate the devices.
  calibrate(trackers) {
    const { worn, mirror } = this;
    if (worn.due === null) return;
    const left = (worn.due - performance.now()) / 1000;
    if (left > 0) return mirror.write(`T-pose ... ${Math.ceil(left)}`, INVITE[1]);
    worn.due = null;
    try {
      const tall = this.tall(trackers[0]);
      worn.stream.calibrate(...trackers, worn.network.body.height / tall);
      Object.assign(worn, { tall, calibrated: true });
      document.documentElement.dataset.calibrated = 'yes';
      this.placeMirror(trackers[0]);
      mirror.write(`Calibrated, ${worn.tall.toFixed(2)} m tall.`, 'Pull a trigger or pinch to do it again.');
    } catch (error) {
      mirror.write('Not calibrated:', ...error.message.split('; '), INVITE[0]);
    }
  }

  // The wearer's height, metres: as typed in, else by the headset's height over the floor, else the network's body's.
  tall(head) {
    const { body } = this.worn?.network ?? this.network;
    const typed = this.height.valueAsNumber / 100;
    const tall = typed > 0 ? typed : head ? head.position[1] / body.eyes : body.height;
    if (!(tall >= SHORTEST && tall <= TALLEST)) throw new Error(`${tall.toFixed(2)} m tall; stand upright, or type in your height`);
    return tall;
  }

  feed(trackers, time) {
    const { worn } = this;
    if (worn.waiting >= AWAITED) return worn.skipped++;
    worn.waiting++;
    const start = performance.now();
    worn.stream.step(...trackers, time).then(pose => {
      worn.waiting--;
      if (pose.fresh) worn.times.push(performance.now() - start);
      if (worn.times.length > TIMED) worn.times.shift();
      if (pose.positions) this.mirror.show(pose.positions);
    }, error => {
      worn.waiting--;
      this.mirror.write('The network stopped:', error.message);
    });
  }

  showFacts() {
    const { worn } = this;
    this.framesText.textContent = worn.frames;
    this.rateText.textContent = rateOf(worn);
    this.skippedText.textContent = worn.skipped;
    this.tallText.textContent = worn.tall.toFixed(2);
    if (!worn.times.length) return;
    [this.middleText.textContent, this.p95Text.textContent] = percentiles(worn.times).map(ms => ms.toFixed(1));
  }

  end() {
    this.showFacts();
    this.worn = null;
    this.mirror.visible(false);
    this.mirror.through(false);
    this.mirror.renderer.setAnimationLoop(null);
    this.seen.hidden = true;
  }

  leave() {
    this.worn?.session.end();
    this.worker?.close();
    this.mirror?.dispose();
  }
}

// The display's measured rate, and the expected one where the browser reports it.
function rateOf({ passed, session }) {
  if (!passed.length) return '–';
  const usual = (1000 / percentiles(passed)[0]).toFixed(0);
  return session.frameRate ? `${usual} of ${session.frameRate.toFixed(0)}` : usual;
}
