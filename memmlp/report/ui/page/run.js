// The page of a run: what it is, its curves, results, worst seconds, config against the control's, files.

import { h, replace, link, section, select, empty, choice, code } from './dom.js';
import { address, alone, ask, dataName, nameOf, place, remember, runs } from './store.js';
import { ago, ARROWS, better, bytes, date, duration, effectDigits, largestFirst, metricNumber, metricWords, number, signed, word } from './format.js';
import { curvePanel } from './compare.js';
import { FINISHED, status, tags } from './runs.js';

const METRICS = ['MPJPE', 'MPJRE', 'MPJVE', 'Jitter', 'Hand PE', 'Upper PE', 'Lower PE', 'Root PE', 'geodesic'];

export async function page(id) {
  let run = await ask(`run/${id}`);
  const closing = [];
  const top = h('div');
  const panel = curvePanel([id], [['run', 'run', () => nameOf(run)]], { most: 2 });
  const rest = h('div');
  const replay = run.clips.length ? await replaySection(run, closing) : null;
  const element = h('div', { class: 'page' }, top, replay?.element, section('Curves', panel.element), rest);

  function draw() {
    replace(top, head(run), run.failure && h('p', { class: 'warning' }, h('b', {}, 'Failed: '), run.failure),
      run.damage.length ? h('p', { class: 'warning' }, h('b', {}, 'Damaged: '), `${run.damage.join(', ')} cannot be read.`) : null,
      run.remark ? h('p', { class: 'warning' }, h('b', {}, 'Its network: '), `${run.remark}.`) : null,
      run.changed.length ? h('p', { class: 'warning' }, h('b', {}, 'Changed since it was made: '), run.changed.join(', ')) : null,
      run.older.length ? h('p', { class: 'warning' }, h('b', {}, 'Measured by an earlier recipe: '), `${run.older.join(', ')}. memmlp eval ${run.id} measures it anew.`) : null, facts(run), results(run));
    replace(rest, run.clips.length ? clips(run, replay) : null, config(run), latency(run), files(run), provenance(run));
  }
  async function update() {
    const [row] = [runs.get(id)];
    if (row && row.generation !== undefined && row.generation === run.generation && run.status === row.status) return;
    if (!alone) run = await ask(`run/${id}`);
    draw();
    await panel.update();
  }
  draw();
  await panel.update();
  if (place().query.get('part') === 'replay') requestAnimationFrame(() => replay?.element.scrollIntoView());
  return { title: nameOf(run), element, update, close: () => closing.forEach(close => close()) };
}

function head(run) {
  return [
    h('p', { class: 'trail' }, link('#/runs', 'Runs'), run.places.map(at => [' / ', at.sweep ? [link(address('sweep', at.sweep), at.sweep), ` · ${at.arm}, seed ${at.seed}`] : [link(address('search', at.search), at.search), ` · trial ${at.trial}`]])),
    h('div', { class: 'bar title' }, h('h1', {}, nameOf(run)), status(run), tags(run)),
    run.note ? h('p', { class: 'remark' }, run.note) : null,
  ];
}

function facts(run) {
  const pairs = [
    ['id', code(run.id)], ['started', h('span', { title: ago(run.started) }, date(run.started))], ['took', duration(run.seconds)],
    ['data', code(dataName(run.data) || '–')], ['device', run.device || '–'], ['code', code(run.code || '–')],
    run.upstream ? ['builds upon', link(address('run', run.upstream), run.upstream.slice(0, 8))] : null,
    run.control ? ['control', [link(address('run', run.control.id), nameOf(run.control)), ' · ', link(address('compare', '', { runs: `${run.id},${run.control.id}` }), 'compare')]] : null,
  ];
  return h('dl', { class: 'facts' }, pairs.filter(Boolean).map(([key, value]) => h('div', {}, h('dt', {}, key), h('dd', {}, value))));
}

// Metrics of one's own come after the field's.
const ordered = names => [...new Set([...METRICS.filter(metric => names.includes(metric)), ...names.filter(name => !name.startsWith('GT '))])];

