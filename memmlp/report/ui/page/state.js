// The states of runs, and their words.

import { h } from './dom.js';

export const ACTIVE = ['training', 'evaluating', 'exporting'];
export const FINISHED = ['done', 'trained'];
export const BROKEN = ['failed', 'damaged'];
export const STATES = [...ACTIVE, ...FINISHED, ...BROKEN, 'lost', 'stopped', 'interrupted', 'new'];
export const STATE_WORDS = { new: 'waiting' };
const STATE_TITLES = {
  trained: 'Trained; an evaluation or export that was asked for is missing.', lost: 'Its process died; the next worker continues it.',
  stopped: 'Stopped on request; it continues after Retry.', interrupted: 'It continues when its command is repeated.',
};

// The class of a status: all work on a run looks the same.
export const look = status => (ACTIVE.includes(status) ? 'running' : status);

export function state(status, title = STATE_TITLES[status], more = '') {
  return h('span', { class: `state ${look(status)}`, title }, `${STATE_WORDS[status] ?? status}${more}`);
}
