// The filter of runs: words, and conditions such as memory=gru, seed!=0, stream.MPJPE<6.3, tag=good; all must hold.

import { about } from './store.js';

const CONDITION = /^([\w.\- ]*?[\w.\-])(<=|>=|!=|=|<|>)(.*)$/;
const PLACES = ['sweep', 'variant', 'search', 'trial'];
const FACTS = ['archived', 'id', 'name', 'status', 'kind', 'device', 'note', 'started', 'code', 'data'];

// The tests of a filter's text, each a function of a run.
export function parse(text) {
  const words = (text.match(/(?:[^\s"]|"[^"]*")+/g) ?? []).map(word => word.replaceAll('"', ''));
  return words.filter(word => word && !/^(and|&&)$/i.test(word)).map(test);
}

export const matches = (tests, run) => tests.every(one => one(run));

function test(word) {
  const found = word.match(CONDITION);
  if (!found) return run => run.text.includes(word.toLowerCase());
  const [, key, sign, wanted] = found;
  const values = reader(key);
  if (!values) return Object.assign(() => sign === '!=', { unknown: key });
  return run => values(run).some(value => compare(value, sign, wanted)) !== (sign === '!=');
}

// A function that gives a run's values under a name, which may be the end of a dotted key; null for an unknown name.
function reader(key) {
  if (key === 'tag' || key === 'tags') return run => run.tags;
  if (PLACES.includes(key)) return run => run.places.map(place => place[key]).filter(value => value !== undefined);
  if (FACTS.includes(key)) return run => (key === 'data' ? [run.data, run.data_name] : [run[key]]);
  const near = name => name === key || name === `${key}.name`;
  const far = name => name.endsWith(`.${key}`) || name.replace('.rotation.', '.') === key;
  for (const fits of [near, far]) {
    for (const [group, names] of [['config', about.keys], ['metrics', about.metrics]]) {
      const name = names.find(fits);
      if (name !== undefined) return run => [run[group][name]];
    }
  }
  return null;
}

function compare(value, sign, wanted) {
  if (sign === '=' || sign === '!=') return equals(value, wanted);
  const [a, b] = [typeof value === 'number' ? value : NaN, Number(wanted)];
  return { '<': a < b, '>': a > b, '<=': a <= b, '>=': a >= b }[sign];
}

function equals(value, wanted) {
  if (typeof value === 'number' && wanted.trim() !== '') return value === Number(wanted);
  const text = value === null || value === undefined ? 'null' : Array.isArray(value) ? `[${value}]` : String(value);
  const pattern = wanted.toLowerCase().split('*').map(part => part.replace(/[.*+?^${}()|[\]\\]/g, '\\$&')).join('.*');
  return new RegExp(`^${pattern}$`).test(text.toLowerCase());
}