// The class of a difference from the control's run; none where nobody knows what is better.
function judged(metric, change) {
  const way = better(metric);
  return way && (change < 0 === (way === 'lower') ? 'better' : 'worse');
}

function results(run) {
  const columns = [...new Set(Object.keys(run.metrics).filter(name => name.split('.').length === 3).map(name => name.split('.').slice(0, 2).join('.')))].sort();
  const rows = ordered(Object.keys(run.metrics).filter(name => columns.some(column => name.startsWith(`${column}.`))).map(name => name.split('.').at(-1)));
  if (!rows.length) return Object.keys(run.metrics).some(name => name.startsWith('vqvae.')) ? section('Results', pairs(Object.entries(run.metrics).filter(([name]) => name.startsWith('vqvae.')).map(([name, value]) => [name.slice(6), number(value)]))) : null;
  // Means over other test clips are no difference of the networks.
  const other = run.control?.data === run.data ? runs.get(run.control.id)?.metrics : null;
  const cell = (column, metric) => {
    const name = `${column}.${metric}`;
    const value = run.metrics[name];
    const change = value !== undefined && typeof other?.[name] === 'number' ? value - other[name] : null;
    return h('td', { class: 'n' }, metricNumber(name, value), change === null ? null : h('small', { class: judged(metric, change) }, signed(change, effectDigits({ mean: change, value }))));
  };
  return section('Results', h('p', { class: 'faint' }, 'Means over the test clips; the arrows say what is better.', other ? ' Small: the difference from the control’s run of the same seed, which alone is no verdict.' : run.control ? ' The control has other data, so that no difference from it is shown.' : ''),
    h('div', { class: 'scroll' }, h('table', { class: 'grid' },
      h('thead', {}, h('tr', {}, h('th', { scope: 'col' }), columns.map(column => h('th', { scope: 'col', class: 'n' }, column.split('.')[0], h('small', {}, column.split('.')[1]))))),
      h('tbody', {}, rows.map(metric => h('tr', {}, h('th', { scope: 'row' }, metric, h('small', {}, [metricWords(metric).unit, ARROWS[better(metric)]].filter(Boolean).join(' '))), columns.map(column => cell(column, metric))))))));
}

// The worst clips, one of which is replayed beside the truth and beside another run.
async function replaySection(run, closing) {
  const { Replay } = await import('./replay.js');
  const others = [...runs.values()].filter(other => other.id !== run.id && FINISHED.includes(other.status) && other.kind === 'memmlp');
  const partners = new Map(run.partners.map((other, i) => [other, i]));
  const rank = other => partners.get(other.id) ?? Infinity;
  const near = others.sort((a, b) => (rank(a) === rank(b) ? 0 : rank(a) - rank(b))).slice(0, 40);
  const frame = h('div', { class: 'replay-frame' });
  const tools = h('div', { class: 'tools' });
  const replay = new Replay(frame);
  closing.push(() => replay.close());
  const set = { clip: place().query.get('clip') ?? worst(run)?.name, mode: place().query.get('mode') ?? (run.clips.some(clip => clip.stream) ? 'stream' : 'window'), other: place().query.get('other') ?? near.find(other => partners.has(other.id))?.id ?? '' };

  function draw() {
    const modes = ['stream', 'window'].filter(mode => run.clips.some(clip => clip[mode]));
    const names = [...run.clips].sort((a, b) => largestFirst(error(a, set.mode), error(b, set.mode)));
    replace(tools,
      select('Clip, worst first', names.map(clip => [clip.name, `${clip.name} (${number(error(clip, set.mode), 1)} cm)`]), set.clip, clip => choose({ clip })),
      modes.length > 1 ? choice('Mode', modes.map(mode => [mode, mode]), set.mode, mode => choose({ mode })) : null,
      near.length ? select('Beside', [['', 'no other run'], ...near.map(other => [other.id, `${nameOf(other)} (${other.id.slice(0, 6)})`])], set.other, other => choose({ other })) : null);
  }
  function choose(changes, keep = false) {
    Object.assign(set, changes);
    if (!keep) remember({ clip: set.clip, mode: set.mode, other: set.other });
    draw();
    const other = runs.get(set.other);
    return replay.show(run, set.clip, set.mode, other);
  }
  choose({}, true);
  const element = h('section', { id: 'replay' }, h('h2', {}, 'Worst seconds'), h('p', { class: 'faint' }, 'What the network made of a test clip, limbs coloured by their joints’ error, beside the truth. It begins at the worst second.'), tools, frame);
  return { element, choose };
}

