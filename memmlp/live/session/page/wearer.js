// Orders that fit the stream to its wearer: body height, floor, calibration in a T-pose after a countdown.

const POSES = { calibrate: 'Stand in a T-pose', touch_floor: 'Put a hand on the floor' };
const $ = id => document.getElementById(id);

export class Wearer {
  constructor() {
    for (const [id, action] of [['calibrate', 'calibrate'], ['touch', 'touch_floor'], ['forget', 'forget'], ['cancel', 'cancel']]) {
      $(id).addEventListener('click', () => {
        this.sound ??= new AudioContext(); // a page may make a sound only after a click
        order(action);
      });
    }
    for (const name of ['height', 'floor']) {
      $(name).addEventListener('change', ({ target }) => {
        if (target.reportValidity()) order(name, target.value === '' ? null : target.valueAsNumber / 100);
      });
    }
    $('countdown').addEventListener('cancel', () => order('cancel'));
    setInterval(() => this.count(), 50);
  }

  show(state) {
    for (const name of ['height', 'floor']) if (document.activeElement !== $(name)) $(name).value = state[name];
    $('forget').disabled = !state.calibrated;
    const storage = state.file ? `Changes are kept in ${state.file}.` : state.calibrated ? 'Not kept; --calibration FILE keeps it.' : '';
    answer(`${state.line} ${storage}`, state.failed);
    this.waiting = state.waiting && { ...state.waiting, until: performance.now() + 1000 * state.waiting.seconds };
    if (!this.waiting && $('countdown').open) this.beep(state.failed ? 220 : 880, 0.5);
    this.count();
  }

  // Show the remaining seconds, with a sound for a wearer who does not see the page.
  count() {
    if (!this.waiting) return $('countdown').close();
    const left = Math.max(Math.ceil((this.waiting.until - performance.now()) / 1000), 0);
    if (left !== this.left && left) this.beep(440, 0.12);
    this.left = left;
    $('what').textContent = POSES[this.waiting.action];
    $('seconds').textContent = left || '…';
    if (!$('countdown').open) $('countdown').showModal();
  }

  beep(frequency, seconds) {
    if (!this.sound) return;
    const tone = new OscillatorNode(this.sound, { frequency });
    tone.connect(new GainNode(this.sound, { gain: 0.15 })).connect(this.sound.destination);
    tone.start();
    tone.stop(this.sound.currentTime + seconds);
  }
}

function answer(line, failed) {
  $('answer').textContent = line;
  $('answer').classList.toggle('failed', failed);
}

async function order(action, value = null) {
  const response = await fetch('wearer', { method: 'POST', body: JSON.stringify({ action, value }) });
  if (!response.ok) answer(await response.text(), true);
}
