// The table of runs: filter, sort, the columns in which they differ, tags and notes; and chosen runs with their curves.

import { download, h, replace, link, savePng, section, select, empty, say, toCsv } from './dom.js';
import { about, address, ask, dataName, inFile, nameOf, place, remember, runs } from './store.js';
import { parse, matches } from './filter.js';
import { curvePanel } from './curves.js';
import { button, buttons, canChange, change, command, dialog } from './actions.js';
import { parallel, scatter } from './charts.js';
import { baseline, difference, groupCell, grouper, groupings as groupsOf } from './groups.js';
import { now, status } from './now.js';
import { FINISHED, state, STATES, STATE_WORDS } from './state.js';
import { ago, bestOf, better, columnWords, date, duration, DASH, metricNumber, metricText, metricWords, number, shortKeys, word } from './format.js';

const STEP = 100; // rows that are drawn at once
const VIEW = ['filter', 'sort', 'by', 'cols', 'base', 'x', 'y', 'axes']; // what a saved view keeps
const ORDER = new Intl.Collator(undefined, { numeric: true });
const KEYS = 6; // config columns that are shown by default
const METRICS = ['stream.rotation.MPJPE', 'stream.rotation.MPJRE', 'stream.rotation.MPJVE', 'stream.rotation.Jitter', 'latency.median_ms'];
const NARROW = matchMedia('(max-width: 640px)'); // errors come before keys on a narrow screen

// The keys in which these runs differ; with `first`, of several that differ in the same way (memory and its sizes) the first.
function differing(list, keys, first = false) {
  const everywhere = key => list.every(run => (run.config[key] ?? null) !== null);
  const rank = new Map(keys.map(key => [key, key.endsWith('.name') ? 0 : key === 'seed' ? 1 : everywhere(key) ? 2 : 3]));
  const seen = new Set();
  return [...keys].sort((a, b) => rank.get(a) - rank.get(b)).filter(key => {
    const places = new Map();
    for (const run of list) if (!places.has(run.cells[key])) places.set(run.cells[key], places.size);
    const pattern = list.map(run => places.get(run.cells[key])).join();
    const found = places.size > 1 && !(first && (seen.has(pattern) || about.minor.includes(key)));
    seen.add(pattern);
    return found;
  });
}

// The ways to group the curves of some runs: by run, by variant of their sweep, by keys in which they differ.
function groupings(list) {
  const count = run => list.filter(other => nameOf(other) === nameOf(run)).length;
  const names = new Map(list.map(run => [run.id, count(run) > 1 ? `${nameOf(run)} (${run.id.slice(0, 6)})` : nameOf(run)]));
  const keys = differing(list, about.keys, true).filter(key => key !== 'seed').slice(0, 12);
  const short = shortKeys(keys);
  return [
    ['run', 'run', id => names.get(id)],
    ...(list.some(run => run.places.length) ? [['variant', 'variant of its sweep', id => runs.get(id)?.places[0]?.variant ?? 'no sweep']] : []),
    ...keys.map(key => [key, key, id => `${short.get(key)}=${word(runs.get(id)?.config[key])}`]),
  ];
}