const error = (clip, mode) => clip[mode]?.rotation?.MPJPE;
const worst = run => [...run.clips].sort((a, b) => largestFirst(error(a, 'stream'), error(b, 'stream')) || largestFirst(error(a, 'window'), error(b, 'window')))[0];

function clips(run, replay) {
  const mode = run.clips.some(clip => clip.stream) ? 'stream' : 'window';
  const branches = Object.keys(run.clips[0][mode] ?? {}).filter(key => typeof run.clips[0][mode][key] === 'object');
  const sets = { by: 'MPJPE', branch: branches.includes('rotation') ? 'rotation' : branches[0] };
  const element = h('div');
  function draw() {
    const value = (clip, metric) => clip[mode]?.[sets.branch]?.[metric];
    const metrics = ordered([...new Set(run.clips.flatMap(clip => Object.keys(clip[mode]?.[sets.branch] ?? {})))].filter(metric => run.clips.some(clip => typeof value(clip, metric) === 'number')));
    const order = [...run.clips].sort((a, b) => largestFirst(value(a, sets.by), value(b, sets.by)));
    const most = order.map(clip => value(clip, sets.by)).find(error => typeof error === 'number');
    const share = error => (error === undefined ? 0 : typeof error === 'number' ? (100 * error) / (most || 1) : 100);
    const headCell = metric => h('th', { scope: 'col', class: 'n', 'aria-sort': metric === sets.by ? 'descending' : null }, h('button', { type: 'button', onclick: () => { sets.by = metric; draw(); } }, metric, h('small', {}, metricWords(metric).unit)));
    const line = clip => h('tr', {}, h('th', { scope: 'row' }, clip.name), h('td', { class: 'n faint' }, clip.frames ? `${number(clip.frames / 60, 1)} s` : '–'),
      h('td', { class: 'meter' }, h('i', { style: `width:${share(value(clip, sets.by))}%` })),
      metrics.map(metric => h('td', { class: metric === sets.by ? 'n strong' : 'n' }, metricNumber(metric, value(clip, metric)))),
      h('td', {}, replay ? h('button', { type: 'button', class: 'small', 'aria-label': `Replay ${clip.name}`, onclick: () => { replay.choose({ clip: clip.name }); replay.element.scrollIntoView({ behavior: matchMedia('(prefers-reduced-motion: reduce)').matches ? 'auto' : 'smooth' }); } }, 'Replay') : null));
    replace(element, branches.length > 1 ? h('div', { class: 'tools' }, choice('Branch', branches.map(branch => [branch, branch]), sets.branch, branch => { sets.branch = branch; draw(); })) : null,
      h('div', { class: 'scroll short' }, h('table', { class: 'grid' }, h('thead', {}, h('tr', {}, h('th', { scope: 'col' }, 'clip'), h('th', { scope: 'col', class: 'n' }, 'length'), h('th', { scope: 'col' }, h('span', { class: 'hidden' }, 'bar')), metrics.map(headCell), h('th', { scope: 'col' }, h('span', { class: 'hidden' }, 'replay')))), h('tbody', {}, order.map(line)))));
  }
  draw();
  return section(`Test clips (${run.clips.length}), ${mode} mode`, element);
}

