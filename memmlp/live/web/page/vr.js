// Enter VR or AR: a body follows the user's head and hands, computed here, in front of a mirror.

import { h, replace, select } from './dom.js';
import { kindsOf, trackersOf, usualOffsets } from './headset.js';
import { MirrorScene } from './mirror_scene.js';
import { openNetwork } from './network.js';
import { headingOf } from './rotations.js';
import { isLost, Stream } from './stream.js';
import { Facts, percentiles } from './viewer.js';

const MODES = { 'immersive-vr': 'Enter VR', 'immersive-ar': 'Enter AR' };
const COUNTDOWN = 3000; // milliseconds from the trigger to the calibration
const MAX_WAITING = 2; // samples that wait for the network; later ones are skipped
const TIMED = 600; // newest poses whose times are shown
const [MIN_HEIGHT, MAX_HEIGHT] = [0.9, 2.4]; // metres; outside of them a floor or a height is wrong
const INVITATION = ['Pull a trigger or pinch, then stand upright in T-pose:', 'arms to the sides, palms down, eyes forward'];

// Whether the browser can enter each mode.
export const canEnter = () => Promise.all(Object.keys(MODES).map(mode => navigator.xr?.isSessionSupported(mode).catch(() => false) ?? false));

export function vr(page, site) {
  const view = new VrPage(page, site);
  return () => view.leave();
}

class VrPage {
  constructor(page, site) {
    Object.assign(this, { site, network: site.networks[0], user: null });
    this.canvas = h('canvas', { 'aria-label': 'The view in the mirror' });
    this.support = h('p', { class: 'faint', id: 'support' }, 'Loading the network.');
    this.remark = h('p', { class: 'warning', id: 'remark' });
    this.height = h('input', { type: 'number', id: 'height', min: 100, max: 230, step: 'any', placeholder: 'by headset' });
    this.buttons = Object.entries(MODES).map(([mode, name]) =>
      h('button', { type: 'button', class: 'primary', id: mode, disabled: true, onclick: () => this.enter(mode) }, name));
    this.facts = new Facts([
      ['frames', 'frames', '', user => user.frames], ['skipped', 'skipped samples', '', user => user.skipped],
      ['pose', 'pose, median / p95', 'ms', user => percentiles(user.times)?.map(ms => ms.toFixed(1)).join(' / ')],
      ['user-height', 'height', 'm', user => user.height.toFixed(2)],
    ]);
    this.layOut(page);
    try {
      this.mirror = new MirrorScene(this.canvas, site);
    } catch (error) {
      this.support.textContent = `This browser does not support WebGL: ${error.message}`;
      return;
    }
    this.load();
  }

  layOut(page) {
    const { networks } = this.site;
    replace(page,
      h('h1', {}, 'Your body, from head and hands'),
      h('div', { class: 'entry' }, this.buttons,
        networks.length > 1 && select('Network', networks.map(({ key, name }) => [key, name]), this.network.key, key => {
          this.user?.session.end();
          this.network = networks.find(network => network.key === key);
          this.load();
        }),
        h('label', { class: 'field' }, h('span', {}, 'Your height [cm]'), this.height)),
      this.remark, this.support,
      this.view = h('div', { class: 'replay', hidden: true }, h('div', { class: 'view' }, h('div', { class: 'view-stage' }, this.canvas)), this.facts.element));
  }

  // Load the network, and ask the browser which modes it can enter.
  async load() {
    const { network } = this;
    this.remark.hidden = !network.remark;
    this.remark.textContent = `This network is ${network.remark}.`;
    for (const button of this.buttons) button.disabled = true;
    const failed = error => { this.support.textContent = `The network did not load: ${error.message}`; };
    const opened = await openNetwork(network.play).catch(failed);
    const possible = await canEnter();
    if (!opened || network !== this.network) return;
    await this.opened?.close();
    this.opened = opened;
    this.buttons.forEach((button, i) => { button.disabled = !possible[i]; });
    this.support.textContent = !window.isSecureContext ? 'This address is not secure: VR needs https or localhost.'
      : !navigator.xr ? 'This browser does not support WebXR. Open this page in a headset’s browser.'
      : possible.some(Boolean) ? '' : 'There is no headset. Open this page in a headset’s browser.';
    document.documentElement.dataset.vr = 'ready';
  }

  async enter(mode) {
    if (!this.height.reportValidity()) return;
    try {
      const session = await navigator.xr.requestSession(mode, { requiredFeatures: ['local-floor'], optionalFeatures: ['hand-tracking'] });
      this.start(session, mode);
      this.mirror.renderer.xr.setReferenceSpaceType('local-floor');
      await this.mirror.renderer.xr.setSession(session);
    } catch (error) {
      this.support.textContent = `VR was not entered: ${error.message}`;
    }
  }

