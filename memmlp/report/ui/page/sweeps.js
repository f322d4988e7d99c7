// Sweeps: their progress, their effects and tables beside the paper's, and curves by variant.

import { cards, h, replace, link, section, empty, table, select } from './dom.js';
import { address, ask, generated, inFile, nameOf, place, remember, runs } from './store.js';
import { button, canChange, change, command, dialog } from './actions.js';
import { curvePanel } from './curves.js';
import { colourOf, forest, frontier } from './charts.js';
import { ACTIVE, look, state, STATE_WORDS } from './state.js';
import { DASH, decimals, duration, effectDigits, metricNumber, metricText, number, signed } from './format.js';

const ORDER = ['done', ...ACTIVE, 'trained', 'lost', 'stopped', 'interrupted', 'new', 'failed', 'damaged', 'blocked'];

export async function page() {
  const element = h('div', { class: 'page' });
  async function update() {
    const { sweeps, damaged } = await ask('sweeps');
    const warnings = Object.entries(damaged).map(([name, why]) => h('p', { class: 'warning' }, h('b', {}, `${name}: `), why));
    replace(element, cards('Sweeps', sweeps.map(sweep => [address('sweep', sweep.name), sweep.title, `${sweep.name} · ${sweep.variants} variants × ${sweep.seeds} seeds`, progress(sweep)]), noSweeps()), warnings);
  }
  await update();
  return { title: 'Sweeps', element, update };
}

const noSweeps = () => empty('There are no sweeps yet.', h('p', {}, 'Start a sweep of the paper, or a custom one:'), command('memmlp sweep 14 data=mocap data.root=FOLDER'), command('memmlp sweep mine.yaml --workers 2'));

function progress(sweep) {
  const words = counts => ORDER.filter(name => counts[name]).map(name => `${counts[name]} ${STATE_WORDS[name] ?? name}`).join(', ');
  const missing = sweep.counts.trained ? ' (trained: an evaluation or export is missing)' : '';
  const before = words(sweep.prerequisite_counts);
  const text = `${words(sweep.counts)}${missing}${before ? `; prerequisites: ${before}` : ''}`;
  const remaining = sweep.remaining === null ? '' : ` · about ${duration(sweep.remaining)} remaining`;
  return h('span', {}, h('progress', { value: sweep.share, max: 1, 'aria-label': 'done' }), ` ${Math.floor(100 * sweep.share)} %${sweep.wanted > sweep.seeds ? ` of ${sweep.seeds} of ${sweep.wanted} seeds, this round’s` : ''} `, h('small', {}, `${text}${remaining}`));
}

export async function single(name) {
  let sweep = await ask(`sweeps/${name}`);
  const ids = [...new Set(sweep.cells.map(cell => cell.id))].filter(id => runs.has(id));
  const variants = new Map(sweep.cells.map(cell => [cell.id, cell.variant]));
  const panel = curvePanel(ids, [['variant', 'variant', id => variants.get(id), coloursOf(sweep.table)], ['run', 'run', id => (runs.has(id) ? nameOf(runs.get(id)) : id)]]);
  const top = h('div');
  const element = h('div', { class: 'page' }, top, ids.length ? section('Curves by variant', panel.element) : null, notes(sweep.table));
  function draw() {
    replace(top, h('p', { class: 'trail' }, link('#/sweeps', 'Sweeps')), h('div', { class: 'bar' }, h('h1', {}, sweep.table.caption)),
      sweep.name === sweep.table.caption ? null : h('p', { class: 'faint' }, sweep.name), sweep.counts.done === sweep.tasks && sweep.wanted <= sweep.seeds ? null : progress(sweep), again(sweep), sweep.cells.length ? board(sweep) : null,
      effects(sweep.table, draw), frontiers(sweep.table), section('Table', results(sweep.table)), sweep.rounds ? rounds(sweep.rounds) : null);
  }
  async function update() {
    if (!inFile) sweep = await ask(`sweeps/${name}`);
    draw();
    await panel.update();
  }
  draw();
  await panel.update();
  return { title: sweep.title, element, update };
}

