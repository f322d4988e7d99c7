// Changes of runs that the page asks the server for, and commands to copy.

import { h, replace, say } from './dom.js';
import { about, ask, inFile, load, nameOf, runs } from './store.js';
import { ACTIVE, BROKEN } from './state.js';

export const canChange = () => !inFile && about.writable;

// Ask for a change, { action, runs, value, name }, and read the runs again. Throws an Error with the server's message.
export async function change(request) {
  const headers = { 'Content-Type': 'application/json', 'X-Memmlp-Token': document.querySelector('meta[name=change-token]').content };
  const response = await fetch('api/change', { method: 'POST', headers, body: JSON.stringify(request) });
  if (!response.ok) throw new Error((await response.json()).error ?? response.statusText);
  await load();
}

// Ask for a value, or for a confirmation without a field. do(value) may throw an Error, which is shown.
export function dialog(title, { field = null, value = '', lines = [], word = 'Save', act }) {
  const input = field === null ? null : h(field, { class: 'wide', 'aria-label': title });
  if (input) input.value = value;
  const trouble = h('p', { class: 'bad', role: 'alert' });
  const close = () => { box.close(); box.remove(); };
  const submit = async event => {
    event.preventDefault();
    await Promise.resolve().then(() => act(input?.value ?? '')).then(close, error => replace(trouble, error.message));
  };
  const box = h('dialog', { 'aria-label': title }, h('form', { onsubmit: submit }, h('h2', {}, title), lines.map(line => h('p', {}, line)), input, trouble,
    h('div', { class: 'bar' }, h('button', { class: 'primary', style: word === 'Delete' && '--accent: var(--bad)' }, word), word === 'Close' ? null : h('button', { type: 'button', onclick: close }, 'Cancel'))));
  box.addEventListener('cancel', () => box.remove());
  document.body.append(box);
  box.showModal();
}

export const button = (text, onclick, title) => h('button', { type: 'button', class: 'small', onclick, title }, text);

// Copy a text; where the browser does not allow it, show it to copy.
export async function copy(text) {
  await navigator.clipboard.writeText(text).then(() => say('Copied'), () => dialog('Copy', { field: 'textarea', value: text, word: 'Close', act: () => {} }));
}

// A command with a button that copies it.
export const command = text => h('div', { class: 'command' }, h('pre', {}, text), button('Copy', () => copy(text)));

async function showCommands(ids) {
  const text = (await Promise.all(ids.map(id => ask(`command/${id}`)))).map(found => found.command).join('\n');
  dialog('What trains this again', { field: 'textarea', value: text, word: 'Copy', act: () => copy(text) });
}

async function askToDelete(ids, done) {
  const found = await Promise.all(ids.map(id => ask(`dependents/${id}`)));
  const lines = found.flatMap(({ lines }, i) => lines.map(line => `${nameOf(runs.get(ids[i]))}: ${line}.`));
  dialog(`Delete ${ids.length === 1 ? nameOf(runs.get(ids[0])) : `${ids.length} runs`}?`, {
    lines: [...lines.length ? lines : ['Nothing depends on it.'], 'The files cannot be restored.'], word: 'Delete', act: async () => { await change({ action: 'delete', runs: ids }); done(true); },
  });
}

// Buttons for some runs. done(deleted): called after a change.
export function buttons(ids, done) {
  const list = ids.map(id => runs.get(id)).filter(Boolean);
  if (!list.length) return [];
  const guard = work => async () => { try { await work(); } catch (error) { dialog('Not done', { lines: [error.message], word: 'Close', act: () => {} }); } };
  const send = (action, some, value) => guard(async () => { await change({ action, runs: some.map(run => run.id), value }); done(); });
  const edit = (title, action, field, value) => button(title, () => dialog(title, { field, value, act: async text => { await change({ action, runs: ids, value: text }); done(); } }));
  const unfinished = list.filter(run => (ACTIVE.includes(run.status) || ['lost', 'interrupted', 'trained', 'new'].includes(run.status)) && !run.stopping);
  const waiting = list.filter(run => run.stopping || BROKEN.includes(run.status));
  const [one] = list;
  const single = list.length === 1;
  return [
    list.some(run => run.kind === 'memmlp') && !inFile ? button('Command', guard(() => showCommands(list.filter(run => run.kind === 'memmlp').map(run => run.id))), 'The commands that train these runs') : null,
    ...(canChange() ? [
      unfinished.length ? button('Stop', send('stop', unfinished), 'Its worker writes a checkpoint at the next step, and stops') : null,
      unfinished.length ? one.prioritized ? button('No priority', send('unprioritize', unfinished)) : button('Prioritise', send('prioritize', unfinished), 'The workers of its sweep take it next') : null,
      waiting.length ? button('Retry', send('retry', waiting), 'The workers of its sweep continue it; otherwise repeat its command') : null,
      single ? edit('Name', 'name', 'input', nameOf(one)) : null, edit('Tags', 'tags', 'input', one.tags.join(' ')), edit('Note', 'note', 'textarea', single ? one.note : ''),
      one.archived ? button('Restore', send('restore', list)) : button('Archive', send('archive', list), 'Hide it; its files stay'),
      button('Delete', guard(() => askToDelete(list.map(run => run.id), done))),
    ] : []),
  ];
}
