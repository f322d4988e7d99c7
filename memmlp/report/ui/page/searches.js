// Searches: their history, what mattered, the Pareto front, and all trials across parallel axes.

import { h, replace, link, section, empty, select } from './dom.js';
import { address, alone, ask, place, remember, runs } from './store.js';
import { bars, history, parallel, scatter } from './charts.js';
import { number, shortKeys, word } from './format.js';
import { state } from './runs.js';

const WORDS = { complete: 'done', fail: 'failed', pruned: 'stopped', running: 'running' };
const counts = search => Object.entries(search.counts ?? {}).map(([name, count]) => `${count} ${name === 'fail' ? 'failed' : name}`).join(', ');

export async function page() {
  const element = h('div', { class: 'page' });
  async function update() {
    const { searches } = await ask('searches');
    const list = searches.map(search => h('li', {}, h('a', { class: 'card', href: address('search', search.name) }, h('span', { class: 'card-title' }, search.title),
      h('span', { class: 'faint' }, `${search.name}${search.objectives ? ` · ${search.objectives.join(', ')}` : ''}`),
      search.error ? h('span', { class: 'state failed' }, search.error) : h('span', {}, search.best?.length ? [h('b', { class: 'n' }, search.best[0].values.map(value => number(value, 3)).join(', ')), ' best · '] : null, h('small', { class: 'faint' }, `${counts(search)}${search.wanted ? ` of ${search.wanted}` : ''}`)))));
    replace(element, h('div', { class: 'bar' }, h('h1', {}, 'Searches'), h('p', { class: 'count' }, number(searches.length))),
      list.length ? h('ul', { class: 'cards' }, list) : empty('There are no searches yet.', h('p', {}, 'A search of the loss weights, or of any keys:'), h('pre', {}, 'memmlp tune data=mocap data.root=FOLDER search.n_trials=30')));
  }
  await update();
  return { title: 'Searches', element, update };
}

export async function single(name) {
  const element = h('div', { class: 'page' });
  const asks = async () => { const found = await ask(`searches/${name}`); return found; };
  async function update() {
    const search = await asks();
    const head = [h('p', { class: 'trail' }, link('#/searches', 'Searches')), h('div', { class: 'bar title' }, h('h1', {}, search.title)), search.name === search.title ? null : h('p', { class: 'faint sub' }, search.name)];
    if (search.error) return replace(element, head, h('p', { class: 'warning' }, search.error));
    replace(element, head, body(search));
  }
  await update();
  return { title: name, element, update: alone ? null : update };
}

function body(search) {
  const complete = search.trials.filter(trial => trial.state === 'complete' && trial.values.every(value => value !== null));
  const summary = h('p', {}, `${counts(search)}${search.wanted ? ` of ${search.wanted} trials` : ''}`);
  if (!complete.length) return [summary, empty('No trial is complete yet.', trials(search, new Map(search.keys.map(key => [key, key]))))];
  const short = shortKeys(search.keys);
  const wanted = search.objectives.includes(place().query.get('objective')) ? place().query.get('objective') : search.objectives[0];
  const index = search.objectives.indexOf(wanted);
  const listed = complete.map(trial => ({ ...trial, id: trial.number, value: trial.values[index] }));
  const text = trial => [`trial ${trial.number}: ${trial.values.map(value => number(value, 3)).join(', ')}`, ...search.keys.map(key => `${short.get(key)} ${word(trial.params[key])}`)].join('\n');
  const open = point => { const [run] = search.trials.find(trial => trial.number === point.number)?.runs ?? []; if (run && runs.has(run)) location.hash = address('run', run); };
  const front = new Set(search.front);
  const axes = [...search.keys.map(key => ({ key, name: short.get(key), log: search.log.includes(key) })), ...search.objectives.map((objective, i) => ({ key: `objective ${i}`, name: objective, log: false }))];
  const lines = listed.map(trial => ({ id: trial.number, value: trial.value, text: text(trial), cells: { ...trial.params, ...Object.fromEntries(trial.values.map((value, i) => [`objective ${i}`, value])) } }));
  const best = complete.filter(trial => front.has(trial.number));
  return [
    h('div', { class: 'sum' }, summary, h('p', { class: 'best' }, best.length === 1 ? 'Best: ' : `On the Pareto front: `, best.slice(0, 8).map((trial, i) => [i ? ', ' : '', runLink(trial), ' ', h('b', { class: 'n' }, trial.values.map(value => number(value, 3)).join(' / '))])), search.ends.map(line => h('p', { class: 'faint' }, line))),
    search.objectives.length > 1 ? h('div', { class: 'tools' }, select('Objective', search.objectives.map(one => [one, one]), wanted, value => { remember({ objective: value }); dispatchEvent(new HashChangeEvent('hashchange')); })) : null,
    search.objectives.length === 2 ? section('Pareto front', scatter(complete.map(trial => ({ id: trial.number, x: trial.values[0], y: trial.values[1], text: text(trial) })), { x: search.objectives[0], y: search.objectives[1], front, title: 'text' })) : null,
    h('div', { class: 'pair' }, section('History', history(listed, { label: wanted, choose: open })), importance(search, short)),
    section('All trials', h('p', { class: 'faint' }, `A line a trial, darker where ${wanted} is lower; the best stands out.`), parallel(lines, axes, { label: 'Parallel axes' })),
    section('Trials', trials(search, short)),
  ];
}

function importance(search, short) {
  if (search.too_few) return section('Importance', h('p', { class: 'faint' }, search.too_few));
  if (!search.importance.length) return null;
  return section('Importance', bars(search.importance.map(([key, value]) => ({ name: short.get(key), value })), { label: `${search.importance_is}, by ${search.objectives[0]}` }));
}

function runLink(trial) {
  const [run] = trial.runs;
  return run && runs.has(run) ? link(address('run', run), `trial ${trial.number}`) : `trial ${trial.number}`;
}

function trials(search, short) {
  const order = [...search.trials].sort((a, b) => (a.values[0] ?? Infinity) - (b.values[0] ?? Infinity) || a.number - b.number);
  return h('div', { class: 'scroll short' }, h('table', { class: 'grid' }, h('thead', {}, h('tr', {}, h('th', { scope: 'col' }, 'trial'), h('th', { scope: 'col' }, 'state'), search.objectives.map(one => h('th', { scope: 'col', class: 'n' }, one)), search.keys.map(key => h('th', { scope: 'col', class: 'n', title: key }, short.get(key))))),
    h('tbody', {}, order.map(trial => h('tr', {}, h('th', { scope: 'row' }, runLink(trial)), h('td', {}, state(WORDS[trial.state] ?? trial.state, trial.reason)), search.objectives.map((_, i) => h('td', { class: 'n' }, number(trial.values[i] ?? null, 3))), search.keys.map(key => h('td', { class: 'n' }, typeof trial.params[key] === 'number' ? number(trial.params[key]) : word(trial.params[key]))))))));
}
