// Elements made of data. Data only ever becomes text or an attribute's value, never markup.

// A new element: h('a', { href: '#', class: 'x', onclick: go }, 'text', child, ...).
export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties ?? {})) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith('on')) element.addEventListener(name.slice(2), value);
    else if (name in element && typeof value !== 'string') element[name] = value;
    else element.setAttribute(name, value === true ? '' : value);
  }
  element.append(...children.flat(Infinity).filter(child => child !== null && child !== undefined && child !== false));
  return element;
}

export function replace(element, ...children) {
  element.replaceChildren(...children.flat(Infinity).filter(child => child !== null && child !== undefined && child !== false));
  return element;
}

export function link(href, ...children) {
  return h('a', { href }, ...children);
}

export function select(label, options, chosen, choose) {
  const list = h('select', { onchange: event => choose(event.target.value) },
    options.map(([value, text]) => h('option', { value, selected: value === chosen }, text)));
  return h('label', { class: 'field' }, h('span', {}, label), list);
}

export function section(title, ...children) {
  return h('section', {}, h('h2', {}, title), ...children);
}

// A table. A content is text, an element, or a whole cell; the first column has the rows' heads, and `n` aligns the others right.
export function table(heads, rows, { n = true, kind = '', scroll = 'scroll short', caption = null, file = 'table' } = {}) {
  const cell = (content, i, head) => (content instanceof HTMLTableCellElement ? content
    : h(head || !i ? 'th' : 'td', { scope: head ? 'col' : i ? null : 'row', class: i && n ? 'n' : null }, content));
  const line = (contents, head) => h('tr', {}, contents.map((content, i) => cell(content, i, head)));
  const grid = h('table', { class: `grid ${kind}` }, caption && h('caption', {}, caption),
    heads && h('thead', {}, line(heads, true)), h('tbody', {}, rows.map(row => line(row))));
  const save = (text, onclick) => h('button', { type: 'button', title: `Save this table as ${text}`, onclick }, text);
  const saves = heads && h('span', { class: 'save' }, save('CSV', () => download(`${file}.csv`, toCsv(grid))), save('PNG', () => savePng(`${file}.png`, grid)));
  return h('div', { class: 'saved' }, saves, h('div', { class: scroll }, grid));
}

// Save an element as a picture, as it is shown now.
export async function savePng(name, element) {
  const [width, height] = [element.scrollWidth + 16, element.scrollHeight + 16];
  const style = `color-scheme: ${matchMedia('(prefers-color-scheme: dark)').matches ? 'dark' : 'light'}`;
  const rules = [...document.styleSheets].flatMap(sheet => [...sheet.cssRules]).flatMap(rule => (!rule.media ? rule : matchMedia(rule.media.mediaText).matches ? [...rule.cssRules] : [])).map(rule => rule.cssText).join('\n');
  const copy = h('div', { style: `${style}; padding: 8px; height: 100%; background: var(--card); color: var(--ink); font: 14px/1.5 system-ui, sans-serif` }, h('style', {}, rules), element.cloneNode(true));
  const space = new DOMParser().parseFromString('<svg>', 'text/html').body.firstChild.namespaceURI;
  const drawn = `<svg xmlns="${space}" width="${width}" height="${height}" style="${style}"><foreignObject width="100%" height="100%">${new XMLSerializer().serializeToString(copy)}</foreignObject></svg>`;
  const image = Object.assign(new Image(), { src: `data:image/svg+xml,${encodeURIComponent(drawn)}` });
  await image.decode();
  const scale = Math.min(2, 16000 / Math.max(width, height));
  const canvas = Object.assign(document.createElement('canvas'), { width: scale * width, height: scale * height });
  canvas.getContext('2d').drawImage(image, 0, 0, canvas.width, canvas.height);
  canvas.toBlob(blob => download(name, blob));
}

// A table as CSV: the cells' data-csv, or else their text. A text that a spreadsheet would run as a formula begins with '.
export function toCsv(grid) {
  const text = cell => cell.dataset.csv ?? [...cell.childNodes].map(node => node.textContent).join(' ').replace(/\s+/g, ' ').trim().replace(/^\u2212(?=\d)/, '-');
  const guard = one => (/^[=+@\t\r']|^-(?!\d)/.test(one) ? `'${one}` : one);
  const field = one => (/[",\n\r]/.test(one) ? `"${one.replaceAll('"', '""')}"` : one);
  const cells = row => [...row.cells].filter(cell => !cell.matches('.pick'));
  return [...grid.rows].map(row => cells(row).map(cell => field(guard(text(cell)))).join(',')).join('\r\n') + '\r\n';
}

export function download(name, content) {
  const href = URL.createObjectURL(new Blob([content], { type: content.type ?? 'text/csv' }));
  h('a', { href, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(href), 10000);
}

export function empty(title, ...children) {
  return h('div', { class: 'empty' }, h('p', { class: 'lead' }, title), ...children);
}

// A page of linked cards, [address, title, subtitle, content], or what to do without any.
export function cards(title, list, none) {
  const items = list.map(([href, head, subtitle, content]) => h('li', {}, h('a', { class: 'card', href }, h('span', { class: 'card-title' }, head), h('span', { class: 'faint' }, subtitle), content)));
  return [h('div', { class: 'bar' }, h('h1', {}, title), h('p', { class: 'count' }, list.length)), list.length ? h('ul', { class: 'cards' }, items) : none];
}

// Tell a screen reader what changed on the page.
export function say(text) {
  document.getElementById('said').textContent = text;
}
