// Curves of several runs overlaid, by run or by group with bands; where they differ and what was measured.

import { h, replace, link, section, select, empty, choice, table } from './dom.js';
import { about, address, curvesOf, nameOf, place, remember, runs } from './store.js';
import { colourOf, curves } from './charts.js';
import { differing } from './runs.js';
import { bestOf, metricNumber, metricText, word } from './format.js';

const FIRST = ['train loss', 'val rotation MPJPE', 'val rotation MPJRE'];
const FIRST_COUNT = 2;
const title = name => name.replace(/^train /, 'training ').replace(/^val /, 'validation ');

// Curves with their controls, whose settings are kept in the address. A grouping is [name, text, groupOf(id)].
export function curvePanel(ids, groupings) {
  const element = h('div', { class: 'curves' });
  const hidden = new Set();
  let data = {};
  let drawn = '';

  const setting = (name, first) => place().query.get(name) ?? first;
  const set = changes => { remember(changes); draw(); };

  function draw() {
    const names = [...new Set(Object.values(data).flatMap(Object.keys))];
    if (!names.length) return replace(element, empty('No curves yet.', h('p', {}, 'They start with the first entry of the metrics log.')));
    const chosen = setting('y', '').split('|').filter(name => names.includes(name));
    const usual = FIRST.filter(name => names.includes(name)).slice(0, FIRST_COUNT);
    const list = [chosen, usual, names.slice(0, 1)].find(some => some.length);
    const [groupName, , groupOf] = groupings.find(([name]) => name === setting('group')) ?? groupings[0];
    const groups = [...new Set(ids.filter(id => id in data).map(groupOf))];
    const colours = colourOf(groups);
    const each = setting('each', groups.length === ids.length ? 'yes' : 'no') === 'yes';
    const smooth = Number(setting('smooth', '0'));
    const log = setting('log') === 'yes';
    const key = group => {
      const count = ids.filter(id => groupOf(id) === group).length;
      const toggle = () => { if (!hidden.delete(group)) hidden.add(group); draw(); };
      return h('button', { type: 'button', class: 'key', 'aria-pressed': String(!hidden.has(group)), onclick: toggle }, h('i', { style: `background:${colours.get(group)}` }), group, h('small', {}, count > 1 ? `${count} runs` : ''));
    };
    const charts = list.map(name => {
      const series = ids.filter(id => data[id]?.[name] && !hidden.has(groupOf(id))).map(id => ({ run: id, group: groupOf(id), steps: data[id][name][0], values: data[id][name][1] }));
      return h('div', { class: 'panel-chart' }, h('h3', {}, title(name)), curves(series, { label: title(name), log, smooth, each, colours }));
    });
    const tools = h('div', { class: 'tools' },
      groupings.length > 1 ? select('Group by', groupings.map(([value, text]) => [value, text]), groupName, group => set({ group })) : null,
      groups.length < ids.length ? choice('Lines', [['no', 'means and bands'], ['yes', 'every run']], each ? 'yes' : 'no', value => set({ each: value })) : null,
      choice('Scale', [['no', 'linear'], ['yes', 'log']], log ? 'yes' : 'no', value => set({ log: value })),
      h('label', { class: 'field' }, h('span', {}, 'Smooth'), h('input', { type: 'range', min: 0, max: 0.98, step: 0.02, value: smooth, onchange: event => set({ smooth: event.target.value }) })),
      select('Add a curve', [['', 'choose'], ...names.filter(name => !list.includes(name)).map(name => [name, title(name)])], '', name => name && set({ y: [...list, name].join('|') })),
      chosen.length ? h('button', { type: 'button', onclick: () => set({ y: '' }) }, 'Default curves') : null);
    const focus = [...element.querySelectorAll('button, select, input')].indexOf(document.activeElement);
    replace(element, tools, groups.length > 1 ? h('div', { class: 'keys' }, groups.map(key)) : null, h('div', { class: 'charts' }, charts));
    if (focus >= 0) element.querySelectorAll('button, select, input')[focus]?.focus();
  }

  async function update() {
    data = await curvesOf(ids);
    const stamp = JSON.stringify(Object.values(data).map(one => Object.values(one).map(([steps]) => steps.at(-1))));
    if (stamp !== drawn) { drawn = stamp; draw(); }
  }
  return { element, update };
}

export async function page() {
  const ids = (place().query.get('runs') ?? '').split(',').filter(id => runs.has(id));
  if (!ids.length) throw new Error('None of these runs is here.');
  const list = () => ids.map(id => runs.get(id)).filter(Boolean);
  const keys = differing(list(), about.keys);
  const same = run => list().filter(other => nameOf(other) === nameOf(run)).length > 1;
  const names = new Map(list().map(run => [run.id, same(run) ? `${nameOf(run)} (${run.id.slice(0, 6)})` : nameOf(run)]));
  const groupings = [
    ['run', 'run', id => names.get(id)],
    ...(list().some(run => run.places.length) ? [['variant', 'variant of its sweep', id => runs.get(id)?.places[0]?.variant ?? 'no sweep']] : []),
    ...keys.filter(key => key !== 'seed').slice(0, 12).map(key => [key, key, id => `${key.replace(/\.name$/, '').split('.').at(-1)}=${word(runs.get(id)?.config[key])}`]),
  ];
  const panel = curvePanel(ids, groupings);
  const tables = h('div');
  async function update() {
    replace(tables, differences(list(), names), results(list(), names));
    await panel.update();
  }
  await update();
  const element = h('div', { class: 'page' }, h('p', { class: 'trail' }, link('#/runs', 'Runs')), h('h1', {}, `${ids.length} runs`), section('Curves', panel.element), tables);
  return { title: `${ids.length} runs`, element, update };
}

const heads = (list, names) => ['', ...list.map(run => link(address('run', run.id), names.get(run.id)))];

function differences(list, names) {
  if (list.length < 2) return null;
  const keys = about.keys.filter(key => new Set(list.map(run => run.cells[key])).size > 1);
  const rows = keys.map(key => [key, ...list.map(run => word(run.config[key]))]);
  return section('Where they differ', rows.length ? table(heads(list, names), rows, { n: false, kind: 'lines', scroll: 'scroll' }) : h('p', { class: 'faint' }, 'Their configs are the same.'));
}

function results(list, names) {
  const metrics = about.metrics.filter(name => list.some(run => typeof run.metrics[name] === 'number') && !name.includes('GT '));
  if (!metrics.length) return null;
  const comparable = new Set(list.map(run => run.data)).size === 1; // errors on several data sets are not comparable
  const row = name => {
    const values = list.map(run => run.metrics[name]);
    const best = comparable ? bestOf(name, values.filter(value => typeof value === 'number')) : null;
    return [metricText(name), ...values.map(value => h('span', { class: value !== undefined && value === best ? 'least' : '' }, metricNumber(name, value)))];
  };
  const note = comparable ? null : h('p', { class: 'faint' }, 'These runs are on several data sets; their errors are not comparable.');
  return section('Measured', note, table(heads(list, names), metrics.map(row), { kind: 'lines', scroll: 'scroll' }));
}
