// From the address to a page, and the bar above all pages.

import { h, replace, link, empty, say } from './dom.js';
import { about, follow, inFile, load, place } from './store.js';
import * as runs from './runs.js';
import * as run from './run.js';
import * as sweeps from './sweeps.js';
import * as searches from './searches.js';

const PAGES = {
  runs: runs.page, run: run.page, compare: runs.page, sweeps: sweeps.page, sweep: sweeps.single, tables: sweeps.tables,
  searches: searches.page, search: searches.single,
};
const TABS = [['runs', 'Runs'], ['sweeps', 'Sweeps'], ['tables', 'Tables'], ['searches', 'Searches']];
const PARENT = { run: 'runs', compare: 'runs', sweep: 'sweeps', search: 'searches' };
const content = document.getElementById('content');
let current = null;
let shown = null;

async function show() {
  const { page: kind, name, query } = place();
  const key = `${kind}/${name}`;
  const other = key !== shown;
  shown = key;
  current?.close?.();
  current = null;
  const tab = PARENT[kind] ?? kind;
  replace(document.querySelector('header nav'), TABS.map(([one, text]) => h('a', { href: `#/${one}`, 'aria-current': one === tab ? 'page' : null }, text)));
  if (other) replace(content, h('p', { class: 'wait' }, 'Loading'));
  try {
    if (!(kind in PAGES)) throw new Error('There is no such page.');
    const page = await PAGES[kind](name, query);
    if (shown !== key) { page.close?.(); return; }
    current = page;
    document.title = `${page.title} · memmlp`;
    replace(content, page.element);
    if (other) { scrollTo(0, 0); content.querySelector('h1')?.setAttribute('tabindex', '-1'); say(page.title); }
  } catch (error) {
    if (shown !== key) return;
    document.title = 'Not shown · memmlp';
    replace(content, empty('This page cannot be shown.', h('p', {}, error.message), h('p', {}, link(`#/${tab in PAGES ? tab : 'runs'}`, 'Back'))));
    say(error.message);
    if (!error.missing) console.warn(error);
  }
}

const showStatus = (textContent, className = '') => Object.assign(document.getElementById('status'), { textContent, className });

addEventListener('hashchange', show);
document.querySelector('.skip').addEventListener('click', event => { event.preventDefault(); content.focus(); });
showStatus(inFile ? 'a file' : 'connecting');
await load().catch(error => replace(content, empty('The runs cannot be shown.', h('p', {}, error.message))));
await show();
document.documentElement.dataset.ready = '';
follow((connected, changed) => {
  showStatus(...(!connected ? ['not connected', 'gone'] : about.unread ? [`reading ${about.unread} more runs`] : ['live', 'live']));
  if (changed) current?.update?.();
});
