// The table of runs: filter, sort, the columns in which they differ, tags and notes.

import { h, replace, link, empty, code, say } from './dom.js';
import { about, address, dataName, nameOf, place, remember, runs } from './store.js';
import { parse, matches } from './filter.js';
import { ago, bestOf, better, date, duration, DASH, metricNumber, metricText, metricWords, number, shortKeys, word } from './format.js';

const STEP = 150; // rows that are drawn at once
const AUTO = 6; // config columns that are shown unasked
const METRICS = ['stream.rotation.MPJPE', 'stream.rotation.MPJRE', 'stream.rotation.MPJVE', 'stream.rotation.Jitter', 'latency.median_ms'];
const NARROW = matchMedia('(max-width: 640px)'); // errors come first where little can be seen
const KINDS = [['memmlp', 'Networks'], ['vqvae', 'VQ-VAEs'], ['', 'All']];
export const AT_WORK = ['training', 'evaluating', 'exporting'];
const STATES = [...AT_WORK, 'done', 'trained', 'failed', 'lost', 'stopped', 'new'];
export const STATE_WORDS = { lost: 'lost', new: 'waiting', blocked: 'blocked', stopped: 'stopped', trained: 'trained' };
const STATE_TITLES = { trained: 'Trained; an evaluation or export that was asked for is missing.' };
export const FINISHED = ['done', 'trained'];

// How a status looks: whatever somebody does with a run looks alike.
export const look = status => (AT_WORK.includes(status) ? 'running' : status);

export function state(status, title = STATE_TITLES[status]) {
  return h('span', { class: `state ${look(status)}`, title }, STATE_WORDS[status] ?? status);
}

// The keys in which these runs differ; of several that differ alike (memory and its sizes) the first.
export function differing(list, keys) {
  const everywhere = key => list.every(run => (run.config[key] ?? null) !== null);
  const first = key => (key.endsWith('.name') ? 0 : key === 'seed' ? 1 : everywhere(key) ? 2 : 3);
  const seen = new Set();
  const found = [];
  const rank = new Map(keys.map(key => [key, first(key)]));
  for (const key of [...keys].sort((a, b) => rank.get(a) - rank.get(b))) {
    const places = new Map();
    const pattern = list.map(run => {
      const value = run.cells[key];
      if (!places.has(value)) places.set(value, places.size);
      return places.get(value);
    });
    const text = pattern.join();
    if (places.size > 1 && !seen.has(text) && !about.minor.includes(key)) found.push(key);
    seen.add(text);
  }
  return found;
}