function config(run) {
  const element = h('div');
  const other = run.control?.config;
  let all = !other;
  let words = '';
  const list = h('div');
  function draw() {
    const keys = [...new Set([...Object.keys(run.config), ...Object.keys(other ?? {})])].filter(key => !/\._(target|partial)_$/.test(key));
    const alike = run.control?.data === run.data ? run.paths : [];
    const differs = key => other && !alike.includes(key) && JSON.stringify(run.config[key] ?? null) !== JSON.stringify(other[key] ?? null);
    const shown = keys.filter(key => (all || differs(key)) && `${key}=${run.config[key]}`.toLowerCase().includes(words.toLowerCase()));
    const rows = shown.map(key => h('tr', { class: differs(key) ? 'differs' : null }, h('th', { scope: 'row' }, key), h('td', {}, word(run.config[key])), other ? h('td', { class: 'faint' }, word(other[key])) : null));
    replace(list, shown.length ? h('div', { class: 'scroll short' }, h('table', { class: 'grid config' }, h('thead', {}, h('tr', {}, h('th', { scope: 'col' }, 'key'), h('th', { scope: 'col' }, 'this run'), other ? h('th', { scope: 'col' }, nameOf(run.control)) : null)), h('tbody', {}, rows)))
      : h('p', { class: 'faint' }, words ? 'No key fits.' : 'No key differs.'));
  }
  function tools() {
    replace(element, h('div', { class: 'tools' }, other ? choice('Keys', [['no', 'what differs'], ['yes', 'all']], all ? 'yes' : 'no', value => { all = value === 'yes'; tools(); draw(); }) : null,
      h('label', { class: 'field' }, h('span', {}, 'Key'), h('input', { type: 'text', value: words, oninput: event => { words = event.target.value; draw(); } }))), list);
  }
  tools();
  draw();
  return Object.keys(run.config).length ? section(other ? `Config against ${nameOf(run.control)}` : 'Config', element) : null;
}

function latency(run) {
  const found = run.latency;
  if (found.median_ms === undefined) return null;
  const shown = [
    ['median of a step', `${number(found.median_ms, 3)} ms`], ['p95', `${number(found.p95_ms, 3)} ms`], ['median of a whole pose', found.pose_median_ms === undefined ? undefined : `${number(found.pose_median_ms, 3)} ms`], ['times the yardstick', number(found.ratio_to_yardstick, 2)],
    ['parameters', number(found.parameters)], ['MACs of a step', number(found.step_macs ?? found.macs)], ['ONNX file', found.onnx_bytes ? bytes(found.onnx_bytes) : '–'],
    ['graph', found.graph], ['parity with torch', found.onnx_parity === undefined ? '–' : number(found.onnx_parity)], ['precision', found['settings.precision']],
  ];
  const share = (100 * found.p95_ms * 60) / 1000;
  return section('Latency', h('p', { class: 'faint' }, `One streaming step on ${found.threads ?? 1} thread; p95 is ${number(share, 1)} % of a frame's time at 60 Hz.`), pairs(shown.filter(([, value]) => value !== undefined)));
}

function files(run) {
  const name = file => (file.shown && !alone ? h('a', { href: `files/${run.id}/${encodeURIComponent(file.name)}`, target: '_blank', rel: 'noopener' }, file.name) : file.name);
  const rows = run.files.map(file => h('tr', {}, h('th', { scope: 'row' }, name(file)), h('td', { class: 'n' }, bytes(file.bytes)), h('td', {}, run.changed.includes(file.name) ? h('span', { class: 'state failed' }, 'changed') : '')));
  const sum = run.files.reduce((total, file) => total + file.bytes, 0);
  return h('section', {}, h('h2', {}, 'Files'), h('details', {}, h('summary', {}, `${run.files.length} files, ${bytes(sum)}`), h('div', { class: 'scroll short' }, h('table', { class: 'grid' }, h('tbody', {}, rows)))));
}

function provenance(run) {
  const skip = /^(attempts|sources|seconds|upstream_runs)/;
  const rows = Object.entries(run.manifest).filter(([key]) => !skip.test(key)).map(([key, value]) => [key, word(value)]);
  return rows.length ? h('section', {}, h('h2', {}, 'Where it comes from'), h('details', {}, h('summary', {}, 'Manifest'), pairs(rows))) : null;
}

function pairs(rows) {
  return h('dl', { class: 'pairs' }, rows.map(([key, value]) => h('div', {}, h('dt', {}, key), h('dd', {}, value))));
}
