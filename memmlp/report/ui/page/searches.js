// Searches: their history, the importance of their keys, the Pareto front, and all trials.

import { cards, h, replace, link, section, empty, select, table } from './dom.js';
import { address, ask, place, remember, runs } from './store.js';
import { command } from './actions.js';
import { contour, parallel, scatter, spans } from './charts.js';
import { columnWords, duration, number, shortKeys, word } from './format.js';
import { state } from './state.js';

const WORDS = { complete: 'done', fail: 'failed', pruned: 'stopped', running: 'running' };
const values = trial => trial.values.map(value => number(value, 3)).join(', ');

function counts(search) {
  const text = Object.entries(search.counts ?? {}).map(([name, count]) => `${count} ${name === 'fail' ? 'failed' : name}`).join(', ');
  return `${text}${search.wanted ? ` of ${search.wanted} trials` : ''}`;
}

export async function page() {
  const element = h('div', { class: 'page' });
  async function update() {
    const { searches } = await ask('searches');
    const summary = search => (search.error ? h('span', { class: 'state failed' }, search.error) : h('span', {}, search.best?.length ? [h('b', { class: 'n' }, values(search.best[0])), ' best · '] : null, h('small', { class: 'faint' }, counts(search))));
    replace(element, cards('Searches', searches.map(search => [address('search', search.name), search.title, [search.name, search.objectives?.join(', ')].filter(Boolean).join(' · '), summary(search)]),
      empty('There are no searches yet.', h('p', {}, 'A search over the loss weights, or any keys:'), command('memmlp tune data=mocap data.root=FOLDER search.n_trials=30'))));
  }
  await update();
  return { title: 'Searches', element, update };
}

export async function single(name) {
  const element = h('div', { class: 'page' });
  async function update() {
    const search = await ask(`searches/${name}`);
    replace(element, h('p', { class: 'trail' }, link('#/searches', 'Searches')), h('div', { class: 'bar' }, h('h1', {}, search.title)),
      search.error ? h('p', { class: 'warning' }, search.error) : body(search, update));
  }
  await update();
  return { title: name, element, update };
}

function body(search, update) {
  const short = shortKeys(search.keys);
  const complete = search.trials.filter(trial => trial.state === 'complete' && trial.values.every(value => value !== null));
  if (!complete.length) return [h('p', {}, counts(search)), empty('No trial is complete yet.'), trials(search, short)];
  const objective = search.objectives.includes(place().query.get('objective')) ? place().query.get('objective') : search.objectives[0];
  const text = trial => [`trial ${trial.number}: ${values(trial)}`, ...search.keys.map(key => `${short.get(key)} ${word(trial.params[key])}`)].join('\n');
  const open = trial => { if (runs.has(trial.runs[0])) location.hash = address('run', trial.runs[0]); };
  const best = complete.filter(trial => search.front.includes(trial.number));
  const points = complete.map(trial => ({ ...trial, text: text(trial), best: best.includes(trial), x: trial.values[0], y: trial.values[1] }));
  let least = Infinity;
  const history = points.map(trial => {
    const value = trial.values[search.objectives.indexOf(objective)];
    const improves = value < least;
    if (improves) least = value;
    return { ...trial, x: trial.number, y: value, best: improves };
  });
  const importance = search.too_few ? h('p', { class: 'faint' }, search.too_few) : search.importance.length
    ? [h('p', { class: 'faint' }, `${search.importance_is}, by ${search.objectives[0]}`), table(null, search.importance.map(([key, share]) => [short.get(key), number(share, 2)]))] : null;
  return [
    h('div', { class: 'sum' }, h('p', {}, counts(search)), h('p', { class: 'best' }, best.length === 1 ? 'Best: ' : 'On the Pareto front: ', best.slice(0, 8).map((trial, i) => [i ? ', ' : '', runLink(trial), ' ', h('b', { class: 'n' }, values(trial))])), search.ends.map(line => h('p', { class: 'faint' }, line))),
    search.objectives.length > 1 ? h('div', { class: 'tools' }, select('Objective', search.objectives.map(one => [one, one]), objective, value => { remember({ objective: value }); update(); })) : null,
    search.objectives.length === 2 ? section('Pareto front', scatter(points, { x: search.objectives[0], y: search.objectives[1], open, mark: 'on the front' })) : null,
    h('div', { class: 'pair' }, section('History', scatter(history, { x: 'trial', y: objective, open, mark: 'best so far' })), importance && section('Importance', importance)),
    section('Slices', h('p', { class: 'faint' }, `${objective} by the value of each key.`), h('div', { class: 'charts' }, search.keys.map(key => h('div', { class: 'panel-chart' }, scatter(
      history.filter(point => point.params[key] !== undefined).map(point => ({ ...point, x: typeof point.params[key] === 'number' ? point.params[key] : word(point.params[key]), best: search.front.includes(point.number) })), { x: short.get(key), y: objective, open, mark: best.length === 1 ? 'best trial' : 'on the front', joined: false, log: search.log.includes(key) }))))),
    contours(search, history, objective, open, update),
    search.keys.length > 1 ? section('Parallel axes', parallel(history.map(point => ({ ...point, values: { ...point.params, [objective]: point.y } })), [...search.keys.slice(0, 8), objective], { log: search.log, open })) : null,
    timeline(search),
    trials(search, short),
  ];
}

