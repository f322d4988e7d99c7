// The filter of runs: words, and conditions such as memory=gru, seed!=0, stream.MPJPE<6.3, tag=good; all must hold.

import { about } from './store.js';

const CONDITION = /^([\w.\- ]*?[\w.\-])(<=|>=|!=|=|<|>)(.*)$/;
const PLACES = ['sweep', 'arm', 'search', 'trial'];
const OWN = ['id', 'name', 'status', 'kind', 'device', 'note', 'started', 'code', 'data'];

export function parse(text) {
  const words = text.match(/(?:[^\s"]|"[^"]*")+/g) ?? [];
  const kept = words.map(word => word.replaceAll('"', '')).filter(word => word && !/^(and|AND|&&)$/.test(word));
  return kept.map(test);
}

export function matches(tests, run) {
  return tests.every(one => one(run));
}

function test(word) {
  const found = word.match(CONDITION);
  if (!found) {
    const wanted = word.toLowerCase();
    return run => run.text.includes(wanted);
  }
  const [, key, sign, wanted] = found;
  const values = reader(key);
  return run => values(run).some(value => compare(value, sign, wanted)) !== (sign === '!=');
}

// What gives a run's values under a name, which may be the end of a dotted key.
function reader(key) {
  if (key === 'tag' || key === 'tags') return run => run.tags;
  if (PLACES.includes(key)) return run => run.places.map(place => place[key]).filter(value => value !== undefined);
  if (OWN.includes(key)) return run => [run[key]];
  const near = name => name === key || name === `${key}.name`;
  const far = name => name.endsWith(`.${key}`) || name.replace('.rotation.', '.') === key;
  for (const fits of [near, far]) {
    for (const [group, names] of [['config', about.keys], ['metrics', about.metrics]]) {
      const name = names.find(fits);
      if (name !== undefined) return run => [run[group][name]];
    }
  }
  return () => [];
}

function compare(value, sign, wanted) {
  const same = same_(value, wanted);
  if (sign === '=' || sign === '!=') return same;
  const [a, b] = [typeof value === 'number' ? value : NaN, Number(wanted)];
  return { '<': a < b, '>': a > b, '<=': a <= b, '>=': a >= b }[sign];
}

function same_(value, wanted) {
  if (typeof value === 'number' && wanted.trim() !== '') return value === Number(wanted);
  const text = value === null || value === undefined ? 'null' : Array.isArray(value) ? `[${value}]` : String(value);
  const pattern = wanted.toLowerCase().split('*').map(part => part.replace(/[.*+?^${}()|[\]\\]/g, '\\$&')).join('.*');
  return new RegExp(`^${pattern}$`).test(text.toLowerCase());
}
