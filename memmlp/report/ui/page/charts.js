// Charts by Observable Plot, in the page's colours, each with a sentence and a table for screen readers.

import { h, replace, table } from './dom.js';
import { number } from './format.js';

const Plot = window.Plot;
export const COLOURS = Array.from({ length: 10 }, (_, i) => `var(--series${i})`);

let latest = 0; // the last chart's width: most have the same, so that a redrawn one does not jump

// A figure that is drawn again when its width changes. draw(width) returns an element.
export function figure(label, draw, rows) {
  const frame = h('div', { class: 'plot' });
  const details = rows && h('details', { class: 'data' }, h('summary', {}, 'Data'), h('div'));
  details?.addEventListener('toggle', () => {
    const [heads, ...data] = rows();
    if (details.open) replace(details.lastChild, table(heads, data.slice(0, 400).map(row => row.map(cell => number(cell)))));
  });
  const element = h('figure', { class: 'chart' }, frame, details);
  let width = latest;
  const render = () => {
    if (!width) return;
    const drawn = draw(width);
    const svg = drawn.tagName === 'svg' ? drawn : drawn.querySelector('svg');
    svg?.setAttribute('role', 'img');
    svg?.setAttribute('aria-label', label);
    replace(frame, drawn);
  };
  new ResizeObserver(([entry]) => {
    const wide = Math.round(entry.contentRect.width);
    if (wide && wide !== width) { width = latest = wide; render(); }
  }).observe(frame);
  render();
  return element;
}

const base = (width, height, more) => ({
  width, height, marginLeft: 56, marginRight: 16, marginTop: 22, marginBottom: 34,
  style: { background: 'none', fontFamily: 'inherit', fontSize: '11.5px', overflow: 'visible' },
  ...more,
});

const nameWidth = names => Math.max(...names.map(name => name.length)) * 6.6 + 18;

export function colourOf(groups) {
  return new Map([...groups].map((group, i) => [group, COLOURS[i % COLOURS.length]]));
}

const tip = (data, options) => Plot.tip(data, Plot.pointer({ fill: 'var(--card)', stroke: 'var(--line)', textPadding: 8, ...options }));

// Curves by group with the band of each group's runs.
// series: [{ run, group, steps, values }]
export function curves(series, { label, log = false, smooth = 0, each = false, colours }) {
  const kept = series.map(one => ({ ...one, values: smoothed(one.values, smooth) })).filter(one => one.steps.length);
  const groups = [...new Set(kept.map(one => one.group))];
  const bands = groups.flatMap(group => band(kept.filter(one => one.group === group), group));
  const points = kept.flatMap(one => one.steps.map((step, i) => ({ step, value: one.values[i], group: one.group, run: one.run })))
    .filter(point => point.value !== null && (!log || point.value > 0));
  const single = new Set(groups.filter(group => kept.filter(one => one.group === group).length === 1));
  const wide = bands.filter(point => !single.has(point.group) && (!log || point.low > 0));
  const lines = each ? points : points.filter(point => single.has(point.group));
  const tips = [...wide, ...lines.map(point => ({ ...point, mean: point.value }))];
  const draw = width => Plot.plot(base(width, Math.min(Math.max(width * 0.42, 220), 400), {
    x: { label: 'step', ticks: Math.min(width / 90, 8), tickFormat: 's' },
    y: { label, type: log ? 'log' : 'linear', grid: true, nice: true, ticks: 5, tickFormat: log ? undefined : '~g' },
    marks: [
      Plot.areaY(wide, { x: 'step', y1: 'low', y2: 'high', z: 'group', fill: point => colours.get(point.group), fillOpacity: 0.16 }),
      Plot.line(lines, { x: 'step', y: 'value', z: 'run', stroke: point => colours.get(point.group), strokeWidth: each && lines.length > wide.length ? 1.3 : 1.8, strokeOpacity: each ? 0.75 : 1 }),
      Plot.line(wide, { x: 'step', y: 'mean', z: 'group', stroke: point => colours.get(point.group), strokeWidth: 2 }),
      Plot.ruleX(tips, Plot.pointerX({ x: 'step', stroke: 'var(--faint)', strokeOpacity: 0.5 })),
      tip(tips, { x: 'step', y: 'mean', title: point => [point.group, `step ${point.step}`,
        point.low === undefined ? number(point.mean) : `${number(point.mean)}  (${number(point.low)} to ${number(point.high)}, ${point.count} runs)`].join('\n') }),
    ],
  }));
  const last = groups.map(group => {
    const mine = points.filter(point => point.group === group);
    return mine.length ? `${group} ends at ${number(mine.at(-1).value)}` : '';
  });
  const rows = () => [['group', 'step', label], ...thin(points, 200).map(point => [point.group, point.step, point.value])];
  return figure(`${label} by step. ${last.filter(Boolean).join('; ')}.`, draw, rows);
}

