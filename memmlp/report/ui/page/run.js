// A run: results beside the control's, worst seconds in 3D, curves, clips, config, latency, files.

import { h, replace, link, section, select, table } from './dom.js';
import { address, ask, dataName, inFile, nameOf, place, remember, runs } from './store.js';
import { ago, ARROWS, better, bytes, DASH, date, duration, effectDigits, largestFirst, metricNumber, metricWords, number, signed, word } from './format.js';
import { buttons } from './actions.js';
import { curvePanel } from './curves.js';
import { status } from './now.js';
import { tags } from './runs.js';
import { FINISHED } from './state.js';

const METRICS = ['MPJPE', 'MPJRE', 'MPJVE', 'Jitter', 'Hand PE', 'Upper PE', 'Lower PE', 'Root PE', 'geodesic'];

export async function page(id) {
  let run = await ask(`run/${id}`);
  const top = h('div');
  const panel = curvePanel([id], [['run', 'run', () => nameOf(run)]]);
  const bottom = h('div');
  const replay = run.clips.length ? await replaySection(run) : null;
  const element = h('div', { class: 'page' }, top, replay?.element, section('Curves', panel.element), bottom);

  function draw() {
    replace(top, head(run), warnings(run), facts(run), results(run));
    replace(bottom, log(run), run.clips.length ? clips(run, replay) : null, config(run), latency(run), files(run));
    for (const lines of bottom.querySelectorAll('pre.log')) lines.scrollTop = lines.scrollHeight;
  }
  async function update() {
    const row = runs.get(id);
    if (inFile || (row?.signature === run.signature && row?.status === run.status)) return;
    run = await ask(`run/${id}`);
    draw();
    await panel.update();
  }
  draw();
  await panel.update();
  if (place().query.get('part') === 'replay') requestAnimationFrame(() => replay?.element.scrollIntoView());
  return { title: nameOf(run), element, update, close: () => replay?.close() };
}

// After a change of a run: its page is read again; that of a deleted run is gone.
const after = deleted => { if (deleted) location.hash = address('runs'); else dispatchEvent(new Event('hashchange')); };

function head(run) {
  const places = run.places.map(at => [' / ', at.sweep ? [link(address('sweep', at.sweep), at.sweep), ` · ${at.variant}, seed ${at.seed}`] : [link(address('search', at.search, { trial: at.trial }), at.search), ` · trial ${at.trial}`]]);
  return [
    h('p', { class: 'trail' }, link('#/runs', 'Runs'), places),
    h('div', { class: 'bar' }, h('h1', {}, nameOf(run)), status(runs.get(run.id) ?? run), tags(run), h('div', { class: 'picked' }, buttons([run.id], after))),
    run.note ? h('p', { class: 'remark' }, run.note) : null,
  ];
}

function warnings(run) {
  const lines = [
    ['Failed', run.failure], ['Damaged', run.damage.length && `${run.damage.join('; ')}.`], ['Its network', run.marks.errors && `${run.marks.errors}.`],
    ['Changed since it was made', run.changed.join(', ')],
    ['Measured by an earlier component version', run.outdated.length && `${run.outdated.join(', ')}. Measure it again with memmlp eval ${run.id}.`],
  ];
  const shown = lines.filter(([, text]) => text).map(([name, text]) => h('p', { class: 'warning' }, h('b', {}, `${name}: `), text));
  return shown.length ? h('div', { class: 'stack' }, shown) : null;
}

function facts(run) {
  return pairs([
    ['id', h('code', {}, run.id)], ['started', h('span', { title: ago(run.started) }, date(run.started))], ['took', duration(run.seconds)],
    ['data', h('code', {}, dataName(run.data) || '–')], ['device', run.device || '–'], ['code', h('code', {}, run.code || '–')],
    run.prerequisite && ['prerequisite', link(address('run', run.prerequisite), run.prerequisite.slice(0, 8))],
    run.control && ['control', [link(address('run', run.control.id), nameOf(run.control)), ' · ', link(address('compare', '', { runs: `${run.id},${run.control.id}` }), 'compare')]],
  ].filter(Boolean));
}

// Custom metrics come after the field's.
const ordered = names => [...new Set([...METRICS.filter(metric => names.includes(metric)), ...names.filter(name => !name.startsWith('GT '))])];

