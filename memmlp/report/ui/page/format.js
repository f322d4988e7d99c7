// Numbers, times and names as text.

import { about } from './store.js';

const COSTS = {
  median_ms: 'latency', p95_ms: 'latency p95', pose_median_ms: 'pose latency', ratio_to_yardstick: '× yardstick', macs: 'MACs', onnx_bytes: 'ONNX bytes',
};
export const MINUS = '\u2212';
export const DASH = '\u2013';
export const ARROWS = { lower: '↓', higher: '↑' };

export function number(value, digits) {
  if (value === null || value === undefined || value === '') return DASH;
  if (typeof value !== 'number' || !Number.isFinite(value)) return String(value);
  let text;
  if (digits !== undefined) text = value.toFixed(digits);
  else if (Number.isInteger(value) && Math.abs(value) < 1e15) text = value.toLocaleString('en');
  else if (Math.abs(value) >= 1e5 || Math.abs(value) < 1e-3) text = value.toExponential(2);
  else text = String(Number(value.toPrecision(4)));
  return text.replace('-', MINUS);
}

export function signed(value, digits = Math.abs(value) >= 1000 ? 0 : 2) {
  return value > 0 ? `+${number(value, digits)}` : number(value, digits);
}

// The decimals of an error: two, or as many as show two digits of one below 0.1.
export const decimals = value => (value && Number.isFinite(value) ? Math.max(1 - Math.floor(Math.log10(Math.abs(value))), 2) : 2);

// The decimals of a difference and its interval: those of the variant's value, or as many as a significant one needs for a digit.
export function effectDigits({ mean, holm, level, value }) {
  const size = Math.abs(mean);
  if (size >= 1000) return 0;
  const least = decimals(value);
  return size > 0 && holm !== null && holm < level ? Math.max(least, -Math.floor(Math.log10(size))) : least;
}

// An order from the largest error to the smallest: NaN comes first, a missing error last.
export function largestFirst(one, other) {
  const rank = value => (value === undefined ? -1 : typeof value === 'number' ? value : Infinity);
  const [first, second] = [rank(one), rank(other)];
  return first === second ? 0 : second - first;
}

// A value of a config in few characters.
export function word(value) {
  if (value === null || value === undefined) return DASH;
  if (typeof value === 'number') return value.toString().length > 8 ? number(value) : String(value).replace('-', MINUS);
  return Array.isArray(value) ? value.map(word).join(', ') || '[]' : String(value);
}

// A function that writes the values of a column with as few digits as keep different numbers apart, at least three.
export function columnWords(values) {
  const numbers = [...new Set(values.filter(value => typeof value === 'number' && Number.isFinite(value)))];
  const digits = [3, 4, 5, 6, 8].find(count => new Set(numbers.map(value => value.toPrecision(count))).size === numbers.length) ?? 16;
  return value => (typeof value === 'number' && !Number.isInteger(value) ? String(Number(value.toPrecision(digits))).replaceAll('-', MINUS) : word(value));
}

// Names with their long numbers rounded to three digits, or to as many as keep different names apart.
export function shortNames(names) {
  const written = digits => new Map(names.map(name => [name, name.replace(/\d+\.\d{3,}(e[-+]?\d+)?/gi, text => String(Number(Number(text).toPrecision(digits))))]));
  const apart = [3, 5, 8].map(written).find(found => new Set(found.values()).size === new Set(names).size);
  return apart ?? new Map(names.map(name => [name, name]));
}

export function duration(seconds) {
  if (seconds === null || seconds === undefined) return DASH;
  const units = [[90, 's', 1, 0], [5400, 'min', 60, 0], [129600, 'h', 3600, 1], [Infinity, 'd', 86400, 0]]; // [below, unit, its seconds, digits]
  const [, unit, size, digits] = units.find(([limit]) => seconds < limit);
  return `${(seconds / size).toFixed(digits)} ${unit}`;
}

export function ago(text) {
  const time = Date.parse(text);
  return Number.isNaN(time) ? DASH : `${duration(Math.max((Date.now() - time) / 1000, 0))} ago`;
}

export function date(text) {
  const time = new Date(text);
  return Number.isNaN(time.getTime()) ? DASH : time.toLocaleString(undefined, { dateStyle: 'medium', timeStyle: 'short' });
}

// Bytes with a unit, such as 23.4 MB.
export const bytes = count => window.d3.format('.3~s')(count).replace(/[a-zA-Z]?$/, unit => ` ${unit}B`);

const known = name => about.units[name.split('.').at(-1)] ?? { unit: '', better: '' };

// The parts of a name such as "stream.rotation.MPJPE" in words.
export function metricWords(name) {
  const parts = name.split('.');
  const metric = parts.at(-1);
  const unit = known(name).unit.replace(/^deg$/, '°');
  if (parts[0] === 'latency') return { metric: COSTS[metric] ?? metric, where: '', unit };
  return { metric, where: parts.slice(0, -1).filter(part => part !== 'rotation').join(' '), unit };
}

// 'lower', 'higher', or '' for a metric without a known direction.
export const better = name => known(name).better;

// The best of these numbers of a metric; null for a metric without a known direction.
export function bestOf(name, values) {
  const choose = { lower: Math.min, higher: Math.max }[better(name)];
  return choose && values.length ? choose(...values) : null;
}

export function metricText(name) {
  const { metric, where, unit } = metricWords(name);
  return `${where} ${metric}${unit ? ` [${unit}]` : ''}`.trim();
}

export function metricNumber(name, value) {
  if (typeof value !== 'number') return number(value); // missing, or a word such as nan
  if (value && Math.abs(value) < 0.1) return Math.abs(value) < 1e-3 ? number(value) : number(value, decimals(value));
  const metric = name.split('.').at(-1);
  if (Math.abs(value) >= 1000 || ['parameters', 'macs', 'onnx_bytes'].includes(metric)) return number(Math.round(value));
  return number(value, ['Jitter', 'MPJVE', 'GT Jitter'].includes(metric) ? 1 : 2);
}

// Short heads for dotted keys: the last word, unless another key has it too.
export function shortKeys(keys) {
  const last = key => key.replace(/\.name$/, '').split('.').at(-1);
  const counts = new Map();
  for (const key of keys) counts.set(last(key), (counts.get(last(key)) ?? 0) + 1);
  return new Map(keys.map(key => [key, counts.get(last(key)) > 1 ? key.replace(/\.name$/, '') : last(key)]));
}
