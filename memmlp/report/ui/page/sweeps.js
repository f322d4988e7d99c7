// Sweeps: how far they are, what they found, and curves by arm.

import { h, replace, link, section, empty, choice, select } from './dom.js';
import { address, alone, ask, nameOf, place, remember, runs } from './store.js';
import { curvePanel } from './compare.js';
import { forest } from './charts.js';
import { AT_WORK, look, state, STATE_WORDS } from './runs.js';
import { DASH, decimals, duration, effectDigits, metricNumber, metricText, number, signed } from './format.js';

const ORDER = ['done', ...AT_WORK, 'trained', 'lost', 'stopped', 'new', 'failed', 'blocked'];

export async function page() {
  const element = h('div', { class: 'page' });
  async function update() {
    const found = await ask('sweeps');
    const damaged = Object.entries(found.damaged ?? {}).map(([name, why]) => h('p', { class: 'warning' }, h('b', {}, `${name}: `), why));
    const list = found.sweeps.map(sweep => h('li', {}, h('a', { class: 'card', href: address('sweep', sweep.name) },
      h('span', { class: 'card-title' }, sweep.title), h('span', { class: 'faint' }, `${sweep.name} · ${sweep.arms} arms × ${sweep.seeds} seeds`), progress(sweep))));
    replace(element, h('div', { class: 'bar' }, h('h1', {}, 'Sweeps'), h('p', { class: 'count' }, number(found.sweeps.length))), damaged,
      list.length ? h('ul', { class: 'cards' }, list) : empty('There are no sweeps yet.', h('p', {}, 'A sweep of the paper, or of your own:'), h('pre', {}, 'memmlp sweep 14 data=mocap data.root=FOLDER\nmemmlp sweep mine.yaml --workers 2')));
  }
  await update();
  return { title: 'Sweeps', element, update };
}

function progress(sweep) {
  const parts = ORDER.filter(name => sweep.counts[name]).map(name => h('i', { class: look(name), style: `flex-grow:${sweep.counts[name]}` }));
  const told = counts => ORDER.filter(name => counts[name]).map(name => `${counts[name]} ${STATE_WORDS[name] ?? name}`).join(', ');
  const above = told(sweep.above);
  const missing = sweep.counts.trained ? ' (trained: an evaluation or export is missing)' : '';
  const words = `${told(sweep.counts)}${missing}${above ? `; what they build upon: ${above}` : ''}`;
  const left = sweep.left === null ? '' : ` · about ${duration(sweep.left)} of training left`;
  return h('span', { class: 'sweep-progress' }, h('span', { class: 'segments', role: 'img', 'aria-label': words }, parts), h('span', { class: 'n' }, `${Math.floor(100 * sweep.share)} %`), h('small', { class: 'faint' }, `${words}${left}`));
}

export async function single(name) {
  let sweep = await ask(`sweeps/${name}`);
  const ids = [...new Set(sweep.cells.map(cell => cell.id))].filter(id => runs.has(id));
  const arm = new Map(sweep.cells.map(cell => [cell.id, cell.arm]));
  const panel = curvePanel(ids, [['arm', 'arm', id => arm.get(id)], ['run', 'run', id => runs.has(id) ? nameOf(runs.get(id)) : id]], { most: 2 });
  const top = h('div');
  const found = h('div');
  const element = h('div', { class: 'page' }, top, found, section('Curves by arm', panel.element), notes());
  function notes() {
    const lines = [...sweep.table.flags, ...sweep.table.legend, ...sweep.table.notes];
    return section('How to read it', h('ul', { class: 'remarks' }, lines.map(line => h('li', {}, line))));
  }
  function draw() {
    const running = sweep.counts.done === sweep.tasks ? null : progress(sweep);
    replace(top, h('p', { class: 'trail' }, link('#/sweeps', 'Sweeps')), h('div', { class: 'bar title' }, h('h1', {}, sweep.table.caption)),
      sweep.name === sweep.table.caption ? null : h('p', { class: 'faint sub' }, sweep.name), running, board(sweep));
    replace(found, effects(sweep.table, draw), section('Table', results(sweep.table)), sweep.rounds ? rounds(sweep.rounds) : null);
  }
  async function update() {
    if (!alone) sweep = await ask(`sweeps/${name}`);
    draw();
    await panel.update();
  }
  draw();
  await panel.update();
  return { title: sweep.title, element, update };
}

