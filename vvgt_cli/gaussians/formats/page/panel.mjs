// The panel of a live page: the function over the histogram, its nodes to be dragged; a cut.
import { hex, rgbOf } from './color.mjs';
import { cutOf } from './cut.mjs';
import { light } from './light.mjs';
import { organs } from './organs.mjs';
import { functionAt } from './live_table.mjs';

const WIDE = 276, HIGH = 92, NEAR = 16, TWICE = 350;  // px; milliseconds between the taps that add a node
const MANY = 14, CLOSE = 0.03;  // nodes that are all offered, and how far fewer of them may be from the function
const SVG = 'http://www.w3.org/2000/svg';
const HTML = `<header><span class="named"><b></b><i></i></span><output></output><button class="fold" aria-label="panel" title="panel">▾</button></header>
<svg viewBox="0 0 ${WIDE} ${HIGH}" role="group" aria-label="opacity over value; double click adds a node, Delete removes one">
<defs><linearGradient id="live-fill"></linearGradient></defs><path class="counts" fill="#667"/><path class="area" fill="url(#live-fill)" fill-opacity="0.75"/>
<path class="line" fill="none" stroke="#fff"/><g></g></svg>
<div><select aria-label="function" title="function"></select><button class="undo" aria-label="undo" title="undo (Ctrl+Z)">↶</button>
<button class="remove" aria-label="remove the node" title="remove the node (Delete)">−</button><input type="color" aria-label="colour of the node" title="colour of the node"></div>`;

const height = (y) => HIGH - 4 - (HIGH - 8) * Math.cbrt(y), opacity = (h) => Math.min(Math.max((HIGH - 4 - h) / (HIGH - 8), 0), 1) ** 3;
const copy = (nodes) => nodes.map(({ x, y, rgb }) => ({ x, y, rgb: [...rgb] }));

// the file's name and what kind it is
export function named(kind, element = document.createElement('div')) {
  if (!element.className) element.id = 'named';
  element.replaceChildren(document.createElement('b'), document.createElement('i'));
  [element.firstChild.textContent, element.lastChild.textContent] = [document.title, kind];
  element.firstChild.title = document.title;
  return element;
}

// Fewer nodes of nearly the same function (Douglas and Peucker's)
function fewer(nodes) {
  if (nodes.length <= MANY) return copy(nodes);
  const kept = new Set([0, nodes.length - 1]), of = (n) => [Math.cbrt(n.y), ...n.rgb.map((c) => c / 2)];
  const split = (a, b) => {
    let far = CLOSE, at = -1;
    for (let k = a + 1; k < b; k++) {
      const w = (nodes[k].x - nodes[a].x) / (nodes[b].x - nodes[a].x || 1), p = of(nodes[a]), q = of(nodes[b]);
      const off = Math.max(...of(nodes[k]).map((c, i) => Math.abs(c - (1 - w) * p[i] - w * q[i])));
      if (off > far) [far, at] = [off, k];
    }
    if (at > 0) { kept.add(at); split(a, at); split(at, b); }
  };
  split(0, nodes.length - 1);
  return copy(nodes.filter((_, k) => kept.has(k)));
}

// Functions to begin with: the file's own, and three at places of the values but the commonest (background)
function presets({ values: [lo, hi], histogram, nodes }) {
  const most = histogram.indexOf(Math.max(...histogram)), counts = histogram.map((n, k) => (k === most ? 0 : n));
  const all = counts.reduce((a, b) => a + b, 0) || 1, share = (q) => {
    let sum = 0;
    const k = counts.findIndex((n) => (sum += n) >= q * all);
    return lo + ((hi - lo) * (k + 0.5)) / counts.length;
  };
  const made = (...list) => list.map(([x, y]) => ({ x, y, rgb: functionAt(nodes, x).rgb }));
  const middle = share(0.5), wide = Math.max((share(0.7) - share(0.3)) / 2, (hi - lo) / 40);
  return {
    'as in the file': nodes,
    step: made([lo, 0], [middle, 0], [Math.min(middle + (hi - lo) / 100, hi), 0.8], [hi, 0.8]),
    ramp: made([lo, 0], [share(0.1), 0], [hi, 0.5]),
    band: made([lo, 0], [Math.max(middle - wide, lo), 0], [middle, 0.5], [Math.min(middle + wide, hi), 0], [hi, 0]),
  };
}

