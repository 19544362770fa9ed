// The function of one layer of a live page over the histogram of its values: nodes to be dragged.
import { hex, rgbOf } from './color.mjs';
import { functionAt } from './table.mjs';
import { element, stops } from './svg.mjs';

const WIDE = 276, HIGH = 92, NEAR = matchMedia('(pointer: coarse)').matches ? 22 : 16, TWICE = 350;  // px; milliseconds between the taps that add a node
const MANY = 14, CLOSE = 0.03;  // nodes that are all offered, and how far fewer of them may be from the function
const EDITED = 'edited', NONE = -1, ALL = -2;  // what is dragged, if no node
const WIDER = 60;  // px of a drag upwards after which all is e times as wide
const HTML = `<svg viewBox="0 0 ${WIDE} ${HIGH}" role="group" aria-label="opacity by value; double click adds a node, Delete removes it; drag beside the nodes to shift or widen the function">
<defs><linearGradient></linearGradient></defs><path class="counts" fill="#667"/><path class="area" fill-opacity="0.75"/>
<path class="line" fill="none" stroke="#fff"/><g></g></svg>
<div><button class="preset" aria-expanded="false" title="presets"></button><button class="undo" aria-label="undo" title="undo (Ctrl+Z)">↶</button><button class="redo" aria-label="redo" title="redo (Ctrl+Y, Ctrl+Shift+Z)">↷</button>
<button class="remove" aria-label="remove the node" title="remove the node (Delete)">−</button><input type="color" aria-label="colour of the node" title="colour of the node"></div><div class="presets" role="group" aria-label="presets" hidden></div>`;
const PRESET = `<canvas width="84" height="84" aria-hidden="true"></canvas><span></span>`;

const height = (y) => HIGH - 4 - (HIGH - 8) * Math.cbrt(y), opacity = (h) => Math.min(Math.max((HIGH - 4 - h) / (HIGH - 8), 0), 1) ** 3;
const copy = (nodes) => nodes.map(({ x, y, rgb }) => ({ x, y, rgb: [...rgb] }));

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

// Functions to begin with, {name, shows, nodes, light}: the file's own, those that suit its values, and three at places of the values but the commonest (background)
function presets({ values: [lo, hi], histogram, nodes, light, presets: named = [] }) {
  const most = histogram.indexOf(Math.max(...histogram)), counts = histogram.map((n, k) => (k === most ? 0 : n));
  const all = counts.reduce((a, b) => a + b, 0) || 1, share = (q) => {
    let sum = 0;
    const k = counts.findIndex((n) => (sum += n) >= q * all);
    return lo + ((hi - lo) * (k + 0.5)) / counts.length;
  };
  const made = (...list) => list.map(([x, y]) => ({ x, y, rgb: functionAt(nodes, x).rgb }));
  const middle = share(0.5), wide = Math.max((share(0.7) - share(0.3)) / 2, (hi - lo) / 40);
  return [
    { name: 'as in the file', nodes, light }, ...named,
    { name: 'step', nodes: made([lo, 0], [middle, 0], [Math.min(middle + (hi - lo) / 100, hi), 0.8], [hi, 0.8]) },
    { name: 'ramp', nodes: made([lo, 0], [share(0.1), 0], [hi, 0.5]) },
    { name: 'band', nodes: made([lo, 0], [Math.max(middle - wide, lo), 0], [middle, 0.5], [Math.min(middle + wide, hi), 0], [hi, 0]) },
  ];
}

// nodes as a link has them, and back
const digits = (x, n) => String(Number(x.toFixed(n)));
const written = (nodes) => nodes.map(({ x, y, rgb }) => `${Number(x.toPrecision(7))}:${digits(y, 5)}:${hex(rgb).slice(1)}`).join(',');
function read(text) {
  const nodes = text.split(',').map((node) => {
    const [x, y, color = ''] = node.split(':');
    return { x: Number(x), y: Number(y), rgb: [0, 2, 4].map((k) => parseInt(color.slice(k, k + 2), 16) / 255) };
  });
  if (nodes.length < 2 || !nodes.every(({ x, y, rgb }, k) => [x, y, ...rgb].every(Number.isFinite) && (!k || x >= nodes[k - 1].x))) throw new Error('no function');
  return nodes;
}