export function page() {
  const chosen = new Set();
  const ui = { drawn: STEP };
  const counted = h('p', { class: 'count', role: 'status' });
  const best = h('p', { class: 'best' });
  const chips = h('div', { class: 'chips', role: 'group', 'aria-label': 'Status' });
  const table = h('table', { class: 'runs' });
  const more = h('button', { type: 'button', class: 'more', onclick: () => { ui.drawn += STEP * 4; body(); } });
  const compare = h('a', { class: 'button', 'aria-disabled': 'true' }, 'Compare');
  const columns = h('details', { class: 'menu' }, h('summary', { class: 'button' }, 'Columns'), h('div', { class: 'panel' }));
  const filter = h('input', {
    type: 'search', id: 'filter', spellcheck: false, autocomplete: 'off', placeholder: 'memory=gru stream.MPJPE<6.3, or words',
    oninput: () => { remember({ filter: filter.value }); ui.drawn = STEP; draw(); },
  });
  const kind = h('select', { 'aria-label': 'Kind of runs', onchange: () => { remember({ kind: kind.value === 'memmlp' ? '' : kind.value || 'all' }); draw(); } },
    KINDS.map(([value, text]) => h('option', { value }, text)));
  const scroll = h('div', { class: 'scroll tall' }, table);
  const nothing = h('div');

  for (const id of (place().query.get('sel') ?? '').split(',').filter(Boolean)) chosen.add(id);
  new IntersectionObserver(([entry]) => { if (entry.isIntersecting && !more.hidden) more.click(); }, { root: scroll, rootMargin: '600px' }).observe(more);
  scroll.append(more);
  addEventListener('click', outside);

  function outside(event) {
    if (columns.open && !columns.contains(event.target)) columns.open = false;
  }

  function settings() {
    const { query } = place();
    return { text: query.get('filter') ?? '', sort: query.get('sort') ?? '-started', status: query.get('status') ?? '',
      kind: query.get('kind') === 'all' ? '' : query.get('kind') ?? 'memmlp', cols: query.get('cols') };
  }

  function draw() {
    const set = settings();
    const began = performance.now();
    if (filter.value !== set.text) filter.value = set.text;
    kind.value = set.kind;
    const tests = parse(set.text);
    const every = [...runs.values()].filter(run => !set.kind || run.kind === set.kind || (run.damage.length && !run.kind));
    const found = every.filter(run => matches(tests, run));
    ui.list = set.status ? found.filter(run => run.status === set.status) : found;
    ui.auto = differing(ui.list, about.keys);
    const asked = set.cols === null ? null : set.cols.split('|').filter(Boolean);
    const some = METRICS.filter(name => ui.list.some(run => typeof run.metrics[name] === 'number'));
    const groups = [ui.auto.slice(0, AUTO), set.kind === 'vqvae' ? vqvae() : some];
    ui.columns = asked ?? (NARROW.matches ? groups.reverse() : groups).flat();
    ui.list = sorted(ui.list, set.sort);
    states(found, set.status);
    bests(ui.list);
    head(set.sort);
    body();
    menu();
    selection();
    replace(counted, `${number(ui.list.length)} of ${number(runs.size)} runs`);
    document.documentElement.dataset.filtered = String(Math.round(performance.now() - began));
    scroll.hidden = !ui.list.length;
    best.hidden = !ui.list.length;
    replace(nothing, ui.list.length ? null : runs.size ? none(set) : begin());
  }

  const vqvae = () => about.metrics.filter(name => name.startsWith('vqvae.')).slice(0, 5);

  function none(set) {
    const clear = () => { remember({ filter: '', status: '', kind: 'all' }); draw(); };
    return empty('No run fits.', h('p', {}, 'Filter: ', code(set.text || set.status || 'kind')), h('button', { type: 'button', onclick: clear }, 'Show all runs'));
  }

  function begin() {
    return empty('There are no runs yet.', h('p', {}, 'They appear here as soon as one begins:'), h('pre', {}, 'memmlp demo\nmemmlp train data=synth profile=tiny'),
      h('p', { class: 'faint' }, `Looked at: ${about.outputs}/runs`));
  }

  function states(found, status) {
    const count = name => found.filter(run => run.status === name).length;
    const known = STATES.filter(name => count(name) || name === status);
    replace(chips, [['', 'all', found.length], ...known.map(name => [name, STATE_WORDS[name] ?? name, count(name)])].map(([name, text, many]) =>
      h('button', { type: 'button', class: `chip ${name}`, 'aria-pressed': String(name === status), onclick: () => { remember({ status: name }); draw(); } }, text, h('b', {}, number(many)))));
  }

  function bests(list) {
    const metric = ui.columns.find(name => name.startsWith('stream.')) ?? METRICS[0];
    const known = list.filter(run => FINISHED.includes(run.status) && typeof run.metrics[metric] === 'number');
    const value = bestOf(metric, known.map(run => run.metrics[metric]));
    const first = known.find(run => run.metrics[metric] === value);
    best.hidden = !first;
    ui.sets = [...new Set(list.filter(run => FINISHED.includes(run.status)).map(run => run.data))];
    if (ui.sets.length > 1) {
      const chosen = data => { remember({ filter: `${place().query.get('filter') ?? ''} data=${data}`.trim() }); draw(); };
      replace(best, `Of ${ui.sets.length} data sets, whose errors do not compare: `, ui.sets.slice(0, 5).map(data => h('button', { type: 'button', class: 'small', onclick: () => chosen(data) }, dataName(data) || 'unknown', ' ', h('small', {}, number(list.filter(run => run.data === data).length)))));
      return;
    }
    if (first) replace(best, 'Best of these by ', metricText(metric), ': ', link(address('run', first.id), nameOf(first)), ' ', h('b', {}, metricNumber(metric, first.metrics[metric])), ' · ', link(address('run', first.id, { part: 'replay' }), 'its worst second'));
  }

  function head(sort) {
    const short = shortKeys(ui.columns.filter(name => about.keys.includes(name)));
    const cell = (name, content, more = {}) => {
      const way = sort === name ? 'ascending' : sort === `-${name}` ? 'descending' : 'none';
      const turn = () => { remember({ sort: way === 'ascending' ? `-${name}` : way === 'descending' || !startsDown(name) ? name : `-${name}` }); draw(); };
      return h('th', { scope: 'col', 'aria-sort': way === 'none' ? null : way, ...more }, h('button', { type: 'button', onclick: turn }, content));
    };
    const metric = name => {
      const { metric, where, unit } = metricWords(name);
      return cell(name, [h('span', {}, metric), h('small', {}, [where, unit].filter(Boolean).join(', '))], { class: 'n', title: name });
    };
    const all = h('input', { type: 'checkbox', 'aria-label': 'Choose all runs shown', onchange: event => {
      for (const run of ui.list.slice(0, ui.drawn)) event.target.checked ? chosen.add(run.id) : chosen.delete(run.id);
      body(); selection();
    } });
    const heads = ui.columns.map(name => (about.keys.includes(name) ? cell(name, short.get(name), { title: name }) : metric(name)));
    replace(table.tHead ?? table.createTHead(), h('tr', {}, h('th', { scope: 'col', class: 'pick' }, all), cell('name', 'run'), cell('status', 'status'), heads, cell('started', 'started', { class: 'n' }), cell('seconds', 'took', { class: 'n' })));
  }

  const startsDown = name => name === 'started' || name === 'seconds' || better(name) === 'higher';

  function body() {
    const known = {};
    for (const name of ui.columns.filter(one => about.metrics.includes(one))) {
      const values = ui.list.map(run => run.metrics[name]).filter(value => typeof value === 'number');
      if (values.length > 1 && ui.sets.length < 2) known[name] = bestOf(name, values);
    }
    const focused = document.activeElement?.dataset?.run;
    const shown = ui.list.slice(0, ui.drawn);
    const rows = h('tbody', {}, shown.map(run => line(run, known)));
    table.tBodies[0] ? table.tBodies[0].replaceWith(rows) : table.append(rows);
    if (focused) rows.querySelector(`[data-run="${CSS.escape(focused)}"]`)?.focus();
    more.hidden = shown.length >= ui.list.length;
    more.textContent = `${number(ui.list.length - shown.length)} more`;
  }

  function line(run, known) {
    const pick = h('input', { type: 'checkbox', checked: chosen.has(run.id), 'data-run': run.id, 'aria-label': `Choose ${nameOf(run)}, ${run.id}`, onchange: event => {
      event.target.checked ? chosen.add(run.id) : chosen.delete(run.id);
      selection();
    } });
    const cell = name => {
      if (about.keys.includes(name)) return h('td', { class: typeof run.config[name] === 'number' ? 'value' : 'value' }, word(run.config[name]));
      const value = run.metrics[name];
      return h('td', { class: value !== undefined && value === known[name] ? 'n least' : 'n' }, typeof value === 'number' ? metricNumber(name, value) : h('span', { class: 'faint' }, DASH));
    };
    return h('tr', { class: chosen.has(run.id) ? 'chosen' : null },
      h('td', { class: 'pick' }, pick),
      h('th', { scope: 'row' }, link(address('run', run.id), nameOf(run)), h('span', { class: 'id' }, run.id.slice(0, 8)), tags(run), run.remark && h('span', { class: 'tag', title: run.remark }, 'hardly trained'), run.note && h('span', { class: 'note', title: run.note }, run.note)),
      h('td', {}, status(run)), ui.columns.map(cell),
      h('td', { class: 'n faint', title: date(run.started) }, ago(run.started)), h('td', { class: 'n faint' }, duration(run.seconds)));
  }

  function menu() {
    const box = (name, text) => h('label', { title: name }, h('input', { type: 'checkbox', checked: ui.columns.includes(name), onchange: event => {
      const next = event.target.checked ? [...ui.columns, name] : ui.columns.filter(one => one !== name);
      const order = [...ui.auto, ...about.keys, ...about.metrics];
      remember({ cols: [...new Set(next)].sort((a, b) => order.indexOf(a) - order.indexOf(b)).join('|') });
      draw();
    } }), text);
    const panel = columns.querySelector('.panel');
    const top = panel.scrollTop;
    const rest = about.keys.filter(key => !ui.auto.includes(key));
    replace(panel, h('button', { type: 'button', onclick: () => { remember({ cols: '' }); const { query } = place(); query.delete('cols'); draw(); } }, 'As found'),
      h('h3', {}, 'They differ in'), ui.auto.map(key => box(key, key)), rest.length ? h('h3', {}, 'Other keys') : null, rest.map(key => box(key, key)), h('h3', {}, 'Measured'), about.metrics.map(name => box(name, metricText(name))));
    panel.scrollTop = top;
  }

  function selection() {
    const known = [...chosen].filter(id => runs.has(id));
    remember({ sel: known.slice(0, 60).join(',') });
    const ids = known.length ? known : [];
    compare.textContent = ids.length ? `Compare ${ids.length}` : 'Compare';
    compare.setAttribute('aria-disabled', String(!ids.length));
    compare.title = ids.length ? '' : 'Choose runs in the first column';
    if (ids.length) compare.setAttribute('href', address('compare', '', { runs: ids.slice(0, 60).join(',') }));
    else compare.removeAttribute('href');
    for (const row of table.tBodies[0]?.rows ?? []) row.classList.toggle('chosen', chosen.has(row.querySelector('input').dataset.run));
  }

  const element = h('div', { class: 'page wide' },
    h('div', { class: 'bar' }, h('h1', {}, 'Runs'), counted, h('label', { class: 'search' }, h('span', { class: 'hidden' }, 'Filter of runs'), filter), kind, columns, compare),
    h('div', { class: 'bar' }, chips, best), scroll, nothing);
  draw();
  return { title: 'Runs', element, update: () => { draw(); say(`${ui.list.length} runs`); }, close: () => removeEventListener('click', outside) };
}

