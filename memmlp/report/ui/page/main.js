// The way from the address to a page, and the bar above all pages.

import { h, replace, link, empty, say } from './dom.js';
import { alone, ask, connection, follow, listen, load, place } from './store.js';
import * as runs from './runs.js';
import * as run from './run.js';
import * as compare from './compare.js';
import * as sweeps from './sweeps.js';
import * as searches from './searches.js';

const ROOMS = { runs: runs.page, run: run.page, compare: compare.page, sweeps: sweeps.page, sweep: sweeps.single, searches: searches.page, search: searches.single, extra };
const PAGES = [['runs', 'Runs'], ['sweeps', 'Sweeps'], ['searches', 'Searches']];
const PARENT = { run: 'runs', compare: 'runs', sweep: 'sweeps', search: 'searches' };
const template = document.getElementById('extra');
if (template?.innerHTML.trim()) PAGES.unshift(['extra', 'Tables and figures']);

let current = null;
let shown = null;

// The tables and figures that memmlp report made, as it made them.
function extra() {
  const element = h('div', { class: 'extra' }, template.content.cloneNode(true));
  element.addEventListener('click', event => { // a link to a part of it: what follows # is a room of this page
    const link = event.target.closest('a[href^="#"]');
    const part = link && element.querySelector(`[id="${CSS.escape(link.getAttribute('href').slice(1))}"]`);
    if (!part) return;
    event.preventDefault();
    part.scrollIntoView();
  });
  return { title: 'Tables and figures', element };
}

async function show() {
  const { room, name, query } = place();
  const key = `${room}/${name}`;
  const anew = key !== shown;
  shown = key;
  current?.close?.();
  current = null;
  const content = document.getElementById('content');
  navigation(room);
  if (anew) replace(content, h('p', { class: 'wait' }, 'Loading'));
  try {
    const page = await (ROOMS[room] ?? unknown)(name, query);
    if (shown !== key) { page.close?.(); return; }
    current = page;
    document.title = `${page.title} · memmlp`;
    replace(content, page.element);
    if (anew) { scrollTo(0, 0); content.querySelector('h1')?.setAttribute('tabindex', '-1'); say(page.title); }
  } catch (error) {
    if (shown !== key) return;
    document.title = 'Not shown · memmlp';
    replace(content, empty('This page cannot be shown.', h('p', {}, error.message), h('p', {}, link(`#/${PARENT[room] ?? 'runs'}`, `All ${PARENT[room] ?? 'runs'}`))));
    say(error.message);
    if (!error.missing) console.warn(error);
  }
}

function unknown() {
  throw new Error('There is no such page.');
}

function navigation(room) {
  const here = PARENT[room] ?? room;
  replace(document.querySelector('header nav'), PAGES.map(([name, text]) =>
    h('a', { href: `#/${name}`, 'aria-current': name === here ? 'page' : null }, text)));
}

function status() {
  const words = { live: 'live', gone: 'not connected', connecting: 'connecting', file: 'a file' }[connection()];
  const element = document.getElementById('status');
  element.className = connection();
  if (element.textContent !== words) element.textContent = words;
}

addEventListener('hashchange', show);
document.querySelector('.skip').addEventListener('click', event => {
  event.preventDefault();
  document.getElementById('content').focus();
});
listen(what => {
  status();
  if (what === 'news') current?.update?.();
});
addEventListener('keydown', event => {
  if (event.key !== '/' || event.target.closest('input, select, textarea')) return;
  const filter = document.querySelector('input[type=search]');
  if (filter) { event.preventDefault(); filter.focus(); filter.select(); }
});

status();
try {
  await load();
} catch (error) {
  replace(document.getElementById('content'), empty('The runs cannot be shown.', h('p', {}, error.message)));
}
await show();
document.documentElement.dataset.ready = String(Math.round(performance.now()));
follow();
if (alone) document.documentElement.dataset.alone = '';