// {root, nodes(), set(nodes), told(): of the chosen node}; apply(nodes) shows a function; `key` of links and `history` as light.mjs has it
export function editor(apply, layer, key, history) {
  const root = document.createElement('div');
  root.className = 'function';
  root.innerHTML = HTML;
  const find = (selector) => root.querySelector(selector), [lo, hi] = layer.values, span = hi - lo || 1;
  const across = (x) => 6 + ((WIDE - 12) * (Math.min(Math.max(x, lo), hi) - lo)) / span,  // nodes beyond the values at the edge
     value = (p) => Math.min(Math.max(lo + (span * (p - 6)) / (WIDE - 12), lo), hi);
  const ready = presets(layer), opener = find('.preset'), menu = find('.presets'), svg = find('svg');
  const whole = (nodes) => ({ nodes: fewer(nodes), exact: nodes, chosen: 0 });  // exact: until an edit
  let now = whole(layer.nodes), due = false;

  const text = ({ x, y }) => `${Number(x.toPrecision(span > 1000 ? 5 : 4))}${layer.unit && ` ${layer.unit}`}, opacity ${Number(y.toPrecision(2))}`;

  function draw() {
    const { nodes, exact, chosen } = now;
    const curve = Array.from({ length: WIDE - 11 }, (_, k) => `${k + 6},${height(functionAt(exact ?? nodes, value(k + 6)).y).toFixed(2)}`).join('L');
    find('.line').setAttribute('d', `M${curve}`);
    find('.area').setAttribute('d', `M6,${HIGH - 4}L${curve}L${WIDE - 6},${HIGH - 4}Z`);
    find('linearGradient').replaceChildren(...stops(nodes, layer.values));
    const group = find('g');
    while (group.childElementCount > nodes.length) group.lastChild.remove();
    while (group.childElementCount < nodes.length) {
      const node = element('g', { tabindex: 0, role: 'slider', 'aria-valuemin': 0, 'aria-valuemax': 1 });
      node.append(element('circle', { r: 12, fill: 'transparent' }), element('circle', { r: 4.5, class: 'dot' }));  // the first to be hit
      group.append(node);
    }
    nodes.forEach(({ x, y, rgb }, k) => {
      group.children[k].lastChild.setAttribute('fill', hex(rgb));
      const is = { transform: `translate(${across(x)},${height(y)})`, class: k === chosen ? 'node chosen' : 'node', 'aria-label': `node ${k + 1}`, 'aria-valuenow': Math.min(Math.max((x - lo) / span, 0), 1).toFixed(4), 'aria-valuetext': text(nodes[k]) };
      for (const [name, is_] of Object.entries(is)) group.children[k].setAttribute(name, is_);
    });
    find('input[type=color]').value = hex(nodes[chosen].rgb);
    find('.remove').disabled = nodes.length < 3;
    const begun = ready.findIndex((one) => one.nodes === exact);
    opener.textContent = ready[begun]?.name ?? EDITED;
    opener.setAttribute('aria-label', `presets: ${opener.textContent}`);
    [...menu.children].forEach((button, k) => button.setAttribute('aria-pressed', String(k === begun)));
  }

  function show() {
    draw();
    history.changed(false);
    if (due) return;
    due = true;
    requestAnimationFrame(() => {
      due = false;
      apply(now.exact ?? now.nodes);
    });
  }
  const change = (nodes, chosen = now.chosen) => { now = { nodes, exact: null, chosen }; show(); };
  const choose = (chosen) => { now = { ...now, chosen }; draw(); history.chosen(); };

  function move(k, x, y) {
    const { nodes } = now, last = nodes.length - 1, low = k ? nodes[k - 1].x : Math.min(lo, nodes[0].x), high = k < last ? nodes[k + 1].x : Math.max(hi, nodes[last].x);
    const at = { x: Math.min(Math.max(x, low), high), y: Math.min(Math.max(y, 0), 1) };
    change(nodes.map((node, j) => (j === k ? { ...node, ...at } : node)));
  }

  // the whole function of a state, shifted by a value and so many times as wide about its middle
  function moveAll(from, shift, times) {
    const middle = (from.nodes[0].x + from.nodes.at(-1).x) / 2, moved = (nodes) => nodes?.map((node) => ({ ...node, x: middle + (node.x - middle) * times + shift }));
    now = { ...now, nodes: moved(from.nodes), exact: moved(from.exact) ?? null };
    show();
  }

  function add(x, y) {
    history.keep();
    const after = now.nodes.findIndex((n) => n.x > x), k = after < 0 ? now.nodes.length : after;
    change(now.nodes.toSpliced(k, 0, { x, y, rgb: functionAt(now.nodes, x).rgb }), k);
  }

  function remove(k) {
    if (now.nodes.length < 3) return;
    history.keep();
    change(now.nodes.toSpliced(k, 1), Math.min(k, now.nodes.length - 2));
    find('g').children[now.chosen].focus();
  }

  const place = (event) => {
    const box = svg.getBoundingClientRect();
    return [((event.clientX - box.left) * WIDE) / box.width, ((event.clientY - box.top) * HIGH) / box.height];
  };
  const nearest = ([px, py]) => {
    const away = now.nodes.map(({ x, y }) => Math.hypot(across(x) - px, height(y) - py)), least = Math.min(...away);
    return least < NEAR ? away.indexOf(least) : NONE;
  };
  let dragged = NONE, moved = false, grabbed = now, tap = { time: -1, at: [0, 0] };
  svg.addEventListener('pointerdown', (event) => {
    if (event.button) return;
    event.preventDefault();
    const at = place(event), k = nearest(at);
    if (k >= 0) {
      [dragged, moved] = [k, false];
      svg.setPointerCapture(event.pointerId);
      choose(k);
      find('g').children[k].focus({ focusVisible: false });
    } else if (event.timeStamp - tap.time < TWICE && Math.hypot(at[0] - tap.at[0], at[1] - tap.at[1]) < NEAR) {
      add(value(at[0]), opacity(at[1]));
    } else {
      [dragged, moved, grabbed] = [ALL, false, now];
      svg.setPointerCapture(event.pointerId);
    }
    tap = { time: event.timeStamp, at };
  });
  svg.addEventListener('pointermove', (event) => {
    if (dragged === NONE) return;
    const [px, py] = place(event);
    if (!moved) {
      if (Math.hypot(px - tap.at[0], py - tap.at[1]) < 2) return;
      history.keep();
      moved = true;
    }
    if (dragged === ALL) moveAll(grabbed, ((px - tap.at[0]) * span) / (WIDE - 12), Math.exp((tap.at[1] - py) / WIDER));
    else move(dragged, value(px), opacity(py));
  });
  for (const name of ['pointerup', 'pointercancel']) svg.addEventListener(name, () => { dragged = NONE; });
  svg.addEventListener('contextmenu', (event) => {
    event.preventDefault();
    const k = nearest(place(event));
    if (k >= 0) remove(k);
  });
  root.addEventListener('focusin', ({ target }) => { if (target.matches('.node')) choose([...find('g').children].indexOf(target)); });  // on the group, Chromium would let it have the focus
  root.addEventListener('keydown', (event) => {
    if (!event.target.matches('.node')) return;
    const step = event.shiftKey ? 5 : 1, { x, y } = now.nodes[now.chosen], up = opacity(height(y) - step), down = opacity(height(y) + step);
    const moves = { ArrowLeft: [x - (step * span) / 200, y], ArrowRight: [x + (step * span) / 200, y], ArrowUp: [x, up], ArrowDown: [x, down] };
    if (moves[event.key]) {
      history.keep();
      move(now.chosen, ...moves[event.key]);
    } else if (event.key === 'PageUp' || event.key === 'PageDown') {
      const up = event.key === 'PageUp' ? 1 : -1;
      history.keep();
      moveAll(now, event.shiftKey ? 0 : (up * span) / 50, event.shiftKey ? 1.05 ** up : 1);
    } else if (event.key === 'Delete' || event.key === 'Backspace') {
      remove(now.chosen);
    } else return;
    event.preventDefault();
  });
  find('.remove').addEventListener('click', () => remove(now.chosen));
  let coloring = false;
  find('input[type=color]').addEventListener('input', ({ target }) => {
    if (!coloring) history.keep();
    coloring = true;
    change(now.nodes.map((node, k) => (k === now.chosen ? { ...node, rgb: rgbOf(target.value) } : node)));
  });
  find('input[type=color]').addEventListener('change', () => { coloring = false; });

  const pictures = ready.map(({ name, shows, nodes, light }) => {
    const button = Object.assign(document.createElement('button'), { innerHTML: PRESET, title: shows ?? name });
    button.lastChild.textContent = name;
    button.addEventListener('click', () => {
      history.keep();
      now = whole(nodes);
      show();
      history.light(light);
    });
    menu.append(button);
    return button.firstChild.getContext('2d');
  });
  function open(now) {
    menu.hidden = !now;
    opener.setAttribute('aria-expanded', String(now));
    if (now) history.sketch(ready, (k, picture) => pictures[k].drawImage(picture, 0, 0), () => !menu.hidden);
  }
  opener.addEventListener('click', () => open(menu.hidden));
  root.addEventListener('keydown', (event) => {
    if (event.key !== 'Escape' || menu.hidden) return;
    event.preventDefault();
    open(false);
    opener.focus();
  });

  const counts = layer.histogram, most = Math.log1p(Math.max(...counts)) || 1, bar = (WIDE - 12) / counts.length;
  find('.counts').setAttribute('d', counts.map((n, k) => `M${(6 + k * bar).toFixed(2)},${HIGH}v${((-HIGH * 0.9 * Math.log1p(n)) / most).toFixed(2)}h${bar.toFixed(2)}V${HIGH}Z`).join(''));
  find('linearGradient').id = `live-fill-${key}`;
  find('.area').setAttribute('fill', `url(#live-fill-${key})`);
  const nodes = () => copy(now.exact ?? now.nodes);
  history.add({
    key, state: () => now, set: (then) => { now = then; show(); },
    text: () => (written(nodes()) === written(layer.nodes) ? '' : written(nodes())),
    read: (said) => (said ? { nodes: read(said), exact: null, chosen: 0 } : whole(layer.nodes)),
  });
  draw();
  const named = () => ({ ...layer, name: ready.find((one) => one.shows && one.nodes === now.exact)?.name ?? layer.name });  // the preset's name, if one is chosen
  return { root, nodes, named, told: () => text(now.nodes[now.chosen]), set: (to) => { history.keep(); now = { nodes: copy(to), exact: null, chosen: 0 }; show(); } };
}