export function tags(run) {
  return run.tags.map(tag => h('span', { class: 'tag' }, tag));
}

// The state of a run in words; of one that trains, how far it is.
export function status(run) {
  if (run.damage.length) return h('span', { class: 'state damaged', title: `cannot be read: ${run.damage.join(', ')}` }, 'damaged');
  const [last] = run.recent?.slice(-1) ?? [];
  if (run.status !== 'training' || !last || !run.steps) return state(run.status, run.failure);
  const [first] = run.recent;
  const pace = run.recent.length > 1 && last[0] > first[0] ? (last[1] - first[1]) / (last[0] - first[0]) : null;
  const share = Math.min(last[0] / run.steps, 1);
  const left = share < 1 && pace ? `${duration((run.steps - last[0]) * pace)} left` : '';
  return h('span', { class: 'state running' }, h('progress', { value: share, max: 1, 'aria-label': `${Math.floor(100 * share)} % trained` }), h('span', {}, `${Math.floor(100 * share)} %`), h('small', {}, left));
}

function sorted(list, sort) {
  const down = sort.startsWith('-');
  const name = down ? sort.slice(1) : sort;
  const of = run => (name in run && typeof run[name] !== 'object' ? run[name] : run.config[name] ?? run.metrics[name]);
  const missing = value => value === null || value === undefined || value === '';
  return [...list].sort((one, other) => {
    const [a, b] = [of(one), of(other)];
    if (missing(a) || missing(b)) return Number(missing(a)) - Number(missing(b)) || (one.id < other.id ? -1 : 1);
    const order = typeof a === 'number' && typeof b === 'number' ? a - b : String(a).localeCompare(String(b), undefined, { numeric: true });
    return (down ? -order : order) || (one.id < other.id ? -1 : 1);
  });
}
