// The list of labels of a live page: of each its colour, opacity, whether it is shown, or alone; a search where there are many.
import { hex, rgbOf } from './color.mjs';

const SEARCHED = 12;  // labels that are seen at a glance

function row({ name, number }, k) {
  const element = document.createElement('li');
  element.dataset.row = k;
  element.innerHTML = '<button class="eye" aria-pressed="true">●</button><input type="color"><span></span><input type="range" min="0" max="1" step="0.01"><button class="solo" aria-pressed="false">solo</button>';
  const [eye, color, text, slider, solo] = element.children;
  text.textContent = text.title = name;  // never markup
  for (const [part, what] of [[eye, 'show'], [color, 'colour of'], [slider, 'opacity of'], [solo, 'solo']]) {
    part.setAttribute('aria-label', `${what} ${name}`);
    part.title = `${what} ${name} (${number})`;
  }
  return element;
}

// {root, select(k): shows a label's row, rows(): of each label number, name, color, and the opacity that is seen}; apply(rows) shows them; `key` of links and `history` as light.mjs has it
export function organs(apply, labels, key, history) {
  const root = document.createElement('div');
  root.className = 'organs';
  root.innerHTML = `<div><button class="undo" aria-label="undo" title="undo (Ctrl+Z)">↶</button><button class="redo" aria-label="redo" title="redo (Ctrl+Y, Ctrl+Shift+Z)">↷</button><input type="search" placeholder="search labels" aria-label="search the labels"><button class="all" title="show all labels">all</button><button class="none" title="hide all labels">none</button></div><ul></ul>`;
  const find = (selector) => root.querySelector(selector), list = find('ul');
  find('[type=search]').hidden = labels.length <= SEARCHED;
  list.append(...labels.map(row));
  let now = { rows: labels.map(({ rgb, opacity }) => ({ rgb, opacity, on: true })), solo: -1 }, due = false, moving = false;

  const seen = () => now.rows.map(({ rgb, opacity, on }, k) => ({ rgb, opacity: (now.solo < 0 ? on : now.solo === k) ? opacity : 0 }));

  // opacity on a cubic scale, as the function's
  function show() {
    now.rows.forEach(({ rgb, opacity, on }, k) => {
      const [eye, color, , slider, solo] = list.children[k].children, seen = now.solo < 0 ? on : now.solo === k;
      eye.setAttribute('aria-pressed', String(on));
      solo.setAttribute('aria-pressed', String(now.solo === k));
      list.children[k].classList.toggle('off', !seen);
      color.value = hex(rgb);
      slider.value = Math.cbrt(opacity);
    });
    history.changed(false);
    if (due) return;
    due = true;
    requestAnimationFrame(() => {
      due = false;
      apply(seen());
    });
  }

  const change = (k, by) => { now = { ...now, rows: now.rows.map((one, j) => (j === k ? { ...one, ...by } : one)) }; };
  const every = (on) => { now = { rows: now.rows.map((one) => ({ ...one, on })), solo: -1 }; };
  const rowOf = (target) => Number(target.closest('li').dataset.row);
  root.addEventListener('click', ({ target }) => {
    if (target.tagName !== 'BUTTON' || /^(un|re)do$/.test(target.className)) return;
    history.keep();
    if (target.className === 'all' || target.className === 'none') every(target.className === 'all');
    else if (target.className === 'eye') change(rowOf(target), { on: !now.rows[rowOf(target)].on });
    else now = { ...now, solo: now.solo === rowOf(target) ? -1 : rowOf(target) };
    show();
  });
  list.addEventListener('input', ({ target }) => {
    if (!moving) history.keep();
    moving = true;
    change(rowOf(target), target.type === 'color' ? { rgb: rgbOf(target.value) } : { opacity: Number(target.value) ** 3 });
    show();
  });
  list.addEventListener('change', () => { moving = false; });
  find('[type=search]').addEventListener('input', ({ target }) => {
    const wanted = target.value.trim().toLowerCase();
    labels.forEach(({ name, number }, k) => { list.children[k].hidden = !`${number} ${name}`.toLowerCase().includes(wanted); });
  });
  history.add({ key, state: () => now, set: (then) => { now = then; show(); } });
  show();
  const digits = (x, n) => Number(x.toFixed(n));
  const rows = () => seen().map(({ rgb, opacity }, k) => ({ number: labels[k].number, name: labels[k].name, color: rgb.map((c) => digits(c, 4)), opacity: digits(opacity, 6) }));
  function select(k) {
    [...list.children].forEach((one, j) => one.classList.toggle('chosen', j === k));
    if (list.children[k].hidden) find('[type=search]').value = '';
    for (const one of list.children) one.hidden = one.hidden && find('[type=search]').value !== '';
    list.children[k].scrollIntoView({ block: 'nearest' });
  }
  // looks of some labels: [{number, opacity, color}]; opacity 0 hides
  function set(list) {
    const some = list.map(({ number, opacity, color }) => {
      const k = labels.findIndex((one) => one.number === number), { rgb, opacity: old } = now.rows[k] ?? {};
      if (k < 0) throw new Error(`label ${number}: not in this file`);
      const next = { rgb: color ?? rgb, opacity: opacity || old, on: opacity === undefined ? now.rows[k].on : opacity > 0 };
      if (![...next.rgb, next.opacity].every((x) => x >= 0 && x <= 1) || next.rgb.length !== 3) throw new Error(`label ${number}: expected color and opacity in [0, 1]`);
      return [k, next];
    });
    history.keep();
    now = { ...now, solo: -1 };
    some.forEach(([k, next]) => change(k, next));
    show();
  }
  return { root, rows, select, set };
}
