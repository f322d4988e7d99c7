// The table of runs: filter, sort, the columns in which they differ, tags and notes; and chosen runs with their curves.

import { h, replace, link, section, empty, say } from './dom.js';
import { about, address, nameOf, place, remember, runs } from './store.js';
import { parse, matches } from './filter.js';
import { curvePanel } from './curves.js';
import { ago, bestOf, better, date, duration, DASH, metricNumber, metricWords, number, shortKeys, word } from './format.js';

const STEP = 150; // rows that are drawn at once
const KEYS = 6; // config columns that are shown by default
const METRICS = ['stream.rotation.MPJPE', 'stream.rotation.MPJRE', 'stream.rotation.MPJVE', 'stream.rotation.Jitter', 'latency.median_ms'];
const NARROW = matchMedia('(max-width: 640px)'); // errors come before keys on a narrow screen
export const ACTIVE = ['training', 'evaluating', 'exporting'];
export const FINISHED = ['done', 'trained'];
const STATES = [...ACTIVE, ...FINISHED, 'failed', 'damaged', 'lost', 'stopped', 'new'];
export const STATE_WORDS = { new: 'waiting' };
const STATE_TITLES = { trained: 'Trained; an evaluation or export that was asked for is missing.' };

// The class of a status: all work on a run looks the same.
export const look = status => (ACTIVE.includes(status) ? 'running' : status);

export function state(status, title = STATE_TITLES[status]) {
  return h('span', { class: `state ${look(status)}`, title }, STATE_WORDS[status] ?? status);
}

// The keys in which these runs differ; of several that differ in the same way (memory and its sizes) the first.
export function differing(list, keys) {
  const everywhere = key => list.every(run => (run.config[key] ?? null) !== null);
  const rank = new Map(keys.map(key => [key, key.endsWith('.name') ? 0 : key === 'seed' ? 1 : everywhere(key) ? 2 : 3]));
  const seen = new Set();
  return [...keys].sort((a, b) => rank.get(a) - rank.get(b)).filter(key => {
    const places = new Map();
    for (const run of list) if (!places.has(run.cells[key])) places.set(run.cells[key], places.size);
    const pattern = list.map(run => places.get(run.cells[key])).join();
    const found = places.size > 1 && !seen.has(pattern) && !about.minor.includes(key);
    seen.add(pattern);
    return found;
  });
}