function board(sweep) {
  const arms = [...new Set(sweep.cells.map(cell => cell.arm))];
  const seeds = [...new Set(sweep.cells.map(cell => cell.seed))].sort((a, b) => a - b);
  const at = (arm, seed) => sweep.cells.find(cell => cell.arm === arm && cell.seed === seed);
  const words = cell => {
    if (!cell) return h('td', { class: 'n faint' }, DASH);
    const share = cell.state === 'training' && cell.steps ? Math.min(cell.step / cell.steps, 1) : null;
    const text = cell.state === 'done' ? (typeof cell.value === 'number' ? h('b', {}, metricNumber(sweep.metric, cell.value)) : 'done') : share === null ? state(cell.state, cell.failure || undefined) : [h('progress', { value: share, max: 1, 'aria-label': 'trained' }), ` ${Math.floor(100 * share)} %`];
    return h('td', { class: `n cell ${look(cell.state)}` }, runs.has(cell.id) ? link(address('run', cell.id), text) : text);
  };
  const failed = sweep.cells.filter(cell => cell.failure).map(cell => h('p', { class: 'warning' }, h('b', {}, `${cell.arm}, seed ${cell.seed}: `), cell.failure));
  const above = sweep.upstream.map(task => h('li', {}, runs.has(task.id) ? link(address('run', task.id), task.name) : task.name, ' ', state(task.state)));
  return section('Runs', h('p', { class: 'faint' }, `${metricText(sweep.metric)}, stream mode${sweep.branch ? `, ${sweep.branch} branch` : ''}.`), h('div', { class: 'scroll short' }, h('table', { class: 'grid' },
    h('thead', {}, h('tr', {}, h('th', { scope: 'col' }, 'arm'), seeds.map(seed => h('th', { scope: 'col', class: 'n' }, `seed ${seed}`)))),
    h('tbody', {}, arms.map(arm => h('tr', {}, h('th', { scope: 'row' }, arm), seeds.map(seed => words(at(arm, seed)))))))),
    above.length ? h('details', {}, h('summary', {}, `${above.length} runs that they build upon`), h('ul', { class: 'remarks' }, above)) : null, failed);
}

function effects(table, draw) {
  const { query } = place();
  const mode = table.modes.includes(query.get('mode')) ? query.get('mode') : table.modes[0];
  const tested = table.metrics.filter(metric => table.rows.some(row => row.cells[mode]?.[metric]?.effect));
  if (!tested.length) return section('Effects', h('p', { class: 'faint' }, 'They appear when an arm and its control have a finished run of the same seed.'));
  const metric = tested.includes(query.get('metric')) ? query.get('metric') : tested[0];
  const rows = table.rows.filter(row => row.cells[mode]?.[metric]?.effect || (row.cells[mode]?.[metric]?.paper_effect ?? null) !== null).map(row => {
    const cell = row.cells[mode][metric];
    const effect = cell.effect ?? {}, digits = effectDigits({ ...effect, value: cell.mean });
    const text = effect.mean === undefined ? 'not measured' : `${signed(effect.mean, digits)}${effect.low === null ? '' : ` [${signed(effect.low, digits)}, ${signed(effect.high, digits)}]`}${effect.verdict ? `, ${effect.verdict}` : ''}${effect.decided ? ` at ${effect.decided} seeds` : ''}`;
    const paper = cell.paper_effect === null ? '' : `; the paper: ${signed(cell.paper_effect)}`;
    return { arm: row.label, mean: effect.mean ?? null, low: effect.low ?? null, high: effect.high ?? null, paper: cell.paper_effect, verdict: effect.verdict, significant: effect.holm !== null && effect.holm < effect.level, words: text + paper };
  });
  const choose = changes => { remember(changes); draw(); };
  return section('Effects', h('div', { class: 'tools' }, choice('Metric', tested.map(one => [one, one]), metric, value => choose({ metric: value })), table.modes.length > 1 ? choice('Mode', table.modes.map(one => [one, one]), mode, value => choose({ mode: value })) : null),
    h('p', { class: 'faint' }, `Difference from ‘${table.control}’, or from the arm’s own control, with its 95 % interval over seeds and clips; filled where it is significant after Holm’s correction. `, rows.some(row => row.paper !== null) ? [h('span', { class: 'diamond' }, '◇'), ' the paper’s difference.'] : null, { lower: ' Left is better.', higher: ' Right is better.' }[table.better[metric]], ' The band is the smallest effect of interest.'),
    forest(rows, { label: table.headings[metric].replace(/ ↓| ↑/, ''), smallest: table.smallest[metric] }));
}