function results(run) {
  const own = Object.entries(run.metrics).filter(([name]) => name.startsWith('vqvae.'));
  const columns = [...new Set(Object.keys(run.metrics).map(name => name.split('.')).filter(parts => parts.length === 3).map(parts => `${parts[0]}.${parts[1]}`))].sort();
  if (!columns.length) return own.length ? section('Results', pairs(own.map(([name, value]) => [name.slice(6), number(value)]))) : null;
  const metrics = ordered(Object.keys(run.metrics).filter(name => columns.some(column => name.startsWith(`${column}.`))).map(name => name.split('.').at(-1)));
  const comparable = run.control?.data === run.data; // means over other test clips are not comparable
  const other = comparable ? runs.get(run.control.id)?.metrics : null;
  const cell = (column, metric) => {
    const value = run.metrics[`${column}.${metric}`];
    const before = other?.[`${column}.${metric}`];
    const part = run.partial[`${column}.${metric}`];
    const own = [metricNumber(metric, value), part ? h('small', { class: 'faint' }, ` (${part[0]} of ${part[1]} clips)`) : null];
    if (typeof value !== 'number' || typeof before !== 'number') return own;
    const change = value - before;
    const verdict = better(metric) && (change < 0 === (better(metric) === 'lower') ? 'better' : 'worse');
    return [own, h('small', { class: verdict }, signed(change, effectDigits({ mean: change, value })))];
  };
  const note = other ? ' Small: the difference from the control’s run of the same seed, which is not a verdict.' : run.control && !comparable ? ' The control has other data, so its difference is not shown.' : '';
  return section('Results', h('p', { class: 'faint' }, 'Means over the test clips; arrows show what is better.', note), table(
    ['', ...columns.map(column => [column.split('.')[0], h('small', {}, column.split('.')[1])])],
    metrics.map(metric => [[metric, h('small', {}, [metricWords(metric).unit, ARROWS[better(metric)]].filter(Boolean).join(' '))], ...columns.map(column => cell(column, metric))]), { scroll: 'scroll' }));
}

const error = (clip, mode) => clip[mode]?.rotation?.MPJPE;
const worstFirst = (run, mode) => [...run.clips].sort((a, b) => largestFirst(error(a, mode), error(b, mode)));
const modesOf = run => ['stream', 'window'].filter(mode => run.clips.some(clip => clip[mode]));

// The worst clips, one of which is replayed beside the truth and beside another run: the control's first, then the newest.
async function replaySection(run) {
  const { Replay } = await import('./replay.js');
  const others = [...runs.values()].filter(other => other.id !== run.id && FINISHED.includes(other.status) && other.kind === 'memmlp' && other.data === run.data)
    .sort((a, b) => Number(b.id === run.control?.id) - Number(a.id === run.control?.id) || b.started.localeCompare(a.started)).slice(0, 40);
  const frame = h('div', { class: 'replay-frame' });
  const tools = h('div', { class: 'tools' });
  const replay = new Replay(frame);
  const modes = modesOf(run);
  const { query } = place();
  const set = { clip: query.get('clip') ?? worstFirst(run, modes[0])[0]?.name, mode: query.get('mode') ?? modes[0], other: query.get('other') ?? others[0]?.id ?? '' };

  function draw() {
    replace(tools,
      select('Clip, worst first', worstFirst(run, set.mode).map(clip => [clip.name, `${clip.name} (${number(error(clip, set.mode), 1)} cm)`]), set.clip, clip => choose({ clip })),
      modes.length > 1 ? select('Mode', modes.map(mode => [mode, mode]), set.mode, mode => choose({ mode })) : null,
      others.length ? select('Beside', [['', 'no other run'], ...others.map(other => [other.id, `${nameOf(other)} (${other.id.slice(0, 6)})`])], set.other, other => choose({ other })) : null);
    return replay.show(run, set.clip, set.mode, runs.get(set.other));
  }
  function choose(changes) {
    Object.assign(set, changes);
    remember(set);
    return draw();
  }
  draw();
  const element = h('section', { id: 'replay' }, h('h2', {}, 'Worst seconds'), h('p', { class: 'faint' }, 'The network’s prediction for a test clip beside the truth, limbs coloured by their joints’ error. It starts at the worst second.'), tools, frame);
  return { element, choose, close: () => replay.close() };
}