// The ways to group the curves of some runs: by run, by variant of their sweep, by keys in which they differ.
function groupings(list) {
  const count = run => list.filter(other => nameOf(other) === nameOf(run)).length;
  const names = new Map(list.map(run => [run.id, count(run) > 1 ? `${nameOf(run)} (${run.id.slice(0, 6)})` : nameOf(run)]));
  const keys = differing(list, about.keys).filter(key => key !== 'seed').slice(0, 12);
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
  const ui = { drawn: STEP };
  const counted = h('p', { class: 'count', role: 'status' });
  const dataSets = h('p', { class: 'best' });
  const table = h('table', { class: 'runs' });
  const more = h('button', { type: 'button', onclick: () => { ui.drawn += STEP * 4; body(); } });
  const compare = h('button', { type: 'button', class: 'primary', title: 'Choose runs in the first column', onclick: () => { location.hash = address('compare', '', { runs: place().query.get('sel') }); } });
  const set = changes => { remember(changes); draw(); };
  const filter = h('input', {
    type: 'search', id: 'filter', spellcheck: false, autocomplete: 'off', placeholder: 'memory=gru stream.MPJPE<6.3, or words',
    oninput: () => { ui.drawn = STEP; set({ filter: filter.value }); },
  });
  const scroll = h('div', { class: 'scroll tall' }, table, more);
  const nothing = h('div');

  function draw() {
    const { query } = place();
    const settings = { text: query.get('filter') ?? '', sort: query.get('sort') ?? '-started' };
    if (filter.value !== settings.text) filter.value = settings.text;
    const tests = parse(settings.text);
    ui.list = sorted([...runs.values()].filter(run => (!only || only.includes(run.id)) && matches(tests, run)), settings.sort);
    ui.data = [...new Set(ui.list.filter(run => FINISHED.includes(run.status)).map(run => run.data))];
    const networks = ui.list.filter(run => run.kind === 'memmlp'); // a VQ-VAE has few of their keys
    const metrics = !networks.length ? about.metrics.filter(one => one.startsWith('vqvae.')).slice(0, 5) : only ? about.metrics.filter(one => !one.includes('GT ')) : METRICS;
    const measured = metrics.filter(one => ui.list.some(run => typeof run.metrics[one] === 'number'));
    const groups = [differing(networks.length ? networks : ui.list, about.keys).slice(0, only ? undefined : KEYS), measured];
    ui.columns = (NARROW.matches ? groups.reverse() : groups).flat();
    head(settings.sort);
    body();
    selection();
    const count = name => ui.list.filter(run => run.status === name).length;
    replace(counted, [`${number(ui.list.length)} of ${number(runs.size)} runs`, ...STATES.filter(count).map(name => `${number(count(name))} ${STATE_WORDS[name] ?? name}`)].join(', '));
    replace(dataSets, ui.data.length > 1 ? `On ${ui.data.length} data sets, whose errors are not comparable; filter by one: ${ui.data.slice(0, 5).map(data => `data=${data}`).join(', ')}` : null);
    scroll.hidden = !ui.list.length;
    replace(nothing, ui.list.length ? null : runs.size ? empty('No run matches.', h('button', { type: 'button', onclick: () => set({ filter: '' }) }, 'Show all runs'))
      : empty('There are no runs yet.', h('p', {}, 'They appear here as soon as one starts:'), h('pre', {}, 'memmlp demo\nmemmlp train data=synth profile=tiny'), h('p', { class: 'faint' }, `Searched in: ${about.outputs}/runs`)));
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
      return cell(name, [h('span', {}, metric), h('small', {}, [where, unit].filter(Boolean).join(', '))], { class: 'n', title: name });
    };
    const all = h('input', { type: 'checkbox', 'aria-label': 'Choose all runs shown', onchange: event => {
      for (const run of ui.list.slice(0, ui.drawn)) event.target.checked ? chosen.add(run.id) : chosen.delete(run.id);
      body();
      selection();
    } });
    const heads = ui.columns.map(name => (about.keys.includes(name) ? cell(name, short.get(name), { title: name }) : metric(name)));
    replace(table.tHead ?? table.createTHead(), h('tr', {}, h('th', { scope: 'col', class: 'pick' }, all), cell('name', 'run'), cell('status', 'status'), heads, cell('started', 'started', { class: 'n' }), cell('seconds', 'took', { class: 'n' })));
  }

  function body() {
    const least = {};
    for (const name of ui.data.length < 2 ? ui.columns.filter(one => about.metrics.includes(one)) : []) {
      const values = ui.list.map(run => run.metrics[name]).filter(value => typeof value === 'number');
      if (values.length > 1) least[name] = bestOf(name, values);
    }
    const focused = document.activeElement?.dataset?.run;
    const shown = ui.list.slice(0, ui.drawn);
    const rows = h('tbody', {}, shown.map(run => line(run, least)));
    table.tBodies[0] ? table.tBodies[0].replaceWith(rows) : table.append(rows);
    if (focused) rows.querySelector(`[data-run="${CSS.escape(focused)}"]`)?.focus();
    more.hidden = shown.length >= ui.list.length;
    more.textContent = `${number(ui.list.length - shown.length)} more`;
  }

  function line(run, least) {
    const pick = h('input', { type: 'checkbox', checked: chosen.has(run.id), 'data-run': run.id, 'aria-label': `Choose ${nameOf(run)}, ${run.id}`, onchange: event => {
      event.target.checked ? chosen.add(run.id) : chosen.delete(run.id);
      selection();
    } });
    const cell = name => {
      if (about.keys.includes(name)) return h('td', { class: 'value' }, word(run.config[name]));
      const value = run.metrics[name];
      return h('td', { class: value !== undefined && value === least[name] ? 'n least' : 'n' }, typeof value === 'number' ? metricNumber(name, value) : h('span', { class: 'faint' }, DASH));
    };
    return h('tr', {},
      h('td', { class: 'pick' }, pick),
      h('th', { scope: 'row', title: nameOf(run) }, link(address('run', run.id), nameOf(run)), h('span', { class: 'id' }, run.id.slice(0, 8)), tags(run), run.note && h('span', { class: 'note', title: run.note }, run.note)),
      h('td', {}, status(run)), ui.columns.map(cell),
      h('td', { class: 'n faint', title: date(run.started) }, ago(run.started)), h('td', { class: 'n faint' }, duration(run.seconds)));
  }

  function selection() {
    const ids = [...chosen].filter(id => runs.has(id)).slice(0, 60);
    remember({ sel: ids.join(',') });
    compare.textContent = ids.length ? `Compare ${ids.length}` : 'Compare';
    compare.disabled = !ids.length;
    for (const row of table.tBodies[0]?.rows ?? []) row.classList.toggle('chosen', chosen.has(row.querySelector('input').dataset.run));
  }

  const title = only ? `${only.length} runs` : 'Runs';
  const element = h('div', { class: 'page wide' },
    only && h('p', { class: 'trail' }, link('#/runs', 'Runs')),
    h('div', { class: 'bar' }, h('h1', {}, title), counted, h('label', { class: 'search' }, h('span', { class: 'hidden' }, 'Filter of runs'), filter), compare),
    dataSets, scroll, nothing, panel && section('Curves', panel.element));
  async function update() {
    draw();
    await panel?.update();
  }
  await update();
  return { title, element, update: () => { update(); say(`${ui.list.length} runs`); } };
}

export const tags = run => run.tags.map(tag => h('span', { class: 'tag' }, tag));

// The state of a run in words, and the progress of one that trains.
export function status(run) {
  if (run.damage.length) return h('span', { class: 'state damaged', title: run.damage.join('; ') }, 'damaged');
  const [first, last] = [run.recent[0], run.recent.at(-1)];
  if (run.status !== 'training' || !last || !run.steps) return state(run.status, run.failure || undefined);
  const pace = last[0] > first[0] ? (last[1] - first[1]) / (last[0] - first[0]) : null;
  const share = Math.min(last[0] / run.steps, 1);
  const percent = `${Math.floor(100 * share)} %`;
  const remaining = share < 1 && pace ? `${duration((run.steps - last[0]) * pace)} remaining` : '';
  return h('span', { class: 'state running' }, h('progress', { value: share, max: 1, 'aria-label': `${percent} trained` }), h('span', {}, percent), h('small', {}, remaining));
}

function sorted(list, sort) {
  const down = sort.startsWith('-');
  const name = down ? sort.slice(1) : sort;
  const of = run => (name in run && typeof run[name] !== 'object' ? run[name] : run.config[name] ?? run.metrics[name]);
  const missing = value => value === null || value === undefined || value === '';
  return [...list].sort((one, other) => {
    const [a, b] = [of(one), of(other)];
    const byId = one.id < other.id ? -1 : 1;
    if (missing(a) || missing(b)) return Number(missing(a)) - Number(missing(b)) || byId;
    const order = typeof a === 'number' && typeof b === 'number' ? a - b : String(a).localeCompare(String(b), undefined, { numeric: true });
    return (down ? -order : order) || byId;
  });
}