const thin = (points, most) => points.filter((_, i) => i % Math.ceil(points.length / most) === 0);

// An exponential mean without its bias at the beginning; weight 0 leaves the values alone.
function smoothed(values, weight) {
  if (!weight) return values;
  let [sum, norm] = [0, 0];
  return values.map(value => {
    if (value === null) return null;
    sum = weight * sum + (1 - weight) * value;
    norm = weight * norm + (1 - weight);
    return sum / norm;
  });
}

// Mean, least and largest value of several runs, on steps that all of them cover.
function band(series, group) {
  if (series.length < 2) return [];
  const first = Math.max(...series.map(one => one.steps[0]));
  const last = Math.min(...series.map(one => one.steps.at(-1)));
  const steps = [...new Set(series.flatMap(one => one.steps))].filter(step => step >= first && step <= last).sort((a, b) => a - b);
  return thin(steps, 240).map(step => {
    const values = series.map(one => at(one, step)).filter(value => value !== null);
    const mean = values.reduce((a, b) => a + b, 0) / values.length;
    return { step, group, mean, low: Math.min(...values), high: Math.max(...values), count: values.length };
  }).filter(point => point.count);
}

function at({ steps, values }, step) {
  let [low, high] = [0, steps.length - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (steps[middle] <= step) low = middle; else high = middle;
  }
  const [a, b] = [values[low], values[high]];
  if (a === null || b === null) return a ?? b;
  const part = steps[high] === steps[low] ? 0 : (step - steps[low]) / (steps[high] - steps[low]);
  return a + Math.min(Math.max(part, 0), 1) * (b - a);
}

// Differences from the control with their intervals, and the paper's below them.
export function forest(rows, { label, smallest }) {
  const known = rows.filter(row => row.mean !== null);
  const domain = rows.map(row => row.variant);
  const colour = row => ({ holds: 'var(--good)', opposite: 'var(--bad)' })[row.verdict] ?? 'var(--accent)';
  const shorten = name => (name.length > 34 ? `${name.slice(0, 33)}…` : name);
  const draw = width => Plot.plot(base(width, 64 + 34 * domain.length, {
    marginLeft: Math.min(nameWidth(domain), 230, width * 0.38), marginBottom: 38,
    x: { label: `${label}, difference`, grid: true, zero: true, ticks: Math.min(width / 80, 9), labelAnchor: 'center', labelArrow: 'none' },
    y: { domain, label: null, tickSize: 0, tickFormat: shorten },
    marks: [
      smallest ? Plot.rect([0], { x1: -smallest, x2: smallest, fill: 'var(--faint)', fillOpacity: 0.1 }) : null,
      Plot.ruleX([0], { stroke: 'var(--faint)' }),
      Plot.link(known.filter(row => row.low !== null), { x1: 'low', x2: 'high', y1: 'variant', y2: 'variant', stroke: colour, strokeWidth: 2.5, strokeLinecap: 'round' }),
      Plot.dot(known, { x: 'mean', y: 'variant', r: 5.5, stroke: colour, strokeWidth: 2, fill: row => (row.significant ? colour(row) : 'var(--card)') }),
      Plot.dot(rows.filter(row => row.paper !== null), { x: 'paper', y: 'variant', symbol: 'diamond', r: 6, fill: 'none', stroke: 'var(--ink)', strokeWidth: 1.5, dy: 11 }),
      tip(known, { x: 'mean', y: 'variant', title: row => `${row.variant}\n${row.words}` }),
    ],
  }));
  const sentence = known.map(row => `${row.variant}: ${row.words}`).join('; ');
  return figure(`${label}, differences from the control. ${sentence}`, draw,
    () => [['variant', 'difference', 'low', 'high', 'paper', 'verdict'], ...rows.map(row => [row.variant, row.mean, row.low, row.high, row.paper, row.verdict ?? ''])]);
}

