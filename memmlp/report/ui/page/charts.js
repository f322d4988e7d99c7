// Charts by Observable Plot, in the page's colours, each with a sentence for screen readers.

import { h, replace, savePng } from './dom.js';
import { number } from './format.js';

const { d3, Plot } = window;
const COLOURS = Array.from({ length: 10 }, (_, i) => `var(--series${i})`);

const MAX_POINTS = 240; // of a band
let latest = 0; // the last chart's width: most have the same, so that a redrawn one does not jump

// A figure that is drawn again when its width changes. draw(width) returns an element; a legend is below.
export function figure(label, draw, legend = null) {
  const frame = h('div', { class: 'plot' });
  let width = latest;
  const render = () => {
    if (!width) return;
    const drawn = draw(width);
    drawn.setAttribute('role', 'img');
    drawn.setAttribute('aria-label', label);
    replace(frame, drawn);
  };
  new ResizeObserver(([entry]) => {
    const wide = Math.round(entry.contentRect.width);
    if (wide && wide !== width) { width = latest = wide; render(); }
  }).observe(frame);
  render();
  const content = h('div', {}, frame, legend && h('figcaption', { class: 'keys' }, legend));
  return h('figure', { class: 'chart' }, content, h('span', { class: 'save' }, h('button', { type: 'button', title: 'Save this plot as PNG', onclick: () => savePng('plot.png', content) }, 'PNG')));
}

const legendKey = (mark, text, colour) => h('span', { class: 'scale' }, h('b', { style: colour && `color:${colour}` }, mark), text);

const base = (width, height, more) => ({
  width, height, marginLeft: 56, marginRight: 16, marginTop: 22, marginBottom: 38,
  style: { background: 'none', fontFamily: 'inherit', fontSize: '11.5px', overflow: 'visible' },
  ...more,
});

export const colourOf = groups => new Map([...groups].map((group, i) => [group, COLOURS[i % COLOURS.length]]));

const plain = d3.format('~g'); // a scale's own format would write 4e+1
// A logarithmic scale; over less than a decade, where D3 would label no tick, a power that looks the same.
function logScale(values, width) {
  const [least, most] = d3.extent(values);
  return most < 10 * least ? { type: 'pow', exponent: 0.001, nice: false, ticks: 5, tickFormat: plain } : { type: 'log', ticks: Math.min(width / 150, 6), tickFormat: '~g' };
}
const shorten = (name, most) => (name.length > most ? `${name.slice(0, Math.ceil(most / 2) - 1)}…${name.slice(-Math.floor(most / 2))}` : name);
const nameWidth = names => Math.max(...names.map(name => name.length)) * 6.6 + 18;
const tip = (data, options) => Plot.tip(data, Plot.pointer({ fill: 'var(--card)', stroke: 'var(--line)', textPadding: 8, ...options }));

// A plot whose chosen point is opened by a click.
function openByClick(open, plot) {
  plot.addEventListener('click', () => plot.value && open(plot.value));
  return plot;
}

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
    x: { label: axis, ticks: Math.min(width / 90, 8), tickFormat: axis === 'hours' ? plain : d3.format('~s') },
    y: { label, type: log ? 'log' : 'linear', grid: true, nice: true, ticks: 5, tickFormat: log ? undefined : plain },
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
  return figure(`${label} by ${axis}. ${last.filter(Boolean).join('; ')}.`, draw, wide.length ? legendKey('▒', 'range of the runs around their mean') : null);
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
  const [single, several] = [known.filter(row => row.single), known.filter(row => !row.single)];
  const papers = rows.filter(row => row.paper !== null);
  const margin = width => Math.min(nameWidth(domain), 230, width * 0.38);
  const draw = width => Plot.plot(base(width, 72 + 34 * domain.length, {
    marginLeft: margin(width), marginBottom: 46,
    x: { label: `${label}, difference`, grid: true, zero: true, nice: true, inset: 14, ticks: Math.min(width / 80, 9), labelAnchor: 'center', labelArrow: 'none', labelOffset: 42 },
    y: { domain, label: null, tickSize: 0, tickFormat: name => shorten(name, Math.round((margin(width) - 18) / 6.6)) },
    marks: [
      smallest ? Plot.rect([0], { x1: -smallest, x2: smallest, fill: 'var(--faint)', fillOpacity: 0.1 }) : null,
      Plot.ruleX([0], { stroke: 'var(--faint)' }),
      Plot.link(several.filter(row => row.low !== null), { x1: 'low', x2: 'high', y1: 'variant', y2: 'variant', stroke: colour, strokeWidth: 2.5, strokeLinecap: 'round' }),
      Plot.link(single.filter(row => row.low !== null), { x1: 'low', x2: 'high', y1: 'variant', y2: 'variant', stroke: 'var(--faint)', strokeDasharray: '2 4' }),
      Plot.dot(several, { x: 'mean', y: 'variant', r: 5.5, stroke: colour, strokeWidth: 2, fill: row => (row.significant ? colour(row) : 'var(--card)') }),
      Plot.dot(single, { x: 'mean', y: 'variant', symbol: 'times', r: 4.5, stroke: 'var(--faint)', strokeWidth: 2 }),
      Plot.dot(papers, { x: 'paper', y: 'variant', symbol: 'diamond', r: 6, fill: 'none', stroke: 'var(--ink)', strokeWidth: 1.5, dy: 11 }),
      tip(known, { x: 'mean', y: 'variant', title: row => `${row.variant}\n${row.words}` }),
    ],
  }));
  const sentence = known.map(row => `${row.variant}: ${row.words}`).join('; ');
  return figure(`${label}, differences from the control. ${sentence}`, draw, [
    several.some(row => row.significant) && legendKey('●', 'significant after Holm’s correction'), several.some(row => !row.significant) && legendKey('○', 'not significant', 'var(--accent)'),
    single.length ? legendKey('×', 'one seed: undecided') : null, papers.length ? legendKey('◇', 'the paper’s difference', 'var(--ink)') : null, smallest ? legendKey('▒', `smallest effect of interest, ±${number(smallest)}`) : null]);
}