// Looks at a growing number of seeds: what each decided, and how far each arm is.
function rounds(about) {
  const percent = level => `${number(Number((100 * level).toPrecision(2)))} %`;
  const table = (heads, lines) => h('div', { class: 'scroll' }, h('table', { class: 'grid' },
    h('thead', {}, h('tr', {}, heads.map((head, i) => h('th', { scope: 'col', class: i ? 'n' : null }, head)))),
    h('tbody', {}, lines.map(([head, ...cells]) => h('tr', {}, h('th', { scope: 'row' }, head), cells.map(cell => h('td', { class: 'n' }, cell)))))));
  const decided = about.arms.reduce((sum, arm) => sum + arm.decided, 0);
  return section('Rounds', h('p', { class: 'faint' }, `Seeds were added where verdicts were inconclusive: ${decided} of ${about.comparisons} comparisons are decided. What a look decides is final; all looks together spend 5 %.`),
    h('div', { class: 'pair' },
      table(['look at', 'spends', 'compared', 'decided'], about.looks.map(look => [`${look.seeds} seeds`, percent(look.level), ...(look.compared ? [number(look.compared), number(look.decided)] : [DASH, DASH])])),
      table(['arm', 'decided', 'inconclusive', 'seeds', 'next'], about.arms.map(arm => [arm.label, number(arm.decided), number(arm.inconclusive), number(arm.seeds), arm.next ? `look at ${arm.next}` : DASH]))));
}

function results(table) {
  return h('div', { class: 'stack' }, table.modes.map(mode => {
    const head = h('thead', {}, h('tr', {}, h('th', { scope: 'col' }, 'arm'), h('th', { scope: 'col', class: 'n' }, 'seeds'), table.metrics.map(metric => h('th', { scope: 'col', class: 'n' }, table.headings[metric]))));
    const line = row => h('tr', {}, h('th', { scope: 'row' }, row.label), h('td', { class: 'n faint' }, row.wanted.length ? `${row.found.length}/${row.wanted.length}` : 'paper'), table.metrics.map(metric => cell(row.cells[mode][metric], metric)));
    return h('div', { class: 'scroll' }, h('table', { class: 'grid effects' }, table.modes.length > 1 ? h('caption', {}, `${mode} mode`) : null, head, h('tbody', {}, table.rows.map(line))));
  }));
}

function cell(one, metric) {
  const effect = one.effect, digits = effectDigits({ ...effect, value: one.mean });
  const lines = [h('span', { class: 'strong' }, one.mean === null ? DASH : metricNumber(metric, one.mean), one.sd === null ? null : h('small', { class: 'faint' }, ` ± ${number(one.sd, one.mean >= 1000 ? 0 : decimals(one.mean))}`))];
  if (effect) lines.push(h('span', { class: effect.holm !== null && effect.holm < effect.level ? 'strong' : '' }, signed(effect.mean, digits), effect.low === null ? null : h('small', { class: 'faint' }, ` [${signed(effect.low, digits)}, ${signed(effect.high, digits)}]`)));
  if (effect?.verdict) lines.push(h('span', { class: `verdict ${effect.verdict}` }, effect.verdict), effect.decided ? h('small', { class: 'faint' }, `at ${effect.decided} seeds`) : null);
  if (one.paper !== null) lines.push(h('small', { class: 'faint' }, `paper ${number(one.paper)}`, one.paper_effect === null ? null : ` (${signed(one.paper_effect)})`));
  return h('td', { class: 'n' }, lines);
}