  start(session, mode) {
    const { mirror, opened, network } = this;
    const height = this.measureHeight(null);
    const stream = new Stream({ ...network, offsets: usualOffsets([null, null]), scale: network.body.height / height, run: frame => opened.pose(frame) });
    this.user = {
      session, stream, height, kinds: [null, null], placed: false, calibrated: false, due: null, waiting: 0, frames: 0, skipped: 0, times: [],
    };
    this.view.hidden = false;
    mirror.showRoom(mode === 'immersive-ar');
    mirror.write(...INVITATION);
    session.addEventListener('select', () => { this.user.due ??= performance.now() + COUNTDOWN; });
    session.addEventListener('end', () => this.end());
    mirror.renderer.setAnimationLoop((time, frame) => this.tick(time, frame));
  }

  tick(time, frame) {
    const { mirror, user } = this;
    const space = mirror.renderer.xr.getReferenceSpace();
    if (frame && space && user) {
      if (++user.frames % 20 === 0) this.facts.show(user);
      const trackers = trackersOf(frame, space, user.session.inputSources).map(tracker => (isLost(tracker) ? null : tracker));
      this.changeDevices(kindsOf(user.session.inputSources));
      if (trackers[0] && !user.placed) this.placeMirror(trackers[0]);
      this.calibrate(trackers);
      this.feed(trackers, time / 1000);
    }
    mirror.renderer.render(mirror.scene, mirror.camera); // the session supplies the canvas' size and the camera
  }

  // Controllers and hands have different offsets, so a change makes the calibration invalid. A side without either keeps its kind.
  changeDevices(seen) {
    const { user } = this;
    const kinds = seen.map((kind, side) => kind ?? user.kinds[side]);
    if (kinds.every((kind, side) => kind === user.kinds[side])) return;
    if (user.calibrated) this.mirror.write(`Now ${[...new Set(kinds)].join(' and ')}:`, ...INVITATION);
    Object.assign(user, { kinds, calibrated: false });
    delete document.documentElement.dataset.calibrated;
    user.stream.offsets = usualOffsets(kinds);
    user.stream.reset();
  }

  placeMirror(head) {
    this.mirror.stand(head.position, headingOf(head.rotation));
    this.user.placed = true;
  }

  // Calibrate the devices when the countdown ends.
  calibrate(trackers) {
    const { user, mirror, network } = this;
    if (user.due === null) return;
    const left = (user.due - performance.now()) / 1000;
    if (left > 0) return mirror.write(`T-pose ... ${Math.ceil(left)}`, INVITATION[1]);
    user.due = null;
    try {
      const height = this.measureHeight(trackers[0]);
      user.stream.calibrate(...trackers, network.body.height / height);
      Object.assign(user, { height, calibrated: true });
      document.documentElement.dataset.calibrated = 'yes';
      this.placeMirror(trackers[0]);
      mirror.write(`Calibrated, ${height.toFixed(2)} m tall.`, 'Pull a trigger or pinch to repeat it.');
    } catch (error) {
      mirror.write('Not calibrated:', ...error.message.split('; '), INVITATION[0]);
    }
  }

  // The user's height, metres: typed, or from the headset's height above the floor, or the height of the network's body.
  measureHeight(head) {
    const { body } = this.network;
    const typed = this.height.valueAsNumber / 100;
    const height = typed > 0 ? typed : head ? head.position[1] / body.eyes : body.height;
    if (!(height >= MIN_HEIGHT && height <= MAX_HEIGHT)) throw new Error(`${height.toFixed(2)} m tall; stand upright, or type your height`);
    return height;
  }

  async feed(trackers, time) {
    const { user, mirror } = this;
    if (user.waiting >= MAX_WAITING) return user.skipped++;
    user.waiting++;
    const start = performance.now();
    try {
      const pose = await user.stream.step(...trackers, time);
      if (pose.fresh) user.times = [...user.times, performance.now() - start].slice(-TIMED);
      if (pose.positions) mirror.show(pose.positions);
    } catch (error) {
      mirror.write('The network stopped:', error.message);
    }
    user.waiting--;
  }

  end() {
    this.facts.show(this.user);
    this.user = null;
    this.mirror.hideBody();
    this.mirror.renderer.setAnimationLoop(null);
    this.view.hidden = true;
  }

  leave() {
    this.user?.session.end();
    this.opened?.close();
    this.mirror?.renderer.setAnimationLoop(null);
    this.mirror?.renderer.dispose();
  }
}