// Errors with their intervals against a cost on a logarithmic axis, one curve for each series.
export function frontier(points, { x, y, colours }) {
  const colour = point => colours.get(point.series);
  const words = point => `${point.variant}: ${number(point.mean)} at ${number(Number(point.cost.toPrecision(3)))}`;
  const draw = width => Plot.plot(base(width, Math.min(Math.max(width * 0.6, 240), 400), {
    inset: 10, x: { label: x, ...logScale(points.map(point => point.cost), width) }, y: { label: y, grid: true, nice: true, ticks: 5 },
    marks: [
      Plot.link(points.filter(point => point.low !== null), { x: 'cost', y1: 'low', y2: 'high', stroke: colour, strokeWidth: 1.5, strokeOpacity: 0.6 }),
      Plot.line(points, { x: 'cost', y: 'mean', z: 'series', stroke: colour, strokeWidth: 2 }),
      Plot.dot(points, { x: 'cost', y: 'mean', r: 4, fill: colour }),
      tip(points, { x: 'cost', y: 'mean', title: words }),
    ],
  }));
  return figure(`${y} against ${x}. ${points.map(words).join('; ')}`, draw, [...new Set(points.map(point => point.series))].map(series => legendKey('●', series, colours.get(series))));
}

// Points { x, y, text, best } in two measures; a line joins the best ones, which `mark` names. open(point): called by a click.
export function scatter(points, { x, y, open, mark = null, joined = true, log = false }) {
  const isNumber = points.every(point => typeof point.x === 'number');
  const best = points.filter(point => point.best).sort((a, b) => a.x - b.x);
  const draw = width => openByClick(open, Plot.plot(base(width, 280, {
    inset: 10, x: { label: x, grid: true, ...(isNumber ? { nice: true, ticks: Math.min(width / 90, 8), tickFormat: '~r', ...(log ? logScale(points.map(point => point.x), width) : {}) } : { type: 'point' }) }, y: { label: y, grid: true, nice: true, ticks: 6 },
    marks: [
      Plot.line(joined ? best : [], { x: 'x', y: 'y', stroke: 'var(--series1)', strokeWidth: 1.6, curve: 'step-after' }),
      Plot.dot(points, { x: 'x', y: 'y', r: 4.5, fill: point => (point.best ? 'var(--series1)' : 'var(--series0)'), fillOpacity: 0.85 }),
      tip(points, { x: 'x', y: 'y', title: 'text' }),
    ],
  })));
  return figure(`${y} by ${x}; the best are ${best.map(point => number(point.y)).join(', ')}.`, draw, mark && best.length ? legendKey('●', mark, 'var(--series1)') : null);
}

// A value over two keys, from scattered points { x, y, value, text }.
export function contour(points, { x, y, label, log, open }) {
  const scale = (key, at, size) => ({ label: key, nice: true, ticks: size / 90, tickFormat: '~g', ...(log.includes(key) ? logScale(points.map(point => point[at]), size) : {}) });
  const draw = width => openByClick(open, Plot.plot(base(width, 340, {
    inset: 10, x: scale(x, 'x', width), y: scale(y, 'y', 450), color: { scheme: 'viridis', reverse: true, legend: true, label, width: 220 },
    marks: [
      Plot.contour(points, { x: 'x', y: 'y', fill: 'value', interpolate: 'barycentric', blur: 2, thresholds: 12, fillOpacity: 0.7 }),
      Plot.dot(points, { x: 'x', y: 'y', fill: 'value', stroke: 'var(--ink)', r: 4.5 }),
      tip(points, { x: 'x', y: 'y', title: 'text' }),
    ],
  })));
  return figure(`${label} by ${x} and ${y}`, draw);
}

