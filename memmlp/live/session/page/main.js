// Receives frames as server-sent events, and shows the newest or the chosen one as a picture and in numbers.

import { History } from './history.js';
import { Stage } from './stage.js';
import { Wearer } from './wearer.js';

const QUIET = 1000; // milliseconds without a frame after which the status changes
const $ = id => document.getElementById(id);
const history = new History();
const wearer = new Wearer();
let stage = null;
let avatar = null;
let greeting = null;
let greetingText = null; // the greeting as it came
let arrived = -Infinity;
let malformed = 0;

const events = new EventSource('events');
events.addEventListener('greeting', event => {
  if (greetingText !== null && event.data !== greetingText) return location.reload(); // another command is there now
  greetingText = event.data;
  greet(JSON.parse(event.data));
});
events.addEventListener('wearer', event => wearer.show(JSON.parse(event.data)));
events.addEventListener('frame', event => {
  const frame = JSON.parse(event.data);
  ({ malformed } = frame);
  if (!frame.positions) return; // the message has the counts alone
  if (frame.number <= history.last && history.frames.length) begin(); // the command was started again
  history.add(frame);
  arrived = performance.now();
});

function greet(message) {
  greeting = message;
  $('about').textContent = `${message.network} · ${message.source}`;
  $('remark').hidden = !message.remark;
  $('remark').textContent = `This network is ${message.remark}.`;
  $('ramp').style.background = `linear-gradient(to right, ${message.heat.join(', ')})`;
  document.querySelector('.prediction').style.background = message.heat[1];
  $('top').textContent = `${message.top}+`;
  $('budget').textContent = `of ${(1000 / message.fps).toFixed(1)} ms at ${message.fps} Hz`;
  $('wearer').hidden = !message.worn;
  $('goes').hidden = !message.outputs.length;
  $('outputs').replaceChildren(...message.outputs.map(name => Object.assign(document.createElement('li'), { textContent: name })));
  try {
    stage ??= new Stage(document.querySelector('canvas'), message);
  } catch (error) {
    trouble(`This browser does not support WebGL (${error.message}); the numbers continue.`);
  }
  if (stage && message.avatar && !avatar) dress(message.avatar);
}

// The avatar's scripts are fetched only where the command serves an avatar.
async function dress(description) {
  try {
    const { Avatar } = await import('./avatar.js');
    avatar ??= await Avatar.load('avatar.vrm', description);
    stage.wear(avatar);
    $('dress').hidden = false;
    document.documentElement.dataset.avatar = 'there';
  } catch (error) {
    trouble(`The avatar cannot be shown (${error.message}).`);
  }
}

function trouble(line) {
  $('trouble').textContent = line;
  $('trouble').hidden = false;
}

function begin() {
  history.frames = [];
  history.resume();
}

const pause = () => (history.paused ? history.resume() : history.choose(history.last));
const step = by => history.choose((history.shown?.number ?? 0) + by);
$('pause').addEventListener('click', pause);
$('newest').addEventListener('click', () => history.resume());
$('dress').addEventListener('click', () => {
  stage.dressed = !stage.dressed;
  $('dress').setAttribute('aria-pressed', stage.dressed);
});
$('scrub').addEventListener('input', event => history.choose(event.target.valueAsNumber));
addEventListener('keydown', event => {
  if (event.target.matches('input[type=number], button')) return;
  const action = { ' ': pause, ArrowLeft: () => step(-1), ArrowRight: () => step(1), End: () => history.resume() }[event.key];
  if (!action) return;
  event.preventDefault();
  action();
});

function status() {
  if (events.readyState !== EventSource.OPEN) return ['gone', 'not connected'];
  if (performance.now() - arrived > QUIET) {
    const waiting = `waiting for ${greeting?.worn ? 'trackers' : 'the clip'}`;
    return ['', malformed ? `${waiting}, ${malformed} packets malformed` : waiting];
  }
  return history.paused ? ['', 'paused'] : ['live', 'live'];
}

function show(frame) {
  const [kind, line] = status();
  $('status').className = kind;
  $('trackers').classList.toggle('waiting', kind !== 'live' && !history.paused);
  $('status').textContent = line;
  $('pause').textContent = history.paused ? 'Play' : 'Pause';
  $('pause').setAttribute('aria-pressed', history.paused);
  $('newest').disabled = !history.paused;
  if (!frame) return;
  Object.assign($('scrub'), { min: history.first, max: history.last, value: frame.number });
  $('time').textContent = `${frame.time.toFixed(2)} s`;
  $('error').hidden = frame.mean === null;
  if (frame.mean !== null) $('mean').textContent = frame.mean.toFixed(1);
  for (const key of ['dropped', 'malformed']) $(key).textContent = frame[key];
  $('frames').textContent = frame.number + 1;
  $('jumping').hidden = !frame.jumping;
  for (const item of $('trackers').children) item.classList.toggle('held', frame.held.includes(item.dataset.name));
  for (const row of document.querySelectorAll('#latency [data-key]')) {
    const timing = history.timing(row.dataset.key);
    row.querySelectorAll('td').forEach((cell, i) => { cell.textContent = timing ? timing[i].toFixed(timing[i] < 10 ? 2 : 0) : '–'; });
  }
  const share = (history.timing('whole')[1] * greeting.fps) / 1000;
  $('share').style.width = `${Math.min(100 * share, 100)}%`;
  $('share').classList.toggle('over', share > 1);
}

let reported = 0;
function tick(now) {
  const frame = history.shown;
  if (stage && frame) {
    const began = performance.now();
    stage.show(frame);
    stage.draw();
    frame.drawn = performance.now() - began;
    document.documentElement.dataset.shown = frame.number;
  }
  if (now - reported > 100) {
    show(frame);
    reported = now;
  }
  requestAnimationFrame(tick);
}
requestAnimationFrame(tick);
