// What happens now: failures with their reasons, then running work with its stage, progress and remaining time.

import { h, link } from './dom.js';
import { about, address, nameOf, runs } from './store.js';
import { ago, bytes, duration } from './format.js';
import { ACTIVE, BROKEN, state } from './state.js';

const FAILURES = 3; // shown at once
const RUNNING = 8;

// Seconds that a run needs until its evaluation and export are finished; null if unknown.
export function secondsLeft(run) {
  const [first, last] = [run.recent[0], run.recent.at(-1)];
  const since = (Date.now() - Date.parse(run.since)) / 1000;
  const after = run.kind === 'memmlp' ? about.after : 0;
  if (run.status !== 'training') return after === null || Number.isNaN(since) ? null : Math.max(after - since, 0);
  const pace = last && last[0] > first[0] ? (last[1] - first[1]) / (last[0] - first[0]) : null;
  return pace && run.steps ? Math.max(run.steps - last[0], 0) * pace + (after ?? 0) : null;
}

export const shareDone = run => (run.steps && run.recent.length ? Math.min(run.recent.at(-1)[0] / run.steps, 1) : null);

// The state of a run in words, and the progress of one that runs.
export function status(run) {
  if (run.damage.length) return state('damaged', run.damage.join('; '));
  if (!ACTIVE.includes(run.status)) return state(run.status, run.failure || undefined, run.prioritized && run.status !== 'done' ? ', prioritised' : '');
  const share = shareDone(run);
  const left = secondsLeft(run);
  const trains = run.status === 'training';
  const percent = share === null ? 'starting' : `${Math.floor(100 * share)} %`;
  return h('span', { class: 'state running' }, trains && share !== null ? h('progress', { value: share, max: 1, 'aria-label': `${percent} trained` }) : null,
    h('span', {}, trains ? percent : run.status), left === null ? null : h('small', {}, left ? `${duration(left)} remaining` : 'nearly done'), run.prioritized ? h('small', {}, 'prioritised') : null, run.stopping ? h('small', {}, 'stops at its next step') : null);
}

// The panel above the table of runs; null if nothing runs and nothing has failed.
export function now() {
  const list = [...runs.values()].filter(run => !run.archived);
  const byTime = (a, b) => (b.since || b.started).localeCompare(a.since || a.started);
  const failed = list.filter(run => BROKEN.includes(run.status)).sort(byTime);
  const running = list.filter(run => ACTIVE.includes(run.status)).sort(byTime);
  const failure = run => h('p', { class: 'warning' }, link(address('run', run.id), h('b', {}, nameOf(run))), ` ${run.status}${run.since || run.started ? ` ${ago(run.since || run.started)}` : ''}: `, run.failure || run.damage.join('; ') || 'no reason is recorded');
  const work = run => h('li', {}, link(address('run', run.id), nameOf(run)), ' ', status(run), run.status === 'training' && run.steps ? h('small', {}, `training, step ${run.recent.at(-1)?.[0] ?? 0} of ${run.steps}`) : null);
  const more = (all, shown, word) => (all.length > shown ? h('p', {}, link(address('runs', '', { filter: `status=${word}` }), `${all.length - shown} more`)) : null);
  const data = about.preparing.map(one => h('li', {}, `Preparing the data ${one.name}`, ' ', h('small', {}, `${bytes(one.bytes)} written; training follows`)));
  if (!failed.length && !running.length && !data.length) return null;
  return h('div', { class: 'now' }, failed.slice(0, FAILURES).map(failure), more(failed, FAILURES, 'failed'),
    running.length || data.length ? h('ul', { 'aria-label': 'Running' }, data, running.slice(0, RUNNING).map(work)) : null, more(running, RUNNING, 'training'));
}