export function panel(look, viewer, live) {
  const root = document.createElement('section');
  root.id = 'live';
  root.innerHTML = HTML;
  document.body.append(root);
  named('live', root.querySelector('.named'));
  const find = (selector) => root.querySelector(selector), [lo, hi] = live.values, span = hi - lo || 1;
  const across = (x) => 6 + ((WIDE - 12) * (x - lo)) / span, value = (p) => Math.min(Math.max(lo + (span * (p - 6)) / (WIDE - 12), lo), hi);
  const labelled = live.labels.length > 0, ready = labelled ? {} : presets(live), undone = [], parts = [];  // parts: what undo goes back to beside the function
  let nodes = fewer(live.nodes), exact = live.nodes, chosen = 0, due = false, told = () => {};  // exact: of the file until an edit

  function draw() {
    find('.undo').disabled = !undone.length;
    if (labelled) return;
    const curve = Array.from({ length: WIDE - 11 }, (_, k) => `${k + 6},${height(functionAt(exact ?? nodes, value(k + 6)).y).toFixed(2)}`).join('L');
    find('.line').setAttribute('d', `M${curve}`);
    find('.area').setAttribute('d', `M6,${HIGH - 4}L${curve}L${WIDE - 6},${HIGH - 4}Z`);
    const gradient = find('linearGradient');
    gradient.replaceChildren(...nodes.map(({ x, rgb }) => {
      const stop = document.createElementNS(SVG, 'stop');
      stop.setAttribute('offset', (x - lo) / span);
      stop.setAttribute('stop-color', hex(rgb));
      return stop;
    }));
    const group = find('g');
    while (group.childElementCount > nodes.length) group.lastChild.remove();
    while (group.childElementCount < nodes.length) group.append(document.createElementNS(SVG, 'circle'));
    nodes.forEach(({ x, y, rgb }, k) => {
      const is = { cx: across(x), cy: height(y), r: 4.5, fill: hex(rgb), tabindex: 0, role: 'slider', class: k === chosen ? 'chosen' : '',
        'aria-label': `node ${k + 1}`, 'aria-valuenow': x, 'aria-valuetext': text(nodes[k]) };
      for (const [key, now] of Object.entries(is)) group.children[k].setAttribute(key, now);
    });
    find('output').textContent = text(nodes[chosen]);
    find('input[type=color]').value = hex(nodes[chosen].rgb);
    find('.remove').disabled = nodes.length < 3;
  }

  const text = ({ x, y }) => `${Number(x.toPrecision(span > 1000 ? 5 : 4))}${live.unit && ` ${live.unit}`}, opacity ${Number(y.toPrecision(2))}`;

  function show() {
    draw();
    told(false);
    if (due || labelled) return;
    due = true;
    requestAnimationFrame(() => {
      due = false;
      look.apply(exact ?? nodes);
    });
  }

  // before a change: what undo goes back to
  function keep() {
    undone.push({ nodes: copy(nodes), exact, chosen, states: parts.map((part) => part.state()) });
    if (undone.length > 200) undone.shift();
    find('.undo').disabled = false;
  }
  const history = { keep, add: (part) => parts.push(part), changed: (alone = true) => told(alone) };

  function undo() {
    if (!undone.length) return;
    const then = undone.pop();
    ({ nodes, exact, chosen } = then);
    parts.forEach((part, k) => { if (part.state() !== then.states[k]) part.set(then.states[k]); });
    show();
  }

  function move(k, x, y) {
    exact = null;
    nodes[k].x = Math.min(Math.max(x, k ? nodes[k - 1].x : lo), k < nodes.length - 1 ? nodes[k + 1].x : hi);
    nodes[k].y = Math.min(Math.max(y, 0), 1);
    show();
  }

  function add(x, y) {
    keep();
    const node = { x, y, rgb: functionAt(nodes, x).rgb };
    exact = null;
    chosen = nodes.findIndex((n) => n.x > x);
    if (chosen < 0) chosen = nodes.length;
    nodes.splice(chosen, 0, node);
    show();
  }

  function remove(k) {
    if (nodes.length < 3) return;
    keep();
    exact = null;
    nodes.splice(k, 1);
    chosen = Math.min(k, nodes.length - 1);
    show();
    find('g').children[chosen].focus();
  }

  const svg = find('svg');
  const place = (event) => {
    const box = svg.getBoundingClientRect();
    return [((event.clientX - box.left) * WIDE) / box.width, ((event.clientY - box.top) * HIGH) / box.height];
  };
  const nearest = ([px, py]) => {
    const away = nodes.map(({ x, y }) => Math.hypot(across(x) - px, height(y) - py)), least = Math.min(...away);
    return least < NEAR ? away.indexOf(least) : -1;
  };
  let dragged = -1, moved = false, tap = { time: -1, at: [0, 0] };
  svg.addEventListener('pointerdown', (event) => {
    if (event.button) return;
    event.preventDefault();
    const at = place(event), k = nearest(at);
    if (k >= 0) {
      [dragged, moved, chosen] = [k, false, k];
      svg.setPointerCapture(event.pointerId);
      draw();
      find('g').children[k].focus({ focusVisible: false });
    } else if (event.timeStamp - tap.time < TWICE && Math.hypot(at[0] - tap.at[0], at[1] - tap.at[1]) < NEAR) {
      add(value(at[0]), opacity(at[1]));
    }
    tap = { time: event.timeStamp, at };
  });
  svg.addEventListener('pointermove', (event) => {
    if (dragged < 0) return;
    const [px, py] = place(event);
    if (!moved) {
      if (Math.hypot(px - tap.at[0], py - tap.at[1]) < 2) return;
      keep();
      moved = true;
    }
    move(dragged, value(px), opacity(py));
  });
  for (const name of ['pointerup', 'pointercancel']) svg.addEventListener(name, () => { dragged = -1; });
  svg.addEventListener('contextmenu', (event) => {
    event.preventDefault();
    const k = nearest(place(event));
    if (k >= 0) remove(k);
  });
  find('g').addEventListener('focusin', (event) => {
    chosen = [...find('g').children].indexOf(event.target);
    draw();
  });
  svg.addEventListener('keydown', (event) => {
    const step = event.shiftKey ? 5 : 1, { x, y } = nodes[chosen], up = opacity(height(y) - step), down = opacity(height(y) + step);
    const moves = { ArrowLeft: [x - (step * span) / 200, y], ArrowRight: [x + (step * span) / 200, y], ArrowUp: [x, up], ArrowDown: [x, down] };
    if (moves[event.key]) {
      keep();
      move(chosen, ...moves[event.key]);
    } else if (event.key === 'Delete' || event.key === 'Backspace') {
      remove(chosen);
    } else return;
    event.preventDefault();
  });
  find('.remove').addEventListener('click', () => remove(chosen));
  find('.undo').addEventListener('click', undo);
  let coloring = false;
  find('input[type=color]').addEventListener('input', ({ target }) => {
    if (!coloring) keep();
    [coloring, exact] = [true, null];
    nodes[chosen].rgb = rgbOf(target.value);
    show();
  });
  find('input[type=color]').addEventListener('change', () => { coloring = false; });

  const list = find('select[aria-label=function]');
  list.append(...Object.keys(ready).map((name) => new Option(name)));
  list.addEventListener('change', () => {
    keep();
    nodes = fewer(ready[list.value]);
    exact = ready[list.value];
    chosen = 0;
    show();
  });

  const cut = cutOf(look, live, viewer, history, () => { draw(); told(true); });
  root.append(cut.root);

  root.classList.toggle('labelled', labelled);
  const table = labelled ? organs(look, live.labels, history) : null;
  if (labelled) {
    root.querySelector('div').after(table.root);
    find('.organs div').prepend(find('.undo'));
  }
  root.append(light(look, viewer, live.light, history));
  const lamp = parts.at(-1), begun = lamp.state();

  const fold = (folded) => {
    root.classList.toggle('folded', folded);
    find('.fold').textContent = folded ? '▸' : '▾';
    find('.fold').setAttribute('aria-expanded', String(!folded));
  };
  find('.fold').addEventListener('click', () => fold(!root.classList.contains('folded')));
  for (const name of ['keydown', 'keyup']) root.addEventListener(name, (event) => event.stopPropagation());  // not the viewer's
  window.addEventListener('keydown', (event) => {
    if ((event.ctrlKey || event.metaKey) && !event.shiftKey && event.key.toLowerCase() === 'z') {
      event.preventDefault();
      undo();
    }
  }, true);

  const counts = live.histogram, most = Math.log1p(Math.max(...counts)) || 1, bar = (WIDE - 12) / counts.length;
  find('.counts').setAttribute('d', counts.map((n, k) => `M${(6 + k * bar).toFixed(2)},${HIGH}v${((-HIGH * 0.9 * Math.log1p(n)) / most).toFixed(2)}h${bar.toFixed(2)}V${HIGH}Z`).join(''));
  fold(innerWidth < 700);
  draw();
  return { root, look, changed(f) { told = f; }, cut, alone: () => cut.planes().length > 0 || lamp.state() !== begun, lit: () => (lamp.state() === begun ? null : lamp.state()), labelled, rows: () => table.rows(), parts, nodes: () => copy(exact ?? nodes), set(now) { keep(); [nodes, exact, chosen] = now === live.nodes ? [fewer(now), now, 0] : [copy(now), null, 0]; show(); } };
}