// All runs, or only the runs with the ids of the address.
export async function page(name, route) {
  const only = route.get('runs')?.split(',').filter(id => runs.has(id));
  if (only && !only.length) throw new Error('None of these runs is here.');
  const panel = only && curvePanel(only, groupings(only.map(id => runs.get(id))));
  const chosen = new Set((place().query.get('sel') ?? '').split(',').filter(Boolean));
  const ui = { drawn: STEP, open: new Set() };
  const counted = h('p', { class: 'count', role: 'status' });
  const dataSets = h('p', { class: 'best' });
  const table = h('table', { class: 'runs' });
  const more = h('button', { type: 'button', onclick: () => { ui.drawn += STEP * 4; body(); } });
  const compare = h('button', { type: 'button', class: 'primary', title: 'Choose two runs or more in the first column', onclick: () => { location.hash = address('compare', '', { runs: place().query.get('sel') }); } });
  const set = changes => { remember(changes); draw(); };
  const filter = h('input', {
    type: 'search', id: 'filter', spellcheck: false, autocomplete: 'off', placeholder: 'memory=gru stream.MPJPE<6.3, or words',
    oninput: () => { ui.drawn = STEP; set({ filter: filter.value }); },
  });
  const scroll = h('div', { class: 'scroll tall' }, table, more);
  const [nothing, happening, tools, picked, plot, lines] = Array.from({ length: 6 }, () => h('div'));
  const remarks = h('p', { class: 'faint' });
  Object.assign(picked, { className: 'picked', style: 'min-height: 1.75rem' }); // the table stays where it is at the first choice
  function draw(live = false) { // live: without touching what somebody uses
    const inUse = part => live && part.contains(document.activeElement);
    const { query } = place();
    const settings = { text: query.get('filter') ?? '', sort: query.get('sort') ?? '-started', group: query.get('by') ?? '' };
    if (filter.value !== settings.text) filter.value = settings.text;
    const tests = parse(settings.text);
    const archived = settings.text.includes('archived');
    ui.list = sorted([...runs.values()].filter(run => (only ? only.includes(run.id) : archived || !run.archived) && matches(tests, run)), settings.sort);
    ui.data = [...new Set(ui.list.filter(run => FINISHED.includes(run.status)).map(run => run.data))];
    ui.groupOf = settings.group ? grouper(settings.group) : null;
    ui.base = baseline(query.get('base'), ui.groupOf, ui.list);
    const networks = ui.list.filter(run => run.kind === 'memmlp'); // a VQ-VAE has few of their keys
    const metrics = !networks.length ? about.metrics.filter(one => one.startsWith('vqvae.')).slice(0, 5) : only ? about.metrics.filter(one => !one.includes('GT ')) : METRICS;
    const pinned = (query.get('cols') ?? '').split(',').filter(one => about.keys.includes(one) || about.metrics.includes(one));
    const measured = metrics.filter(one => !pinned.includes(one) && ui.list.some(run => run.metrics[one] !== undefined && run.metrics[one] !== null));
    const keys = differing(networks.length && !only ? networks : ui.list, about.keys, !only).slice(0, only ? undefined : KEYS).filter(one => !pinned.includes(one) && !(settings.group === 'same' && one === 'seed'));
    ui.columns = [...pinned, ...(NARROW.matches || settings.group ? [measured, keys] : [keys, measured]).flat()];
    ui.words = new Map(ui.columns.map(name => [name, columnWords(ui.list.map(run => run.config[name]))]));
    head(settings.sort);
    body();
    if (!inUse(picked)) selection();
    if (!inUse(tools)) replace(tools, toolbar(query, pinned, settings.group));
    scatterOf(query);
    axesOf(query);
    const hidden = archived ? 0 : [...runs.values()].filter(run => run.archived).length;
    const count = name => ui.list.filter(run => run.status === name).length;
    replace(counted, [`${number(ui.list.length)} of ${number(runs.size)} runs`, ...STATES.filter(count).map(name => `${number(count(name))} ${STATE_WORDS[name] ?? name}`)].join(', '), hidden ? [', ', link(address('runs', '', { filter: 'archived=true' }), `${hidden} archived`)] : null);
    const named = data => dataName(data).split(' ')[0]; // a digest only where a name has several
    const names = ui.data.map(data => `data=${ui.data.some(other => other !== data && named(other) === named(data)) ? data : named(data)}`);
    replace(dataSets, tests.filter(one => one.unknown).map(one => `${one.unknown}: no key in which runs differ. `), names.length > 1 ? [`On ${names.length} data sets, whose errors are not comparable; filter by one: `, names.slice(0, 5).flatMap(one => [' ', button(one, () => set({ filter: `${settings.text} ${one}`.trim() }))])] : null);
    replace(happening, now());
    const marks = [...new Set(ui.list.slice(0, ui.drawn).flatMap(run => Object.values(run.marks)).map(text => text.replace(/ \(.*?\)|: a core.*/, '')))];
    replace(remarks, marks.length ? `* ${marks.join('; ')}` : null);
    scroll.hidden = tools.hidden = picked.hidden = !ui.list.length;
    replace(nothing, ui.list.length ? null : runs.size ? empty('No run matches.', h('button', { type: 'button', onclick: () => set({ filter: '' }) }, 'Show all runs'))
      : empty('There are no runs yet.', h('p', {}, 'They appear here as soon as one starts:'), command('memmlp demo'), command('memmlp train data=synth profile=tiny'), h('p', { class: 'faint' }, `Searched in: ${about.outputs}/runs`)));
  }
  // Groups, columns, baseline, saved views and CSV.
  function toolbar(query, pinned, group) {
    const names = [...about.keys, ...about.metrics].filter(one => !pinned.includes(one)).map(one => [one, one]);
    const pin = list => set({ cols: list.join(',') });
    const here = new URLSearchParams([...query].filter(([key]) => VIEW.includes(key))).toString();
    const view = Object.entries(ui.views ?? {}).find(([, text]) => text === here)?.[0] ?? '';
    const openView = text => { remember({ ...Object.fromEntries(VIEW.map(key => [key, ''])), ...Object.fromEntries(new URLSearchParams(ui.views[text] ?? '')) }); draw(); };
    const store = async (name, value) => { await change({ action: 'view', name, value }); await readViews(); };
    return h('div', { class: 'tools' },
      select('Group by', groupsOf(about.keys), group, by => set({ by })),
      select('Pin a column', [['', 'choose'], ...names], '', one => one && pin([...pinned, one])),
      select('Scatter', [['', 'off'], ...names.filter(([one]) => about.metrics.includes(one))], query.get('y') ?? '', y => set({ y })),
      Object.keys(ui.views ?? {}).length ? select('View', [['', 'choose'], ...Object.keys(ui.views).map(one => [one, one])], view, openView) : null,
      canChange() && !only ? h('div', { class: 'chips' }, button('Save view', () => dialog('Save view', { field: 'input', value: view, act: text => store(text, here || 'sort=-started') })),
        view ? button('Delete view', () => dialog(`Delete the view ${view}?`, { word: 'Delete', act: () => store(view, '') })) : null) : null,
      button('Parallel axes', () => set({ axes: query.get('axes') ? '' : 'yes' }), 'Each run as a line over the shown columns; pin columns to add axes'),
      button('CSV', () => download('runs.csv', toCsv(whole())), 'All rows and shown columns'), button('PNG', () => savePng('runs.png', table), 'The rows shown'),
      h('div', { class: 'chips' }, pinned.map(one => button(`${one} ×`, () => pin(pinned.filter(other => other !== one)), 'Unpin')), ui.base ? button(`Baseline: ${ui.base.name} ×`, () => set({ base: '' })) : null));
  }
  const whole = () => h('table', {}, table.tHead.cloneNode(true), h('tbody', {}, ui.list.map(run => line(run, {}))));
  function scatterOf(query) {
    const [x, y] = [query.get('x') || about.keys.find(key => key !== 'seed' && ui.list.some(run => typeof run.config[key] === 'number')) || about.metrics[0], query.get('y')];
    if (!y || !about.metrics.includes(y)) { ui.plotted = ''; return replace(plot); }
    const of = (run, name) => (name in run.config ? run.config[name] : run.metrics[name]);
    const points = ui.list.map(run => ({ x: of(run, x), y: of(run, y), run, best: ui.base?.members.includes(run), text: `${nameOf(run)}\n${x} ${word(of(run, x))}\n${y} ${word(of(run, y))}` })).filter(point => typeof point.y === 'number' && (point.x ?? null) !== null);
    const key = JSON.stringify([x, y, points.map(point => [point.x, point.y, point.best])]);
    if (key === ui.plotted) return plot;
    ui.plotted = key;
    return replace(plot, section('Scatter', h('div', { class: 'tools' }, select('Horizontal', [...about.keys, ...about.metrics].map(one => [one, one]), x, value => set({ x: value }))),
      points.length ? scatter(points, { x, y: metricText(y), mark: 'baseline', joined: false, open: point => { location.hash = address('run', point.run.id); } }) : h('p', { class: 'faint' }, 'No run has both.')));
  }
  function axesOf(query) {
    const rows = query.get('axes') ? ui.list.slice(0, 500).map(run => ({ id: run.id, text: nameOf(run), values: { ...run.config, ...run.metrics } })) : [];
    const axes = [...ui.columns].sort((a, b) => about.metrics.includes(a) - about.metrics.includes(b)).slice(0, 9);
    const key = JSON.stringify([axes, rows.map(row => [row.id, axes.map(name => row.values[name])])]);
    if (key === ui.axes) return;
    ui.axes = key;
    replace(lines, rows.length && axes.length > 1 ? section('Parallel axes', parallel(rows, axes, { open: row => { location.hash = address('run', row.id); } })) : null);
  }
  function head(sort) {
    const short = shortKeys(ui.columns.filter(name => about.keys.includes(name)));
    const startsDown = name => name === 'started' || name === 'seconds' || better(name) === 'higher';
    const cell = (name, content, more = {}) => {
      const order = sort === name ? 'ascending' : sort === `-${name}` ? 'descending' : null;
      const next = order === 'ascending' || (!order && startsDown(name)) ? `-${name}` : name;
      return h('th', { scope: 'col', 'aria-sort': order, ...more }, h('button', { type: 'button', onclick: () => set({ sort: next }) }, content));
    };
    const metric = name => {
      const { metric, where, unit } = metricWords(name);
      return cell(name, [h('span', {}, metric), h('small', {}, [where, unit].filter(Boolean).join(', '))], { class: 'n', title: name, 'data-csv': name });
    };
    const all = h('input', { type: 'checkbox', 'aria-label': 'Choose all runs shown', onchange: event => pick(ui.list.slice(0, ui.drawn), event.target.checked) });
    const heads = ui.columns.map(name => (about.keys.includes(name) ? cell(name, short.get(name), { title: name, 'data-csv': name }) : metric(name)));
    replace(table.tHead ?? table.createTHead(), h('tr', {}, h('th', { scope: 'col', class: 'pick' }, all), cell('name', 'run'), cell('status', 'status'), heads, cell('started', 'started', { class: 'n' }), cell('seconds', 'took', { class: 'n' })));
  }
  function pick(list, on) {
    for (const run of list) on ? chosen.add(run.id) : chosen.delete(run.id);
    body();
    selection();
  }

  function body() {
    const least = {};
    for (const name of ui.data.length < 2 ? ui.columns.filter(one => about.metrics.includes(one)) : []) {
      const values = ui.list.map(run => run.metrics[name]).filter(value => typeof value === 'number');
      if (values.length > 1 && !ui.groupOf) least[name] = bestOf(name, values);
    }
    const focused = document.activeElement?.dataset?.run;
    const shown = ui.list.slice(0, ui.drawn);
    const groups = new Map();
    for (const run of ui.groupOf ? ui.list : []) groups.set(ui.groupOf(run), [...groups.get(ui.groupOf(run)) ?? [], run]);
    const rows = h('tbody', {}, ui.groupOf ? [...groups].map(([group, list]) => [groupLine(group, list), ui.open.has(group) ? list.map(run => line(run, least)) : []]) : shown.map(run => line(run, least)));
    table.tBodies[0] ? table.tBodies[0].replaceWith(rows) : table.append(rows);
    if (focused) rows.querySelector(`[data-run="${CSS.escape(focused)}"]`)?.focus();
    more.hidden = Boolean(ui.groupOf) || shown.length >= ui.list.length;
    more.textContent = `${number(ui.list.length - shown.length)} more`;
  }

  function groupLine(group, list) {
    const open = ui.open.has(group);
    const toggle = () => { if (!ui.open.delete(group)) ui.open.add(group); body(); selection(); };
    const all = h('input', { type: 'checkbox', checked: list.every(run => chosen.has(run.id)), 'aria-label': `Choose the runs of ${group}`, onchange: event => pick(list, event.target.checked) });
    const key = name => {
      const values = [...new Set(list.map(run => ui.words.get(name)(run.config[name])))];
      return h('td', { class: 'value', title: values.join(', ') }, values.length === 1 ? values[0] : h('span', { class: 'faint' }, `${values.length} values`));
    };
    const states = STATES.map(name => [name, list.filter(run => run.status === name).length]).filter(([, count]) => count);
    return h('tr', { class: 'group' }, h('td', { class: 'pick' }, all), h('th', { scope: 'row' }, h('button', { type: 'button', 'aria-expanded': String(open), onclick: toggle }, h('span', { class: 'name', title: group }, `${open ? '▾' : '▸'} ${group}`)), h('span', { class: 'id' }, `${list.length} ${list.length === 1 ? 'run' : 'runs'}`)),
      h('td', {}, states.map(([name, count]) => [state(name), ` ${count} `])), ui.columns.map(name => (about.keys.includes(name) ? key(name) : groupCell(list, name, ui.base))), h('td'), h('td'));
  }

  function line(run, least) {
    const box = h('input', { type: 'checkbox', checked: chosen.has(run.id), 'data-run': run.id, 'aria-label': `Choose ${nameOf(run)}, ${run.id}`, onchange: event => {
      event.target.checked ? chosen.add(run.id) : chosen.delete(run.id);
      selection();
    } });
    const cell = name => {
      if (about.keys.includes(name)) return h('td', { class: 'value', title: word(run.config[name]), 'data-csv': run.config[name] ?? '' }, ui.words.get(name)(run.config[name]));
      const value = run.metrics[name];
      return h('td', { class: value !== undefined && value === least[name] ? 'n least' : 'n', 'data-csv': value ?? '' }, measured(run, name), difference(ui.base, run.data, name, value));
    };
    return h('tr', {},
      h('td', { class: 'pick' }, box),
      h('th', { scope: 'row', 'data-csv': `${run.name} ${run.id}` }, link(address('run', run.id), h('span', { class: 'name', title: run.name }, nameOf(run))), h('span', { class: 'id' }, run.id.slice(0, 8)), run.tags.length || run.note ? h('div', { class: 'tags' }, tags(run), run.note && h('span', { class: 'note', title: run.note }, run.note)) : null),
      h('td', { 'data-csv': run.status }, status(run)), ui.columns.map(cell),
      h('td', { class: 'n faint', title: date(run.started), 'data-csv': run.started }, ago(run.started)), h('td', { class: 'n faint', 'data-csv': run.seconds ?? '' }, duration(run.seconds)));
  }

  function selection() {
    const ids = [...chosen].filter(id => runs.has(id)).slice(0, 60);
    remember({ sel: ids.join(',') });
    compare.textContent = ids.length ? `Compare ${ids.length}` : 'Compare';
    compare.disabled = ids.length < 2;
    const done = deleted => { for (const id of ids) if (deleted || runs.get(id)?.archived) chosen.delete(id); draw(); };
    replace(picked, ids.length ? [h('span', { class: 'count' }, `${ids.length} chosen:`), buttons(ids, done), h('button', { type: 'button', class: 'small', disabled: ids.length > 1, title: ids.length > 1 ? 'Choose one run' : 'Show differences from this run', onclick: () => set({ base: ids[0] }) }, 'Baseline')] : h('span', { class: 'count' }, 'No run chosen'));
    for (const row of table.tBodies[0]?.rows ?? []) row.classList.toggle('chosen', chosen.has(row.querySelector('input').dataset.run));
  }

  async function readViews() {
    ui.views = inFile ? {} : (await ask('views')).views;
    draw();
  }

  const title = only ? `${only.length} runs` : 'Runs';
  const element = h('div', { class: 'page wide' },
    only && h('p', { class: 'trail' }, link('#/runs', 'Runs')),
    h('div', { class: 'bar' }, h('h1', {}, title), counted, h('label', { class: 'search' }, h('span', { class: 'hidden' }, 'Filter of runs'), filter), compare),
    only ? null : happening, dataSets, tools, picked, scroll, remarks, nothing, plot, lines, panel && section('Curves', panel.element));
  async function update() {
    draw(true);
    await panel?.update();
  }
  await readViews();
  await panel?.update();
  return { title, element, update: () => { update(); say(`${ui.list.length} runs`); } };
}

