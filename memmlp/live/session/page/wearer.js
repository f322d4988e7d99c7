// Orders that fit the stream to its wearer: body height, floor, calibration in a T-pose after a countdown.

const WORDS = { calibrate: 'Stand in a T-pose', touch_floor: 'Put a hand on the floor' };
const $ = id => document.getElementById(id);

export class Wearer {
  constructor() {
    this.order('calibrate', 'calibrate');
    this.order('touch', 'touch_floor');
    this.order('forget', 'forget');
    this.order('cancel', 'cancel');
    for (const name of ['height', 'floor']) {
      $(name).addEventListener('change', event => {
        if (event.target.reportValidity()) ask(name, event.target.value === '' ? null : event.target.valueAsNumber / 100);
      });
    }
    setInterval(() => this.count(), 50);
  }

  order(id, action) {
    $(id).addEventListener('click', () => {
      this.sound ??= new AudioContext(); // a page may make a sound only after a click
      ask(action, null);
    });
  }

  show(state) {
    for (const name of ['height', 'floor']) if (document.activeElement !== $(name)) $(name).value = state[name];
    $('forget').disabled = !state.calibrated;
    $('said').textContent = [state.line, kept(state)].filter(Boolean).join(' ');
    $('said').classList.toggle('failed', state.failed);
    this.waiting = state.waiting && { ...state.waiting, until: performance.now() + 1000 * state.waiting.seconds };
    if (!this.waiting && !$('countdown').hidden) this.beep(state.failed ? 220 : 880, 0.5);
    this.count();
  }

  // Show the seconds that are left, and sound them for who wears a headset.
  count() {
    $('countdown').hidden = !this.waiting;
    if (!this.waiting) return;
    const left = Math.max(Math.ceil((this.waiting.until - performance.now()) / 1000), 0);
    if (left !== this.left && left) this.beep(440, 0.12);
    this.left = left;
    $('what').textContent = WORDS[this.waiting.action];
    $('seconds').textContent = left || 'waiting for trackers';
  }

  beep(hertz, seconds) {
    if (!this.sound) return;
    const tone = new OscillatorNode(this.sound, { frequency: hertz });
    const volume = new GainNode(this.sound, { gain: 0.15 });
    tone.connect(volume).connect(this.sound.destination);
    tone.start();
    tone.stop(this.sound.currentTime + seconds);
  }
}

function kept({ file, calibrated }) {
  if (file) return `Changes are kept in ${file}.`;
  return calibrated ? 'Not kept; --calibration FILE keeps it.' : '';
}

async function ask(action, value) {
  const answer = await fetch('wearer', { method: 'POST', body: JSON.stringify({ action, value }) });
  if (answer.ok) return;
  $('said').textContent = await answer.text();
  $('said').classList.add('failed');
}