// Lines over parallel axes. rows: { text, values }; the last axis colours the lines.
export function parallel(rows, axes, { log = [], open }) {
  const scales = new Map(axes.map(name => {
    const found = rows.map(row => row.values[name]).filter(value => (value ?? null) !== null);
    const numbers = found.length > 0 && found.every(value => typeof value === 'number');
    const ends = numbers ? d3.extent(found) : [...new Set(found.map(String))].sort();
    const at = numbers ? (log.includes(name) ? d3.scaleLog(ends, [0, 1]) : d3.scaleLinear(ends, [0, 1])) : d3.scalePoint(ends, [0, 1]);
    return [name, { at: value => at(numbers ? value : String(value)), ends: ends.length > 9 ? [ends[0], ends.at(-1)] : ends }];
  }));
  const colour = at => `color-mix(in oklab, var(--series0) ${Math.round(100 * at)}%, var(--series1))`; // seen on light and dark
  const points = rows.flatMap(row => axes.filter(name => (row.values[name] ?? null) !== null).map(name => ({ row, name, at: scales.get(name).at(row.values[name]), text: row.text })));
  const ticks = axes.flatMap(name => scales.get(name).ends.map(value => ({ name, at: scales.get(name).at(value), text: typeof value === 'number' ? number(value) : String(value).slice(0, 18) })));
  const last = new Map(points.filter(point => point.name === axes.at(-1)).map(point => [point.row, point.at]));
  const draw = width => {
    const most = Math.max(Math.floor(width / 90), 2); // whose words fit
    const shown = axes.length > most ? [...axes.slice(0, most - 1), axes.at(-1)] : axes;
    const room = (width - 100) / (shown.length - 1) / 7.5; // characters
    return openByClick(point => open(point.row), Plot.plot(base(width, 320, {
      marginLeft: 50, marginRight: 50, x: { domain: shown, type: 'point', label: null, tickSize: 0, tickFormat: name => { const words = name.replace(/\.name$/, '').split('.').slice(-2); return shorten(words.join('.').length < room ? words.join('.') : words.at(-1), Math.floor(room)); } }, y: { axis: null, domain: [0, 1] }, color: { type: 'identity' },
      marks: [
        Plot.ruleX(shown, { stroke: 'var(--line)' }),
        Plot.line(points.filter(point => shown.includes(point.name)), { x: 'name', y: 'at', z: 'row', stroke: point => (last.has(point.row) ? colour(last.get(point.row)) : 'var(--faint)'), strokeOpacity: 0.75, strokeWidth: 1.4 }),
        Plot.text(ticks.filter(tick => shown.includes(tick.name)), { x: 'name', y: 'at', text: 'text', dx: 4, textAnchor: 'start', stroke: 'var(--card)', strokeWidth: 4, fill: 'var(--ink)' }),
        tip(points, { x: 'name', y: 'at', title: 'text' }),
      ],
    })));
  };
  return figure(`${rows.length} lines over ${axes.join(', ')}; coloured by ${axes.at(-1)}`, draw, legendKey('', `${axes.at(-1)}: orange is low, blue is high`));
}

// When each trial ran: { number, began, ended, kind, text }, in seconds.
export function spans(rows, { label }) {
  const start = Math.min(...rows.map(row => row.began));
  const [unit, size] = Math.max(...rows.map(row => row.ended)) - start < 7200 ? ['minutes', 60] : ['hours', 3600];
  const at = time => (time - start) / size;
  const colour = row => ({ done: 'var(--good)', failed: 'var(--bad)', running: 'var(--series0)' })[row.kind] ?? 'var(--faint)';
  const draw = width => Plot.plot(base(width, Math.min(Math.max(60 + 9 * rows.length, 170), 480), {
    x: { label: unit, grid: true, ticks: Math.min(width / 90, 8) }, y: { label: 'trial', reverse: true, nice: true, ticks: 6, tickFormat: '~r' },
    marks: [
      Plot.link(rows, { x1: row => at(row.began), x2: row => at(row.ended), y1: 'number', y2: 'number', stroke: colour, strokeWidth: 4, strokeLinecap: 'round' }),
      tip(rows, { x: row => at(row.began), y: 'number', title: 'text' }),
    ],
  }));
  return figure(`${label}: ${rows.map(row => row.text).join('; ')}`, draw, [...new Set(rows.map(row => row.kind))].map(kind => legendKey('●', kind, colour({ kind }))));
}

// Errors over time; a click goes to a moment. The style property --now, from 0 to 1, places a line.
export function timeline(values, { fps, label, go, marks, colours }) {
  const points = values.flatMap((one, i) => one.errors.map((error, frame) => ({ time: frame / fps, error, name: one.name, i })));
  const draw = width => {
    const plot = Plot.plot(base(width, 130, {
      marginBottom: 28, x: { label: null, domain: [0, Math.max(values[0].errors.length - 1, 1) / fps] }, y: { label, grid: true, ticks: 3, zero: true, nice: true },
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