// A metric of a run, with a mark if a reader must know something about it.
export function measured(run, name) {
  const value = run.metrics[name];
  if (value === undefined || value === null) return h('span', { class: 'faint' }, DASH);
  if (typeof value !== 'number') return h('span', { class: 'bad', title: 'Not a number in at least one test clip' }, value === 'nan' ? 'NaN' : value);
  const mark = run.marks[name.startsWith('latency') ? 'latency' : 'errors'];
  return [metricNumber(name, value), mark && !/parameters|macs|bytes/.test(name) ? h('abbr', { class: 'mark', title: mark, 'aria-label': mark }, '*') : null];
}

export const tags = run => run.tags.map(tag => h('span', { class: 'tag' }, tag));

function sorted(list, sort) {
  const down = sort.startsWith('-');
  const name = down ? sort.slice(1) : sort;
  const of = run => (name in run && typeof run[name] !== 'object' ? run[name] : run.config[name] ?? run.metrics[name]);
  const missing = value => value === null || value === undefined || value === '';
  return list.map(run => [of(run), run]).sort(([a, one], [b, other]) => {
    const byId = one.id < other.id ? -1 : 1;
    if (missing(a) || missing(b)) return Number(missing(a)) - Number(missing(b)) || byId;
    const order = typeof a === 'number' && typeof b === 'number' ? a - b : ORDER.compare(a, b);
    return (down ? -order : order) || byId;
  }).map(([, run]) => run);
}