// Trials' values by number, and the best so far.
export function history(trials, { label, open }) {
  let best = Infinity;
  const line = trials.map(trial => ({ number: trial.number, best: (best = Math.min(best, trial.value)) }));
  const draw = width => {
    const plot = Plot.plot(base(width, 260, {
      x: { label: 'trial', ticks: Math.min(width / 70, trials.length), tickFormat: 'd' }, y: { label, grid: true, nice: true, ticks: 5 },
      marks: [
        Plot.line(line, { x: 'number', y: 'best', curve: 'step-after', stroke: 'var(--series1)', strokeWidth: 1.8 }),
        Plot.dot(trials, { x: 'number', y: 'value', fill: 'var(--series0)', r: 4, fillOpacity: 0.85 }),
        tip(trials, { x: 'number', y: 'value', title: trial => `trial ${trial.number}\n${number(trial.value)}` }),
      ],
    }));
    plot.addEventListener('click', () => plot.value && open(plot.value));
    return plot;
  };
  return figure(`${label} by trial; the best is ${number(best)}.`, draw, () => [['trial', label], ...trials.map(t => [t.number, t.value])]);
}

// Points { id, x, y, text } in two measures; those on the front have the second colour, and a line.
export function scatter(points, { x, y, front }) {
  const best = points.filter(point => front.has(point.id)).sort((a, b) => a.x - b.x);
  const draw = width => Plot.plot(base(width, 300, {
    x: { label: x, grid: true, nice: true, ticks: Math.min(width / 90, 8), tickFormat: '~r', labelAnchor: 'center', labelArrow: 'none' },
    y: { label: y, grid: true, nice: true, ticks: 6 },
    marks: [
      Plot.line(best, { x: 'x', y: 'y', stroke: 'var(--series1)', strokeWidth: 1.5, curve: 'step-after', strokeDasharray: '4 3' }),
      Plot.dot(points, { x: 'x', y: 'y', r: 5, fill: point => (front.has(point.id) ? 'var(--series1)' : 'var(--series0)'), fillOpacity: 0.85 }),
      tip(points, { x: 'x', y: 'y', title: 'text' }),
    ],
  }));
  return figure(`${y} against ${x}; ${best.length} of ${points.length} are in the second colour.`, draw, () => [['', x, y], ...points.map(point => [point.id, point.x, point.y])]);
}

// Errors over time; a click goes to a moment.
export function timeline(values, { fps, label, at: when, go, marks, colours }) {
  const points = values.flatMap((one, i) => one.errors.map((error, frame) => ({ time: frame / fps, error, name: one.name, i })));
  const draw = width => {
    const plot = Plot.plot(base(width, 120, {
      marginTop: 12, marginBottom: 28, x: { label: null, domain: [0, Math.max(values[0].errors.length - 1, 1) / fps] }, y: { label, grid: true, ticks: 3, zero: true, nice: true },
      marks: [
        Plot.rectX(marks, { x1: mark => mark.first / fps, x2: mark => mark.first / fps + 1, fill: 'var(--bad)', fillOpacity: (_, i) => (i ? 0.08 : 0.16) }),
        Plot.line(points, { x: 'time', y: 'error', z: 'i', stroke: point => colours[point.i], strokeWidth: 1.5 }),
        Plot.ruleX([when()], { stroke: 'var(--ink)', strokeWidth: 1.5, className: 'now' }),
        Plot.ruleX(points, Plot.pointerX({ x: 'time', stroke: 'var(--faint)' })),
      ],
    }));
    plot.addEventListener('click', () => plot.value && go(plot.value.time));
    plot.style.cursor = 'pointer';
    return plot;
  };
  return figure(`${label} over the clip; the worst second begins at ${number(marks[0]?.first / fps, 1)} s.`, draw);
}
