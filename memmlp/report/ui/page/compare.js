// Curves of several runs overlaid, by run or by group with bands; where they differ and what was measured.

import { h, replace, link, section, select, empty, choice } from './dom.js';
import { about, address, curvesOf, nameOf, place, remember, runs } from './store.js';
import { colourOf, curves } from './charts.js';
import { differing } from './runs.js';
import { bestOf, metricNumber, metricText, word } from './format.js';

const FIRST = ['train loss', 'val rotation MPJPE', 'val rotation MPJRE'];

// Curves with their controls. groupOf(run) -> its group's name; known settings are kept in the address.
export function curvePanel(ids, groupings, options = {}) {
  const element = h('div', { class: 'curves' });
  const hidden = new Set();
  let data = {};
  let drawn = '';

  const setting = (name, first) => place().query.get(name) ?? first;
  const set = changes => { remember(changes); draw(); };

  function draw() {
    const names = [...new Set(Object.values(data).flatMap(Object.keys))];
    if (!names.length) return replace(element, empty('No curves yet.', h('p', {}, 'They begin with the first entry of the metrics log.')));
    const wanted = (place().query.get('y') ?? '').split('|').filter(name => names.includes(name));
    const shown = wanted.length ? wanted : FIRST.filter(name => names.includes(name)).slice(0, options.most ?? 2);
    const list = shown.length ? shown : names.slice(0, 1);
    const group = groupings.find(([name]) => name === setting('group', groupings[0][0])) ?? groupings[0];
    const groupOf = group[2];
    const groups = [...new Set(ids.filter(id => id in data).map(id => groupOf(id)))];
    const colours = colourOf(groups);
    const each = setting('each', groups.length === ids.length ? 'yes' : 'no') === 'yes';
    const smooth = Number(setting('smooth', '0'));
    const log = setting('log', 'no') === 'yes';
    const key = groups.map(one => h('button', { type: 'button', class: 'key', 'aria-pressed': String(!hidden.has(one)), onclick: () => {
      hidden.has(one) ? hidden.delete(one) : hidden.add(one);
      draw();
    } }, h('i', { style: `background:${colours.get(one)}` }), one, h('small', {}, count(one, groupOf))));
    const charts = list.map(name => {
      const series = ids.filter(id => data[id]?.[name] && !hidden.has(groupOf(id)))
        .map(id => ({ run: id, group: groupOf(id), steps: data[id][name][0], values: data[id][name][1] }));
      return h('div', { class: 'panel-chart' }, h('h3', {}, title(name)), curves(series, { label: title(name), log, smooth, each, colours }));
    });
    const add = select('Add a curve', [['', 'choose'], ...names.filter(name => !list.includes(name)).map(name => [name, title(name)])], '', name => name && set({ y: [...list, name].join('|') }));
    const tools = h('div', { class: 'tools' },
      groupings.length > 1 ? select('Group by', groupings.map(([value, text]) => [value, text]), group[0], value => set({ group: value })) : null,
      groups.length < ids.length ? choice('Lines', [['no', 'means and bands'], ['yes', 'every run']], each ? 'yes' : 'no', value => set({ each: value })) : null,
      choice('Scale', [['no', 'linear'], ['yes', 'log']], log ? 'yes' : 'no', value => set({ log: value })),
      h('label', { class: 'field' }, h('span', {}, 'Smooth'), h('input', { type: 'range', min: 0, max: 0.98, step: 0.02, value: smooth, onchange: event => set({ smooth: event.target.value }) })),
      add, wanted.length ? h('button', { type: 'button', onclick: () => set({ y: '' }) }, 'Usual curves') : null);
    const focus = [...element.querySelectorAll('button, select, input')].indexOf(document.activeElement);
    replace(element, tools, groups.length > 1 ? h('div', { class: 'keys' }, key) : null, h('div', { class: 'charts' }, charts));
    if (focus >= 0) element.querySelectorAll('button, select, input')[focus]?.focus();
  }

  const count = (one, groupOf) => {
    const many = ids.filter(id => groupOf(id) === one).length;
    return many > 1 ? `${many} runs` : '';
  };

  async function update() {
    data = await curvesOf(ids);
    const stamp = JSON.stringify(Object.values(data).map(one => Object.values(one).map(([steps]) => steps.length && steps.at(-1))));
    if (stamp !== drawn) { drawn = stamp; draw(); }
  }
  return { element, update };
}