// The command of a sweep, and buttons for its unfinished runs.
function again(sweep) {
  const ids = states => sweep.cells.filter(cell => states.includes(cell.state)).map(cell => cell.id);
  const [going, waiting] = [ids([...ACTIVE, 'new', 'interrupted', 'lost', 'trained']), ids(['failed', 'stopped', 'damaged'])];
  const send = (action, list) => change({ action, runs: list }).catch(error => dialog('Not done', { lines: [error.message], word: 'Close', act: () => {} }));
  const open = document.querySelector('details.again')?.open; // before it is drawn again
  return h('details', { class: 'again', open }, h('summary', {}, 'Command'), command(sweep.command),
    canChange() ? h('div', { class: 'chips' }, going.length ? select('Prioritise a variant', [['', 'choose'], ...[...new Set(sweep.cells.filter(cell => going.includes(cell.id)).map(cell => cell.variant))].map(one => [one, one])], '', one => one && send('prioritize', sweep.cells.filter(cell => cell.variant === one && going.includes(cell.id)).map(cell => cell.id))) : null, going.length ? button(`Stop ${going.length} unfinished`, () => send('stop', going)) : null, waiting.length ? button(`Retry ${waiting.length} stopped or failed`, () => send('retry', waiting), 'Its workers continue them; without workers, repeat the command') : null) : null);
}

// The tables of all sweeps below each other.
export async function tables() {
  const { sweeps } = await ask('sweeps');
  const pages = await Promise.all(sweeps.map(sweep => ask(`sweeps/${sweep.name}`)));
  const part = one => {
    const own = h('section', { id: `table-${one.name}` });
    const draw = () => replace(own, h('h2', {}, link(address('sweep', one.name), one.table.caption)), results(one.table), effects(one.table, draw, 'h3'), notes(one.table, 'h3'));
    draw();
    return own;
  };
  const element = h('div', { class: 'page' }, h('h1', {}, 'Tables'), generated ? h('p', { class: 'faint' }, generated) : null,
    pages.length ? pages.map(part) : noSweeps());
  return { title: 'Tables', element };
}

function notes(found, head = 'h2') {
  const lines = [...found.flags, ...found.legend, ...found.notes];
  return lines.length ? h('section', {}, h(head, {}, 'How to read it'), h('ul', { class: 'remarks' }, lines.map(line => h('li', {}, line)))) : null;
}

function board(sweep) {
  const variants = [...new Set(sweep.cells.map(cell => cell.variant))];
  const seeds = [...new Set(sweep.cells.map(cell => cell.seed))].sort((a, b) => a - b);
  const draw = cell => {
    if (!cell) return DASH;
    const share = cell.state === 'training' && cell.steps ? Math.min(cell.step / cell.steps, 1) : null;
    let text = state(cell.state, cell.failure || undefined);
    if (cell.state === 'done') text = typeof cell.value === 'number' ? h('b', {}, metricNumber(sweep.metric, cell.value)) : 'done';
    else if (share !== null) text = [h('progress', { value: share, max: 1, 'aria-label': 'trained' }), ` ${Math.floor(100 * share)} %`];
    return h('td', { class: `n cell ${look(cell.state)}` }, runs.has(cell.id) ? link(address('run', cell.id), text) : text);
  };
  const at = (variant, seed) => sweep.cells.find(cell => cell.variant === variant && cell.seed === seed);
  const failures = sweep.cells.filter(cell => cell.failure).map(cell => h('p', { class: 'warning' }, h('b', {}, `${cell.variant}, seed ${cell.seed}: `), cell.failure));
  const before = sweep.prerequisites.map(task => h('li', {}, runs.has(task.id) ? link(address('run', task.id), task.name) : task.name, ' ', state(task.state)));
  return section('Runs', h('p', { class: 'faint' }, `${metricText(sweep.metric)}, stream mode${sweep.branch ? `, ${sweep.branch} branch` : ''}.`),
    table(['variant', ...seeds.map(seed => `seed ${seed}`)], variants.map(variant => [variant, ...seeds.map(seed => draw(at(variant, seed)))])),
    before.length ? h('details', {}, h('summary', {}, `${before.length} prerequisite run${before.length > 1 ? 's' : ''}`), h('ul', { class: 'remarks' }, before)) : null, failures);
}