// The objective over two numeric keys, at first the two most important ones.
function contours(search, history, objective, open, update) {
  const ranked = [...new Set([...search.importance.map(([key]) => key), ...search.keys])].filter(key => history.filter(point => typeof point.params[key] === 'number').length > 3);
  if (ranked.length < 2) return null;
  const { query } = place();
  const x = ranked.find(key => key === query.get('x')) ?? ranked[0];
  const y = ranked.find(key => key === query.get('y') && key !== x) ?? ranked.find(key => key !== x);
  const choose = (label, key, value) => select(label, ranked.map(one => [one, one]), value, one => { remember({ [key]: one }); update(); });
  const points = history.filter(point => [x, y].every(key => typeof point.params[key] === 'number')).map(point => ({ ...point, x: point.params[x], y: point.params[y], value: point.y }));
  return section('Contour', h('div', { class: 'tools' }, choose('Horizontal', 'x', x), choose('Vertical', 'y', y)), contour(points, { x, y, label: objective, log: search.log, open }));
}

function timeline(search) {
  const rows = search.trials.filter(trial => trial.began).map(trial => ({ ...trial, kind: WORDS[trial.state] ?? trial.state, ended: trial.ended ?? Date.now() / 1000 }));
  return rows.length ? section('Timeline', spans(rows.map(row => ({ ...row, text: `trial ${row.number}, ${row.kind}, ${duration(row.ended - row.began)}` })), { label: 'Trials by time' })) : null;
}

function runLink(trial) {
  return runs.has(trial.runs[0]) ? link(address('run', trial.runs[0]), `trial ${trial.number}`) : `trial ${trial.number}`;
}

function trials(search, short) {
  const order = [...search.trials].sort((a, b) => (a.values[0] ?? Infinity) - (b.values[0] ?? Infinity) || a.number - b.number);
  const words = new Map(search.keys.map(key => [key, columnWords(search.trials.map(trial => trial.params[key]))]));
  const row = trial => [runLink(trial), state(WORDS[trial.state] ?? trial.state, trial.reason), ...search.objectives.map((_, i) => number(trial.values[i] ?? null, 3)),
    ...search.keys.map(key => words.get(key)(trial.params[key]))];
  const grid = table(['trial', 'state', ...search.objectives, ...search.keys.map(key => short.get(key))], order.map(row));
  const chosen = order.findIndex(trial => String(trial.number) === place().query.get('trial')); // linked from its run
  if (chosen >= 0) grid.querySelectorAll('tbody tr')[chosen].classList.add('chosen');
  return section('Trials', grid);
}
