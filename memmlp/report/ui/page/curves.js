// Curves of several runs, overlaid by run or by group with bands.

import { h, replace, select, empty } from './dom.js';
import { curvesOf, place, remember, runs } from './store.js';
import { colourOf, curves } from './charts.js';

const DEFAULT = ['train loss', 'val rotation MPJPE', 'val rotation MPJRE']; // the first two that exist
const AXES = { step: 'step', time: 'hours', samples: 'samples' };
const title = name => name.replace(/^train /, 'training ').replace(/^val /, 'validation ');

// Curves with their controls, whose settings are kept in the address. A grouping is [name, text, groupOf(id), fixed colours].
export function curvePanel(ids, groupings) {
  const element = h('div', { class: 'curves' });
  const hidden = new Set();
  let data = {};
  let drawn = '';

  const setting = (name, first) => place().query.get(name) ?? first;
  const set = changes => { remember(changes); draw(); };

  function draw() {
    const names = [...new Set(Object.values(data).flatMap(Object.keys))].filter(name => name !== 'seconds');
    if (!names.length) return replace(element, empty('No curves yet.', h('p', {}, 'They start with the first entry of the metrics log.')));
    const chosen = setting('y', '').split('|').filter(name => names.includes(name));
    const usual = DEFAULT.filter(name => names.includes(name)).slice(0, 2);
    const list = [chosen, usual, names.slice(0, 1)].find(some => some.length);
    const [groupName, , groupOf, fixed] = groupings.find(([name]) => name === setting('group')) ?? groupings[0];
    const groups = [...new Set(ids.filter(id => id in data).map(groupOf))];
    const colours = fixed ?? colourOf(groups);
    const smooth = Number(setting('smooth', '0'));
    const log = setting('log') === 'yes';
    const axis = setting('axis', 'step');
    const along = id => { // from a step to a place on the axis
      if (axis === 'samples') return step => step * (runs.get(id)?.batch ?? NaN);
      const [steps, seconds] = data[id].seconds ?? [[0, 1], [NaN, NaN]];
      const at = window.d3.scaleLinear(steps.length > 1 ? steps : [0, ...steps], (steps.length > 1 ? seconds : [0, ...seconds]).map(value => value / 3600));
      return axis === 'time' ? at : step => step;
    };
    const key = group => {
      const count = ids.filter(id => groupOf(id) === group).length;
      const toggle = () => { if (!hidden.delete(group)) hidden.add(group); draw(); };
      return h('button', { type: 'button', class: 'key', 'aria-pressed': String(!hidden.has(group)), onclick: toggle }, h('i', { style: `background:${colours.get(group)}` }), group, h('small', {}, count > 1 ? `${count} runs` : ''));
    };
    const charts = list.map(name => {
      const series = ids.filter(id => data[id]?.[name] && !hidden.has(groupOf(id))).map(id => ({ run: id, group: groupOf(id), steps: data[id][name][0].map(along(id)), values: data[id][name][1] })).filter(one => !one.steps.some(Number.isNaN));
      return h('div', { class: 'panel-chart' }, h('h3', {}, title(name)), curves(series, { label: title(name), log, smooth, colours, axis: AXES[axis] ?? 'step' }));
    });
    const tools = h('div', { class: 'tools' },
      groupings.length > 1 ? select('Group by', groupings.map(([value, text]) => [value, text]), groupName, group => set({ group })) : null,
      select('Over', [['step', 'steps'], ['time', 'time'], ['samples', 'samples']], axis, value => set({ axis: value })),
      select('Scale', [['no', 'linear'], ['yes', 'log']], log ? 'yes' : 'no', value => set({ log: value })),
      h('label', { class: 'field' }, h('span', {}, 'Smooth'), h('input', { type: 'range', min: 0, max: 20, value: smooth, onchange: event => set({ smooth: event.target.value }) })),
      select('Add a curve', [['', 'choose'], ...names.filter(name => !list.includes(name)).map(name => [name, title(name)])], '', name => name && set({ y: [...list, name].join('|') })),
      chosen.length ? h('button', { type: 'button', onclick: () => set({ y: '' }) }, 'Default curves') : null);
    replace(element, tools, groups.length > 1 ? h('div', { class: 'keys' }, groups.map(key)) : null, h('div', { class: 'charts' }, charts));
  }

  async function update() {
    data = await curvesOf(ids);
    const stamp = JSON.stringify(Object.values(data).map(one => Object.values(one).map(([steps]) => steps.at(-1))));
    if (stamp !== drawn) { drawn = stamp; draw(); }
  }
  return { element, update };
}