// A difference with its interval, verdict and the paper's difference, in words.
function effectWords(cell) {
  const effect = cell.effect;
  const paper = (cell.paper_effect ?? null) === null ? '' : `; the paper: ${signed(cell.paper_effect)}`;
  if (!effect) return `not measured${paper}`;
  const digits = effectDigits({ ...effect, value: cell.mean });
  const interval = effect.low === null ? '' : ` [${signed(effect.low, digits)}, ${signed(effect.high, digits)}]`;
  return `${signed(effect.mean, digits)}${interval}${effect.verdict ? `, ${effect.verdict}` : ''}${effect.decided ? ` at ${effect.decided} seeds` : ''}${paper}`;
}

function effects(found, draw, head = 'h2') {
  const { query } = place();
  const mode = found.modes.includes(query.get('mode')) ? query.get('mode') : found.modes[0];
  const tested = found.metrics.filter(metric => found.rows.some(row => row.cells[mode]?.[metric]?.effect));
  if (!tested.length) return h('section', {}, h(head, {}, 'Effects'), h('p', { class: 'faint' }, 'They appear when a variant and its control have a finished run of the same seed.'));
  const metric = tested.includes(query.get('metric')) ? query.get('metric') : tested[0];
  const rows = found.rows.map(row => [row.label, row.cells[mode]?.[metric], row.found.length < 2]).filter(([, cell]) => cell?.effect || (cell?.paper_effect ?? null) !== null).map(([variant, cell, single]) => ({
    variant, single, mean: null, low: null, high: null, ...cell.effect, paper: cell.paper_effect ?? null, significant: significant(cell.effect), words: effectWords(cell),
  }));
  const choose = changes => { remember(changes); draw(); };
  const note = [`Difference from ‘${found.control}’, or from the variant’s own control, with its 95 % interval over seeds and clips.`, { lower: ' Left is better.', higher: ' Right is better.' }[found.better[metric]]];
  return h('section', {}, h(head, {}, 'Effects'),
    h('div', { class: 'tools' }, select('Metric', tested.map(one => [one, one]), metric, value => choose({ metric: value })), found.modes.length > 1 ? select('Mode', found.modes.map(one => [one, one]), mode, value => choose({ mode: value })) : null),
    h('p', { class: 'faint' }, note), forest(rows, { label: found.headings[metric].replace(/ ↓| ↑/, ''), smallest: found.smallest[metric] }));
}

// One colour for each network on all charts of a page.
const coloursOf = found => colourOf(new Set([...found.rows.map(row => row.series), ...found.rows.map(row => row.label)]));

// Error against training compute and live latency, where the training compute is known and differs.
const COSTS = [['parameters', 'parameters [M]'], ['MACs', 'MACs [G]'], ['tflop', 'training [TFLOP]'], ['seconds', 'training [s]'], ['ms', 'step [ms]']];
function frontiers(found) {
  const known = found.rows.map(row => row.costs?.tflop).filter(value => value !== undefined);
  if (known.length < 2 || Math.max(...known) <= 1.1 * Math.min(...known)) return null;
  const mode = found.modes[0];
  const metric = found.metrics.find(one => one === 'MPJPE') ?? found.metrics[0];
  const points = cost => found.rows.filter(row => row.costs[cost] !== undefined && row.cells[mode][metric].mean !== null)
    .map(row => ({ series: row.series, variant: row.label, cost: row.costs[cost], ...row.cells[mode][metric] })).sort((a, b) => a.cost - b.cost);
  const chart = (cost, x) => frontier(points(cost), { x, colours: coloursOf(found), y: found.headings[metric].replace(/ ↓| ↑/, '') });
  const digits = value => (value === undefined ? DASH : number(Number(value.toPrecision(3))));
  return section('Frontiers', h('p', { class: 'faint' }, 'Error with its 95 % interval over seeds and clip groups; one curve for each network.'),
    h('div', { class: 'pair' }, chart('tflop', 'training compute [TFLOP]'), chart('ms', 'live latency of a step [ms]')),
    table(['variant', ...COSTS.map(([, head]) => head)], found.rows.filter(row => row.found.length).map(row => [row.label, ...COSTS.map(([cost]) => digits(row.costs[cost]))])));
}

const significant = effect => Boolean(effect) && effect.holm !== null && effect.holm < effect.level;

const VERDICTS = { holds: 'Significant, with the paper’s sign', opposite: 'Significant, with the other sign than the paper’s', higher: 'Significant', lower: 'Significant', equivalent: 'Nearer to 0 than the smallest effect of interest',
  inconclusive: 'Not decided: p is above the level, and the interval reaches beyond the smallest effect of interest; more seeds or persons may decide' };
