// Light or dark: the system's setting, unless the switch at the top chooses; the choice is remembered in this browser.

(() => {
  const NEXT = { system: 'light', light: 'dark', dark: 'system' };
  const KEY = 'memmlp theme';
  const root = document.documentElement;
  const attempt = work => { try { return work(); } catch { return null; } }; // some browsers do not store anything

  function name() {
    const button = document.getElementById('theme');
    button.title = `Colours: ${root.dataset.theme}`;
    button.setAttribute('aria-label', `${button.title}; change to ${NEXT[root.dataset.theme]}`);
  }

  function choose() {
    root.dataset.theme = NEXT[root.dataset.theme];
    attempt(() => localStorage.setItem(KEY, root.dataset.theme));
    name();
    dispatchEvent(new Event('theme'));
  }

  const stored = attempt(() => localStorage.getItem(KEY));
  root.dataset.theme = stored in NEXT ? stored : 'system';
  addEventListener('DOMContentLoaded', () => {
    name();
    document.getElementById('theme').addEventListener('click', choose);
  });
})();
