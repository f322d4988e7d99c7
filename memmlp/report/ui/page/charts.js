// Charts by Observable Plot, in the page's colours, each with a sentence for screen readers.

import { h, replace } from './dom.js';
import { number } from './format.js';

const { d3, Plot } = window;
const COLOURS = Array.from({ length: 10 }, (_, i) => `var(--series${i})`);

const MAX_POINTS = 240; // of a band
let latest = 0; // the last chart's width: most have the same, so that a redrawn one does not jump

// A figure that is drawn again when its width changes. draw(width) returns an element.
export function figure(label, draw) {
  const frame = h('div', { class: 'plot' });
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
  return h('figure', { class: 'chart' }, frame);
}

const base = (width, height, more) => ({
  width, height, marginLeft: 56, marginRight: 16, marginTop: 22, marginBottom: 34,
  style: { background: 'none', fontFamily: 'inherit', fontSize: '11.5px', overflow: 'visible' },
  ...more,
});

export const colourOf = groups => new Map([...groups].map((group, i) => [group, COLOURS[i % COLOURS.length]]));

const nameWidth = names => Math.max(...names.map(name => name.length)) * 6.6 + 18;
const tip = (data, options) => Plot.tip(data, Plot.pointer({ fill: 'var(--card)', stroke: 'var(--line)', textPadding: 8, ...options }));

// Curves by group with the band of each group's runs.
// series: [{ run, group, steps, values }]
export function curves(series, { label, log = false, smooth = 0, colours, axis = 'step' }) {
  const kept = series.map(one => smoothed(one, smooth)).filter(one => one.steps.length);
  const groups = [...new Set(kept.map(one => one.group))];
  const bands = groups.flatMap(group => band(kept.filter(one => one.group === group), group));
  const points = kept.flatMap(one => one.steps.map((step, i) => ({ step, value: one.values[i], group: one.group, run: one.run })))
    .filter(point => !log || point.value > 0);
  const single = new Set(groups.filter(group => kept.filter(one => one.group === group).length === 1));
  const wide = bands.filter(point => !single.has(point.group) && (!log || point.low > 0));
  const lines = points.filter(point => single.has(point.group));
  const tips = [...wide, ...lines.map(point => ({ ...point, mean: point.value }))];
  const draw = width => Plot.plot(base(width, Math.min(Math.max(width * 0.42, 220), 400), {
    x: { label: axis, ticks: Math.min(width / 90, 8), tickFormat: axis === 'hours' ? '~g' : '~s' },
    y: { label, type: log ? 'log' : 'linear', grid: true, nice: true, ticks: 5, tickFormat: log ? undefined : '~g' },
    marks: [
      Plot.areaY(wide, { x: 'step', y1: 'low', y2: 'high', z: 'group', fill: point => colours.get(point.group), fillOpacity: 0.16 }),
      Plot.line(lines, { x: 'step', y: 'value', z: 'run', stroke: point => colours.get(point.group), strokeWidth: 1.8 }),
      Plot.line(wide, { x: 'step', y: 'mean', z: 'group', stroke: point => colours.get(point.group), strokeWidth: 2 }),
      Plot.ruleX(tips, Plot.pointerX({ x: 'step', stroke: 'var(--faint)', strokeOpacity: 0.5 })),
      tip(tips, { x: 'step', y: 'mean', title: point => [point.group, `${axis} ${number(point.step)}`,
        point.low === undefined ? number(point.mean) : `${number(point.mean)}  (${number(point.low)} to ${number(point.high)}, ${point.count} runs)`].join('\n') }),
    ],
  }));
  const last = groups.map(group => {
    const mine = points.filter(point => point.group === group);
    return mine.length ? `${group} ends at ${number(mine.at(-1).value)}` : '';
  });
  return figure(`${label} by ${axis}. ${last.filter(Boolean).join('; ')}.`, draw);
}

// A run without NaN values, blurred over a radius of some points.
function smoothed({ steps, values, ...run }, radius) {
  const known = (_, i) => values[i] !== null;
  return { ...run, steps: steps.filter(known), values: d3.blur(values.filter(known), radius) };
}

// Mean and extremes of several runs, interpolated at steps that all of them cover.
function band(series, group) {
  if (series.length < 2) return [];
  const first = d3.max(series, one => one.steps[0]);
  const last = d3.min(series, one => one.steps.at(-1));
  const at = series.map(({ steps, values }) => d3.scaleLinear([...steps, steps.at(-1) + 1], [...values, values.at(-1)]));
  const steps = [...d3.union(...series.map(one => one.steps))].filter(step => step >= first && step <= last).sort(d3.ascending);
  return steps.filter((_, i) => i % Math.ceil(steps.length / MAX_POINTS) === 0).map(step => {
    const values = at.map(interpolate => interpolate(step));
    return { step, group, mean: d3.mean(values), low: d3.min(values), high: d3.max(values), count: values.length };
  });
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
  return figure(`${label}, differences from the control. ${sentence}`, draw);
}