const verdictTitle = ({ verdict, holm, level }) => (verdict ? `${VERDICTS[verdict]} (${holm === null ? '' : `p ${number(Number(holm.toPrecision(2)))}, `}level ${number(Number(level.toPrecision(2)))}).` : '');

// Seeds spent in rounds: what each interim analysis decided, and the progress of each variant.
function rounds(found) {
  const decided = found.variants.reduce((sum, one) => sum + one.decided, 0);
  const percent = level => `${number(Number((100 * level).toPrecision(2)))} %`;
  return section('Rounds', h('p', { class: 'faint' }, `Seeds were added where verdicts were inconclusive: ${decided} of ${found.comparisons} comparisons are decided. What an interim analysis decides is final; together they spend 5 %.`),
    h('div', { class: 'pair' },
      table(['analysis at', 'spends', 'compared', 'decided'], found.analyses.map(one => [`${one.seeds} seeds`, percent(one.level), ...(one.compared ? [number(one.compared), number(one.decided)] : [DASH, DASH])])),
      table(['variant', 'decided', 'inconclusive', 'seeds', 'next'], found.variants.map(one => [one.label, number(one.decided), number(one.inconclusive), number(one.seeds), one.next ? `analysis at ${one.next}` : DASH]))));
}

function results(found) {
  const row = (one, mode) => [[one.confounded ? `${one.label} ‡` : one.label, found.rows.some(other => other.against === one.label) && h('small', { class: 'faint' }, 'control')], one.wanted.length ? `${one.found.length}/${one.wanted.length}` : 'paper', ...found.metrics.map(metric => h('td', { class: 'n' }, cell(one.cells[mode][metric], metric), otherBranches(one, mode, metric)))];
  const heads = ['variant', 'seeds', ...found.metrics.map(metric => found.headings[metric])];
  return h('div', { class: 'stack' }, found.modes.map(mode => table(heads, found.rows.map(one => row(one, mode)), { kind: 'effects', scroll: 'scroll', file: `${found.name}-${mode}`, caption: found.modes.length > 1 ? `${mode} mode` : null })));
}

// Differences and verdicts with variant and control in another branch than the row's.
function otherBranches(row, mode, metric) {
  const lines = Object.entries(row.branches ?? {}).map(([branch, modes]) => [branch, modes[mode]?.[metric]]).filter(([, effect]) => effect);
  const digits = effect => effectDigits({ ...effect, value: row.cells[mode][metric].mean });
  return lines.map(([branch, effect]) => h('small', { class: 'faint branch', title: `Variant and control in the ${branch} branch. ${verdictTitle(effect)}` }, `${branch} ${signed(effect.mean, digits(effect))}${effect.verdict ? ` ${effect.verdict}` : ''}`));
}

function cell({ mean, sd, effect, paper, paper_effect: paperEffect, counted, clips }, metric) {
  const digits = effectDigits({ ...effect, value: mean });
  return [
    h('span', { class: 'strong' }, mean === null ? DASH : metricNumber(metric, mean), sd === null ? null : h('small', { class: 'faint' }, ` ± ${number(sd, mean >= 1000 ? 0 : decimals(mean))}`), counted < clips ? h('small', { class: 'faint' }, ` (${counted} of ${clips} clips)`) : null),
    effect && h('span', { class: significant(effect) ? 'strong' : '' }, signed(effect.mean, digits), effect.low === null ? null : h('small', { class: 'faint' }, ` [${signed(effect.low, digits)}, ${signed(effect.high, digits)}]`)),
    effect?.verdict && [h('span', { class: `verdict ${effect.verdict}`, title: verdictTitle(effect) }, effect.verdict), effect.decided ? h('small', { class: 'faint' }, `at ${effect.decided} seeds`) : null,
      effect.holm === null || !(effect.groups <= 30) ? null : h('small', { class: 'faint' }, ` p ${number(Number(effect.holm.toPrecision(2)))}`),
      effect.bootstrap == null ? null : h('small', { class: 'faint', title: 'The same p by a bootstrap, as a check; the verdict does not use it' }, ` bootstrap ${number(Number(effect.bootstrap.toPrecision(2)))}`)],
    paper !== null && h('small', { class: 'faint' }, `paper ${number(paper)}`, paperEffect === null ? null : ` (${signed(paperEffect)})`),
  ];
}