function clips(run, replay) {
  const [mode] = modesOf(run);
  const value = (clip, metric) => clip[mode]?.rotation?.[metric];
  const metrics = ordered([...new Set(run.clips.flatMap(clip => Object.keys(clip[mode]?.rotation ?? {})))].filter(metric => run.clips.some(clip => typeof value(clip, metric) === 'number')));
  const play = clip => h('button', { type: 'button', class: 'small', 'aria-label': `Replay ${clip.name}`, onclick: () => { replay.choose({ clip: clip.name }); replay.element.scrollIntoView(); } }, 'Replay');
  const row = clip => [clip.name, clip.frames ? `${number(clip.frames / 60, 1)} s` : DASH, ...metrics.map(metric => metricNumber(metric, value(clip, metric))), play(clip)];
  const head = metric => h('th', { scope: 'col', class: 'n' }, metric, h('small', {}, metricWords(metric).unit));
  return section(`Test clips (${run.clips.length}), ${mode} mode`, table(['clip', 'length', ...metrics.map(head), ''], worstFirst(run, mode).map(row)));
}

function config(run) {
  const other = run.control?.config;
  const paths = run.control?.data === run.data ? run.paths : [];
  const keys = [...new Set([...Object.keys(run.config), ...Object.keys(other ?? {})])].filter(key => !/\._(target|partial)_$/.test(key));
  const differs = key => other && !paths.includes(key) && JSON.stringify(run.config[key] ?? null) !== JSON.stringify(other[key] ?? null);
  const rows = shown => table(['key', 'this run', ...(other ? [nameOf(run.control)] : [])],
    shown.map(key => [key, word(run.config[key]), ...(other ? [h('td', { class: 'faint' }, word(other[key]))] : [])]), { n: false, kind: 'config' });
  const differing = keys.filter(differs);
  const first = other && (differing.length ? rows(differing) : h('p', { class: 'faint' }, 'No key differs.'));
  return keys.length ? section(other ? `Config against ${nameOf(run.control)}` : 'Config', first, h('details', { open: !other }, h('summary', {}, 'All keys'), rows(keys))) : null;
}

function latency({ latency: found }) {
  if (found.median_ms === undefined) return null;
  const ms = value => (value === undefined ? undefined : `${number(value, 3)} ms`);
  const shown = [
    ['median of a step', ms(found.median_ms)], ['p95', ms(found.p95_ms)], ['median of an end-to-end pose', ms(found.pose_median_ms)],
    ['times the yardstick', number(found.ratio_to_yardstick, 2)], ['parameters', number(found.parameters)], ['MACs of a step', number(found.step_macs ?? found.macs)],
    ['ONNX file', found.onnx_bytes && bytes(found.onnx_bytes)], ['graph', found.graph], ['parity with torch', found.onnx_parity && number(found.onnx_parity)], ['precision', found['settings.precision']],
  ];
  return section('Latency', h('p', { class: 'faint' }, `One streaming step on ${found.threads ?? 1} thread.`), pairs(shown.filter(([, value]) => value !== undefined)));
}

// The last lines that the run printed, and where it failed.
function log(run) {
  const text = [run.log, run.traceback].filter(Boolean).join('\n');
  return text ? section('Log', h('pre', { class: 'log', tabindex: 0 }, text)) : null;
}

function files(run) {
  const name = file => (file.viewable && !inFile ? h('a', { href: `files/${run.id}/${encodeURIComponent(file.name)}`, target: '_blank', rel: 'noopener' }, file.name) : file.name);
  const sum = run.files.reduce((total, file) => total + file.bytes, 0);
  const manifest = Object.entries(run.manifest).filter(([key]) => !/^(attempts|sources|seconds|prerequisite_runs)/.test(key)).map(([key, value]) => [key, word(value)]);
  return section('Files and origin',
    h('details', {}, h('summary', {}, `${run.files.length} file${run.files.length === 1 ? '' : 's'}, ${bytes(sum)}`), table(null, run.files.map(file => [name(file), bytes(file.bytes), run.changed.includes(file.name) ? 'changed' : '']))),
    h('details', {}, h('summary', {}, 'Environment: code, packages, machine'), pairs(manifest)),
    run.patch ? h('details', {}, h('summary', {}, 'Patch of the code since its commit'), h('pre', { class: 'log' }, run.patch)) : null);
}

function pairs(rows) {
  return h('dl', { class: 'facts' }, rows.map(([key, value]) => h('div', {}, h('dt', {}, key), h('dd', {}, value))));
}
