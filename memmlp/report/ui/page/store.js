// What the page knows: the runs, kept up to date by the server's news; other answers by their addresses.

const embedded = document.getElementById('answers');
const answers = embedded ? JSON.parse(embedded.textContent) : null;
export const alone = answers !== null; // the page is a file without a server

export const runs = new Map();
export const about = { keys: [], minor: [], paths: [], metrics: [], units: {}, sets: {}, shared: [], outputs: '', generation: 0, heads: '' };
const listeners = new Set();
let state = alone ? 'file' : 'connecting';

// The answer to a question such as 'run/0123...'. Throws an Error with the server's words.
export async function ask(path) {
  if (alone) {
    if (path in answers) return answers[path];
    const error = new Error('This is not in the file; memmlp ui has it.');
    error.missing = true;
    throw error;
  }
  const response = await fetch(`api/${path}`);
  const found = await response.json();
  if (!response.ok) throw new Error(found.error ?? response.statusText);
  return found;
}

export async function curvesOf(ids, names) {
  const wanted = ids.slice(0, 60);
  if (alone) {
    const found = answers.curves ?? {};
    return Object.fromEntries(wanted.filter(id => id in found).map(id => [id, found[id]]));
  }
  const query = new URLSearchParams({ runs: wanted.join(',') });
  if (names) query.set('names', names.join('|'));
  return (await ask(`curves?${query}`)).curves;
}

export async function load() {
  const query = alone || !about.generation ? '' : `?since=${about.generation}&heads=${about.heads}`;
  const found = await ask(`runs${query}`);
  const { rows, removed, whole, ...rest } = found;
  Object.assign(about, rest);
  if (whole) runs.clear();
  for (const id of removed ?? []) runs.delete(id);
  for (const row of rows) runs.set(row.id, readable(row));
}

// A run's data by name and short digest; its digest alone where no config names it.
export const dataName = data => about.sets[data] ?? data;

// A run's name, with its data where runs of other data have the same name.
export const nameOf = run => (about.shared.includes(run.name) ? `${run.name} · ${dataName(run.data) || 'unknown data'}` : run.name);

// A row with its config and metrics by name, and the text in which words are looked for.
function readable(row) {
  const config = Object.fromEntries(about.keys.map((key, i) => [key, row.config[i]]));
  const metrics = Object.fromEntries(about.metrics.map((key, i) => [key, row.metrics[i]]));
  const words = [
    row.id, row.name, row.status, row.kind, row.device, row.note, row.failure, dataName(row.data), ...row.tags,
    ...row.places.flatMap(place => Object.values(place).map(String)), ...about.keys.map((key, i) => `${key}=${row.config[i]}`),
  ];
  // What runs are compared by: of paths of data the data's digest, as one folder has many spellings.
  const cells = Object.fromEntries(about.keys.map((key, i) => [key, about.paths.includes(key) ? row.data : JSON.stringify(row.config[i] ?? null)]));
  return { ...row, config, cells, metrics, text: words.join('\n').toLowerCase() };
}

export const connection = () => state;

export function listen(listener) {
  listeners.add(listener);
  return () => listeners.delete(listener);
}

const tell = what => { for (const listener of listeners) listener(what); };

// Follow the server's news; what comes while the last ones are being fetched is fetched after them.
export function follow() {
  if (alone) return;
  const events = new EventSource('events');
  let busy = false;
  let more = false;
  const refresh = async () => {
    if (busy) { more = true; return; }
    busy = true;
    try {
      await load();
      tell('news');
    } catch (error) {
      console.warn(error);
    }
    busy = false;
    if (more) { more = false; refresh(); }
  };
  events.onopen = () => { state = 'live'; tell('state'); };
  events.onerror = () => { state = 'gone'; tell('state'); };
  events.onmessage = refresh;
}

// The page that is shown where the address names none: of a report its tables and figures.
const first = document.getElementById('extra')?.innerHTML.trim() ? 'extra' : 'runs';

// The address: #/room/name?key=value
export function place() {
  const [path, query = ''] = location.hash.replace(/^#\/?/, '').split('?');
  const [room = '', ...rest] = path.split('/').map(part => decodeURIComponent(part));
  return { room: room || first, name: rest.join('/'), query: new URLSearchParams(query) };
}

export function address(room, name = '', query = {}) {
  const words = new URLSearchParams(Object.entries(query).filter(([, value]) => value !== '' && value !== null && value !== undefined));
  const path = [room, name].filter(Boolean).map(encodeURIComponent).join('/');
  return `#/${path}${words.size ? `?${words}` : ''}`;
}

// Change what the address says of the page, without a new entry in the history.
export function remember(changes) {
  const { room, name, query } = place();
  const next = { ...Object.fromEntries(query), ...changes };
  history.replaceState(null, '', address(room, name, next));
}
