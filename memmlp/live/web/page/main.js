// The pages by their addresses, the site's contents, and whether it works offline.

import { h, replace } from './dom.js';
import { play } from './play.js';
import { wear } from './wear.js';

const PAGES = { wear, play };
const content = document.getElementById('content');
let leave = () => {};
let home = 'wear';

async function begin() {
  try {
    const answer = await fetch('site.json');
    if (!answer.ok) throw new Error(`site.json: the server answers ${answer.status}`);
    const site = await answer.json();
    about(site);
    if (!(await wearable())) home = 'play';
    addEventListener('hashchange', () => show(site));
    show(site);
  } catch (error) {
    replace(content, h('p', { class: 'wait' }, `The site cannot be read: ${error.message}.`));
  }
  offline();
}

// Whether this browser can enter VR or AR; if not, the site opens on the clips.
async function wearable() {
  const asked = ['immersive-vr', 'immersive-ar'].map(mode => navigator.xr?.isSessionSupported(mode).catch(() => false) ?? false);
  return (await Promise.all(asked)).some(Boolean);
}

function show(site) {
  const named = location.hash.replace(/^#\//, '').split('?')[0];
  const name = named in PAGES ? named : home;
  leave();
  document.title = `memmlp ${name}`;
  for (const link of document.querySelectorAll('.top nav a')) {
    if (link.hash === `#/${name}`) link.setAttribute('aria-current', 'page');
    else link.removeAttribute('aria-current');
  }
  const page = h('div', { class: `page ${name}` });
  replace(content, page);
  leave = PAGES[name](page, site) ?? (() => {});
}

function about(site) {
  const versions = Object.entries(site.packages).map(([name, version]) => `${name} ${version}`);
  document.querySelector('.about').textContent =
    `memmlp ${site.memmlp}, ${versions.join(', ')} (MIT licences). Made ${site.made.slice(0, 10)}. Nothing leaves this page.`;
}

// The service worker keeps the site in the browser; only https and this machine itself may have one.
async function offline() {
  const status = document.getElementById('status');
  if (!navigator.serviceWorker) {
    status.textContent = 'needs the server';
    status.title = 'Works offline, and with a headset, at an https address or at localhost';
    return;
  }
  const had = navigator.serviceWorker.controller !== null;
  navigator.serviceWorker.addEventListener('controllerchange', () => {
    if (had) replace(status, h('a', { href: '', onclick: () => location.reload() }, 'new version: reload'));
  });
  try {
    await navigator.serviceWorker.register('sw.js');
    await navigator.serviceWorker.ready;
    status.textContent = 'works offline';
    status.className = 'live';
    document.documentElement.dataset.offline = 'ready';
  } catch (error) {
    status.textContent = 'needs the server';
    status.title = error.message;
  }
}

begin();