// Errors with their intervals against a cost on a logarithmic axis, one curve for each series.
export function frontier(points, { x, y }) {
  const colours = colourOf(new Set(points.map(point => point.series)));
  const colour = point => colours.get(point.series);
  const words = point => `${point.variant}: ${number(point.mean)} at ${number(Number(point.cost.toPrecision(3)))}`;
  const last = [...colours.keys()].map(series => points.filter(point => point.series === series).at(-1));
  const draw = width => Plot.plot(base(width, Math.min(Math.max(width * 0.6, 240), 400), {
    marginRight: Math.min(nameWidth([...colours.keys()]), width * 0.3),
    x: { type: 'log', label: x, ticks: Math.min(width / 90, 6), tickFormat: '~g' },
    y: { label: y, grid: true, nice: true, ticks: 5 },
    marks: [
      Plot.link(points.filter(point => point.low !== null), { x: 'cost', y1: 'low', y2: 'high', stroke: colour, strokeWidth: 1.5, strokeOpacity: 0.6 }),
      Plot.line(points, { x: 'cost', y: 'mean', z: 'series', stroke: colour, strokeWidth: 2 }),
      Plot.dot(points, { x: 'cost', y: 'mean', r: 4, fill: colour }),
      Plot.text(last, { x: 'cost', y: 'mean', text: 'series', textAnchor: 'start', dx: 8, fill: colour }),
      tip(points, { x: 'cost', y: 'mean', title: words }),
    ],
  }));
  return figure(`${y} against ${x}. ${points.map(words).join('; ')}`, draw);
}

// Points { x, y, text, best } in two measures; a line joins the best ones. open(point): called by a click.
export function scatter(points, { x, y, open, joined = true, log = false }) {
  const isNumber = points.every(point => typeof point.x === 'number');
  const best = points.filter(point => point.best).sort((a, b) => a.x - b.x);
  const draw = width => {
    const plot = Plot.plot(base(width, 280, {
      x: { label: x, grid: true, ...(isNumber ? { nice: true, ticks: Math.min(width / 90, 8), ...(log ? { type: 'log', tickFormat: '~g' } : { tickFormat: '~r' }) } : { type: 'point' }) }, y: { label: y, grid: true, nice: true, ticks: 6 },
      marks: [
        Plot.line(joined ? best : [], { x: 'x', y: 'y', stroke: 'var(--series1)', strokeWidth: 1.6, curve: 'step-after' }),
        Plot.dot(points, { x: 'x', y: 'y', r: 4.5, fill: point => (point.best ? 'var(--series1)' : 'var(--series0)'), fillOpacity: 0.85 }),
        tip(points, { x: 'x', y: 'y', title: 'text' }),
      ],
    }));
    plot.addEventListener('click', () => plot.value && open(plot.value));
    return plot;
  };
  return figure(`${y} by ${x}; the best are ${best.map(point => number(point.y)).join(', ')}.`, draw);
}

// When each trial ran: { number, began, ended, kind, text }, in seconds.
export function spans(rows, { label }) {
  const start = Math.min(...rows.map(row => row.began));
  const [unit, size] = Math.max(...rows.map(row => row.ended)) - start < 7200 ? ['minutes', 60] : ['hours', 3600];
  const at = time => (time - start) / size;
  const colour = row => ({ done: 'var(--good)', failed: 'var(--bad)', running: 'var(--series0)' })[row.kind] ?? 'var(--faint)';
  const draw = width => Plot.plot(base(width, Math.min(60 + 9 * rows.length, 480), {
    x: { label: unit, grid: true, ticks: Math.min(width / 90, 8) }, y: { label: 'trial', reverse: true, nice: true, ticks: 6, tickFormat: '~r' },
    marks: [
      Plot.link(rows, { x1: row => at(row.began), x2: row => at(row.ended), y1: 'number', y2: 'number', stroke: colour, strokeWidth: 4, strokeLinecap: 'round' }),
      tip(rows, { x: row => at(row.began), y: 'number', title: 'text' }),
    ],
  }));
  return figure(`${label}: ${rows.map(row => row.text).join('; ')}`, draw);
}

// Errors over time; a click goes to a moment. The style property --now, from 0 to 1, places a line.
export function timeline(values, { fps, label, go, marks, colours }) {
  const points = values.flatMap((one, i) => one.errors.map((error, frame) => ({ time: frame / fps, error, name: one.name, i })));
  const draw = width => {
    const plot = Plot.plot(base(width, 120, {
      marginTop: 12, marginBottom: 28, x: { label: null, domain: [0, Math.max(values[0].errors.length - 1, 1) / fps] }, y: { label, grid: true, ticks: 3, zero: true, nice: true },
      marks: [
        Plot.rectX(marks, { x1: mark => mark.first / fps, x2: mark => mark.first / fps + 1, fill: 'var(--bad)', fillOpacity: (_, i) => (i ? 0.08 : 0.16) }),
        Plot.line(points, { x: 'time', y: 'error', z: 'i', stroke: point => colours[point.i], strokeWidth: 1.5 }),
        Plot.ruleX(points, Plot.pointerX({ x: 'time', stroke: 'var(--faint)' })),
      ],
    }));
    plot.addEventListener('click', () => plot.value && go(plot.value.time));
    plot.style.cursor = 'pointer';
    return plot;
  };
  return figure(`${label} over the clip; the worst second begins at ${number(marks[0]?.first / fps, 1)} s.`, draw);
}
