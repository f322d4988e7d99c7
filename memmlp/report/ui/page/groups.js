// Groups of runs: means and spread over their members, and differences from a baseline.

import { h } from './dom.js';
import { nameOf, runs } from './store.js';
import { better, decimals, DASH, metricNumber, number, signed, word } from './format.js';

// The ways to group the table: [name, text].
export const groupings = keys => [['', 'no groups'], ['same', 'all but the seed'], ['sweep', 'sweep'], ['variant', 'variant of its sweep'], ...keys.map(key => [key, key])];

// A function that names a run's group.
export function grouper(name) {
  const [place] = ['sweep', 'variant'].filter(one => one === name);
  if (place === 'sweep') return run => run.places[0]?.sweep ?? run.places[0]?.search ?? 'no sweep';
  if (place === 'variant') return run => (run.places[0]?.variant ? `${run.places[0].sweep}: ${run.places[0].variant}` : 'no sweep');
  if (name === 'same') return run => nameOf(run).replace(/ · seed \S+/, '');
  return run => `${name}=${word(run.config[name])}`;
}

// Mean and standard deviation of a metric over runs with a number; null without any.
export function summary(list, metric) {
  const values = list.map(run => run.metrics[metric]).filter(value => typeof value === 'number');
  if (!values.length) return null;
  const mean = values.reduce((sum, value) => sum + value, 0) / values.length;
  const sd = values.length > 1 ? Math.sqrt(values.reduce((sum, value) => sum + (value - mean) ** 2, 0) / (values.length - 1)) : null;
  return { mean, sd, count: values.length };
}

// The runs whose mean is the baseline: the run of the address, or its whole group.
export function baseline(id, groupOf, list) {
  const run = runs.get(id);
  if (!run) return null;
  return { data: run.data, name: groupOf ? groupOf(run) : nameOf(run), members: groupOf ? list.filter(other => groupOf(other) === groupOf(run)) : [run] };
}

// A small difference of a value from the baseline's; null where they are not comparable.
export function difference(base, data, metric, value) {
  const before = base && base.data === data && typeof value === 'number' ? summary(base.members, metric) : null;
  if (!before || before.mean === value) return null;
  const change = value - before.mean;
  const kind = better(metric) && ((change < 0) === (better(metric) === 'lower') ? 'better' : 'worse');
  return h('small', { class: kind || null, title: `Difference from ${base.name}` }, signed(change, Math.abs(value) >= 1000 ? 0 : decimals(value)));
}

// The cell of a metric in a group's row.
export function groupCell(list, metric, base) {
  const data = new Set(list.filter(run => typeof run.metrics[metric] === 'number').map(run => run.data));
  const found = data.size === 1 ? summary(list, metric) : null;
  if (!found) return h('td', { class: 'n faint' }, data.size > 1 ? h('span', { title: 'Runs on several data sets are not comparable' }, 'mixed data') : DASH);
  const spread = found.sd === null ? h('small', { class: 'faint', title: 'One seed: no spread is known' }, ' 1 seed') : h('small', { class: 'faint' }, ` ± ${number(found.sd, found.mean >= 1000 ? 0 : decimals(found.mean))}`);
  return h('td', { class: 'n', 'data-csv': found.mean }, metricNumber(metric, found.mean), spread, found.count < list.length ? h('small', { class: 'faint' }, ` (${found.count} of ${list.length})`) : null, difference(base, [...data][0], metric, found.mean));
}