const title = name => name.replace(/^train /, 'training ').replace(/^val /, 'validation ');

export async function page() {
  const asked = (place().query.get('runs') ?? '').split(',').filter(Boolean);
  const ids = asked.filter(id => runs.has(id));
  if (!ids.length) throw new Error('None of these runs is here.');
  const list = () => ids.map(id => runs.get(id)).filter(Boolean);
  const keys = differing(list(), about.keys);
  const names = new Map(ids.map(id => [id, unique(runs.get(id), list())]));
  const groupings = [['run', 'run', id => names.get(id)], ...keys.filter(key => key !== 'seed').slice(0, 12).map(key => [key, key, id => `${key.replace(/\.name$/, '').split('.').at(-1)}=${word(runs.get(id)?.config[key])}`])];
  const arms = list().filter(run => run.places.length).length;
  if (arms) groupings.splice(1, 0, ['arm', 'arm of its sweep', id => runs.get(id)?.places[0]?.arm ?? 'no sweep']);
  const panel = curvePanel(ids, groupings, { most: 2 });
  const tables = h('div');
  const element = h('div', { class: 'page' }, h('p', { class: 'trail' }, link('#/runs', 'Runs')), h('h1', {}, `${ids.length} runs`),
    section('Curves', panel.element), tables);
  async function update() {
    replace(tables, differences(list(), keys, names), results(list(), names));
    await panel.update();
  }
  await update();
  return { title: `${ids.length} runs`, element, update };
}

const unique = (run, list) => (list.filter(other => nameOf(other) === nameOf(run)).length > 1 ? `${nameOf(run)} (${run.id.slice(0, 6)})` : nameOf(run));

function differences(list, keys, names) {
  if (list.length < 2) return null;
  const rows = about.keys.filter(key => new Set(list.map(run => run.cells[key])).size > 1);
  return section('Where they differ', rows.length ? matrix(rows.map(key => [key, ...list.map(run => word(run.config[key]))]), list, names) : h('p', { class: 'faint' }, 'Their configs are the same.'));
}

function results(list, names) {
  const rows = about.metrics.filter(name => list.some(run => typeof run.metrics[name] === 'number') && !name.includes('GT '));
  if (!rows.length) return null;
  const alike = new Set(list.map(run => run.data)).size === 1; // as in the list of runs, of several data sets no value is the best
  const line = name => {
    const values = list.map(run => run.metrics[name]);
    const best = alike ? bestOf(name, values.filter(value => typeof value === 'number')) : null;
    return [metricText(name), ...values.map(value => h('span', { class: value !== undefined && value === best ? 'least' : '' }, metricNumber(name, value)))];
  };
  const told = alike ? null : h('p', { class: 'faint' }, 'These runs are of several data sets, whose errors do not compare.');
  return section('Measured', told, matrix(rows.map(line), list, names, 'n'));
}

function matrix(rows, list, names, kind = '') {
  return h('div', { class: 'scroll' }, h('table', { class: 'grid lines' },
    h('thead', {}, h('tr', {}, h('th', { scope: 'col' }), list.map(run => h('th', { scope: 'col', class: kind }, link(address('run', run.id), names.get(run.id)))))),
    h('tbody', {}, rows.map(([head, ...cells]) => h('tr', {}, h('th', { scope: 'row' }, head), cells.map(cell => h('td', { class: kind }, cell)))))));
}
