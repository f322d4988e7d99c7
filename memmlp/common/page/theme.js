// Light or dark: as the system has it, unless the switch says otherwise. The choice is remembered in this browser.

(() => {
  const NEXT = { system: 'light', light: 'dark', dark: 'system' };
  const root = document.documentElement;

  function kept() {
    try {
      return localStorage.getItem('memmlp theme');
    } catch { // a browser that keeps nothing, or a file
      return null;
    }
  }

  function choose(theme) {
    root.dataset.theme = theme;
    try {
      localStorage.setItem('memmlp theme', theme);
    } catch { /* it holds until the page is closed */ }
    name();
    dispatchEvent(new Event('theme'));
  }

  function name() {
    const button = document.getElementById('theme');
    button.title = `Colours: ${{ system: 'as the system has them', light: 'light', dark: 'dark' }[root.dataset.theme]}`;
    button.setAttribute('aria-label', `${button.title}; change to ${NEXT[root.dataset.theme]}`);
  }

  root.dataset.theme = kept() in NEXT ? kept() : 'system';
  addEventListener('DOMContentLoaded', () => {
    name();
    document.getElementById('theme').addEventListener('click', () => choose(NEXT[root.dataset.theme]));
  });
})();
