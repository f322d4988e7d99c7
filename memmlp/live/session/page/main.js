// Receives frames as server-sent events, and shows them with the state of the trackers.

import { h } from './dom.js';
import { Viewer } from './viewer.js';
import { Wearer } from './wearer.js';

const QUIET = 1000; // milliseconds without a frame after which the status changes
const $ = id => document.getElementById(id);
let greeting = null;
let greetingText = null;
let arrived = -Infinity;
let malformed = 0;

const wearer = new Wearer();
const viewer = new Viewer([
  ['mean', 'mean error', 'cm', frame => frame.mean?.toFixed(1)],
  ['step', 'step, median / p95', 'ms', () => viewer.timing('ms')],
  ['whole', 'to outputs, median / p95', 'ms', () => viewer.timing('whole')],
  ['frames', 'frames', '', frame => frame.number + 1],
  ['dropped', 'dropped', '', frame => frame.dropped],
  ['malformed', 'malformed', '', frame => frame.malformed],
  ['held', 'lost and held', '', frame => frame.held.join(', ') || null],
  ['jumping', 'times jump', '', frame => (frame.jumping ? 'in seconds?' : null)],
], { refresh: showState });
document.querySelector('main').prepend(viewer.element);

const events = new EventSource('events');
events.addEventListener('greeting', event => {
  if (greetingText !== null && event.data !== greetingText) return location.reload(); // another command has this address now
  greetingText = event.data;
  greet(JSON.parse(event.data));
});
events.addEventListener('wearer', event => wearer.show(JSON.parse(event.data)));
events.addEventListener('frame', event => {
  const frame = JSON.parse(event.data);
  ({ malformed } = frame);
  if (!frame.positions) return; // the message has only the counts
  if (frame.number <= viewer.last && viewer.frames.length) viewer.clear(); // the command was restarted
  viewer.add(frame);
  arrived = performance.now();
});

function greet(message) {
  if (!greeting) viewer.describe(message);
  if (!greeting && message.avatar && viewer.stage) loadAvatar(message.avatar);
  greeting = message;
  $('about').textContent = [message.network, message.source, ...message.outputs].join(' · ');
  viewer.showRemark(message.remark);
  $('wearer').hidden = !message.wearer;
}

// The avatar's scripts are fetched only if the command serves an avatar.
async function loadAvatar(description) {
  try {
    const { Avatar } = await import('./avatar.js');
    viewer.stage.avatar = await Avatar.load('avatar.vrm', description); // in place of the limbs
    viewer.stage.scene.add(viewer.stage.avatar.scene);
    document.documentElement.dataset.avatar = 'loaded';
  } catch (error) {
    viewer.element.append(h('p', { class: 'warning' }, `The avatar cannot be shown (${error.message}).`));
  }
}

function describeState() {
  if (events.readyState !== EventSource.OPEN) return ['gone', 'not connected'];
  if (performance.now() - arrived > QUIET) {
    const waiting = `waiting for ${greeting?.wearer ? 'trackers' : 'the clip'}`;
    return ['', malformed ? `${waiting}, ${malformed} packets malformed` : waiting];
  }
  return viewer.paused ? ['', 'paused'] : ['live', 'live'];
}

function showState() {
  const [kind, line] = describeState();
  Object.assign($('status'), { className: kind, textContent: line });
}
