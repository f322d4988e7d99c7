// The pages by their addresses, the site's contents, and whether it works offline.

import { h, replace } from './dom.js';
import { play } from './play.js';
import { canEnter, vr } from './vr.js';

const PAGES = { vr, play };
const content = document.getElementById('content');
let leave = () => {};

async function start() {
  try {
    const answer = await fetch('site.json');
    if (!answer.ok) throw new Error(`site.json: the server answers ${answer.status}`);
    const site = await answer.json();
    const versions = Object.entries(site.packages).map(([name, version]) => `${name} ${version}`);
    document.querySelector('.about').textContent =
      `memmlp ${site.memmlp}, ${versions.join(', ')} (MIT licences). Made ${site.made.slice(0, 10)}. Nothing leaves this page.`;
    const home = (await canEnter()).some(Boolean) ? 'vr' : 'play'; // without a headset the site opens on the clips
    addEventListener('hashchange', () => show(site, home));
    show(site, home);
  } catch (error) {
    replace(content, h('p', { class: 'wait' }, `The site cannot be read: ${error.message}.`));
  }
  keepOffline();
}

function show(site, home) {
  const [, address] = location.hash.split('#/');
  const name = address in PAGES ? address : home;
  leave();
  document.title = `memmlp ${name}`;
  for (const link of document.querySelectorAll('.top nav a')) link.ariaCurrent = link.hash === `#/${name}` ? 'page' : null;
  const page = h('div', { class: `page ${name}` });
  replace(content, page);
  leave = PAGES[name](page, site);
}

// The service worker keeps the site in the browser. Only https and localhost can have one.
async function keepOffline() {
  const status = document.getElementById('status');
  try {
    await navigator.serviceWorker.register('sw.js');
    await navigator.serviceWorker.ready;
    Object.assign(status, { textContent: 'works offline', className: 'live' });
    document.documentElement.dataset.offline = 'ready';
  } catch {
    Object.assign(status, { textContent: 'needs the server', title: 'Works offline, and with a headset, at an https address or at localhost' });
  }
}

start();
