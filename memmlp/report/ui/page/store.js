// What the page knows: the runs, read again when they change; other answers by their addresses.

import { shortNames } from './format.js';

const embedded = document.getElementById('answers');
const answers = embedded ? JSON.parse(embedded.textContent) : null;
export const inFile = answers !== null; // the page is a file without a server
export const generated = answers?.about ?? '';

export const runs = new Map();
export const about = { unread: 0, keys: [], minor: [], paths: [], metrics: [], units: {}, outputs: '', state: '', preparing: [], after: null, writable: false };
const PAUSE = 1000; // milliseconds between two questions for changes
let dataNames = new Map();
let ambiguous = new Set(); // names of runs on several data sets
let short = new Map(); // names with rounded numbers

// The answer to a question such as 'run/0123...'. Throws an Error with the server's message.
export async function ask(path) {
  if (inFile) {
    if (path in answers) return answers[path];
    throw Object.assign(new Error('This is not in the file; memmlp ui has it.'), { missing: true });
  }
  const response = await fetch(`api/${path}`);
  const found = await response.json();
  if (!response.ok) throw new Error(found.error ?? response.statusText);
  return found;
}

export async function curvesOf(ids) {
  const wanted = ids.slice(0, 60);
  if (!inFile) return (await ask(`curves?${new URLSearchParams({ runs: wanted.join(',') })}`)).curves;
  return Object.fromEntries(wanted.filter(id => id in answers.curves).map(id => [id, answers.curves[id]]));
}

// Read the runs again; return whether anything has changed.
export async function load() {
  const { rows, all, ...rest } = await ask(inFile ? 'runs' : `runs?state=${about.state}`);
  if (!rows) return false;
  Object.assign(about, rest);
  if (all) runs.clear();
  for (const row of rows) runs.set(row.id, readable(row));
  // A VQ-VAE's config does not name its data; that of a network on the same data does.
  dataNames = new Map([...runs.values()].filter(run => run.data && run.data_name).map(run => [run.data, `${run.data_name} ${run.data}`]));
  const seen = new Map();
  for (const run of runs.values()) seen.set(run.name, (seen.get(run.name) ?? new Set()).add(run.data));
  short = shortNames([...seen.keys()]);
  ambiguous = new Set([...seen].filter(([, data]) => data.size > 1).map(([name]) => name));
  return true;
}

export const dataName = data => dataNames.get(data) ?? data;
export function nameOf(run) {
  const name = short.get(run.name) ?? run.name;
  return ambiguous.has(run.name) ? `${name} · ${dataName(run.data) || 'unknown data'}` : name;
}

// A row with its config and metrics by name, and the text in which words are looked for.
function readable(row) {
  const config = Object.fromEntries(about.keys.map((key, i) => [key, row.config[i]]));
  const metrics = Object.fromEntries(about.metrics.map((key, i) => [key, row.metrics[i]]));
  const words = [
    row.id, row.name, row.status, row.kind, row.device, row.note, row.failure, row.data_name, row.data, ...row.tags,
    ...row.places.flatMap(place => Object.values(place).map(String)), ...about.keys.map((key, i) => `${key}=${row.config[i]}`),
  ];
  // Runs are compared by these; a path of data counts as the data's digest, since one folder has many spellings.
  const cells = Object.fromEntries(about.keys.map((key, i) => [key, about.paths.includes(key) ? row.data : JSON.stringify(row.config[i] ?? null)]));
  return { ...row, config, cells, metrics, text: words.join('\n').toLowerCase() };
}

// Ask the server for changes again and again. update(connected, changed): called with each answer.
export async function follow(update) {
  while (!inFile) {
    await load().then(changed => update(true, changed), () => update(false, false));
    await new Promise(done => setTimeout(done, about.unread ? 0 : PAUSE));
  }
}

// The address: #/page/name?key=value
export function place() {
  const [path, query = ''] = location.hash.replace(/^#\/?/, '').split('?');
  const [page, ...rest] = path.split('/').map(decodeURIComponent);
  return { page: page || (inFile ? 'tables' : 'runs'), name: rest.join('/'), query: new URLSearchParams(query) };
}

export function address(page, name = '', query = {}) {
  const words = new URLSearchParams(Object.entries(query).filter(([, value]) => value !== '' && value !== null && value !== undefined));
  return `#/${[page, name].filter(Boolean).map(encodeURIComponent).join('/')}${words.size ? `?${words}` : ''}`;
}

// Change the query of the address, without a new entry in the history.
export function remember(changes) {
  const { page, name, query } = place();
  history.replaceState(null, '', address(page, name, { ...Object.fromEntries(query), ...changes }));
}
