// The panel of a live page: of each layer its function or the list of its labels; a cut, a light; what undo goes back to.
import { cutOf } from './cut.mjs';
import { editor } from './editor.mjs';
import { greys } from './greys.mjs';
import { light } from './light.mjs';
import { organs } from './organs.mjs';
import { piece } from './piece.mjs';
import { extinction } from './table.mjs';

const HTML = `<header><span class="named"><h1></h1><i></i></span><button class="fold" aria-label="show or hide the panel" title="show or hide the panel">▾</button></header>
<output></output><select class="layer" aria-label="layer" title="layer"></select><select class="kind" aria-label="draw as" title="draw as (k)"></select>`;
const KINDS = ['colours', 'MIP', 'X-ray'];
const SURFACE = 14;  // extinction, of which a fortieth of the longest edge absorbs half
const STEPS = 200;  // that undo goes back

// the title line
export function named() {
  const element = Object.assign(document.createElement('header'), { id: 'named', innerHTML: '<h1></h1>' });
  element.firstChild.textContent = element.firstChild.title = document.title;
  return element;
}

// {root, look, parts: {key, state, set} of undo and links, layers: of each {layer, table} of labels or {layer, nodes}, at(): the chosen one, ...}
export function panel(look, viewer, live) {
  const root = document.createElement('section');
  root.id = 'live';
  root.setAttribute('aria-label', 'look');
  root.innerHTML = HTML;
  document.body.append(root);
  const find = (selector) => root.querySelector(selector), heading = find('h1'), list = find('.layer'), done = [], undone = [], parts = [], layers = [];
  let told = () => {}, chosen = 0;
  heading.textContent = heading.title = document.title;

  const enable = () => [['undo', done], ['redo', undone]].forEach(([name, list]) => root.querySelectorAll(`.${name}`).forEach((button) => { button.disabled = !list.length; }));
  const states = () => parts.map((part) => part.state());
  const history = {
    // before a change: what undo goes back to
    keep() {
      done.push(states());
      if (done.length > STEPS) done.shift();
      undone.length = 0;
      enable();
    },
    add: (part) => parts.push(part),
    chosen: () => { find('output').textContent = layers[chosen]?.told?.() ?? ''; },
    changed(alone = true) { history.chosen(); told(alone); },
    light: (to) => lamp.set(lit(to)),
  };

  function undo(from = done, to = undone) {
    const then = from.pop();
    if (then) to.push(states());
    then?.forEach((state, k) => { if (parts[k].state() !== state) parts[k].set(state); });
    enable();
  }

  const cut = cutOf(look, live, viewer, history, () => { history.chosen(); told(true); });
  look.layers.forEach((layer, k) => {
    const after = k ? `-${k}` : '';
    layers.push({ layer, ...(layer.labels.length
      ? organs((rows) => look.labels(rows, k), layer.labels, `labels${after}`, history)
      : editor((nodes) => { surfaced(layer, nodes); look.apply(nodes, k); }, layer, `function${after}`, history)) });
  });
  root.append(...layers.map((one) => one.root), cut.root, light(look, viewer, live.light, history));
  const lamp = parts.at(-1), begun = lamp.state();
  // the light under a preset's: its coefficients, null for none, undefined for the file's
  function lit(to) {
    if (to === undefined) return begun;
    const now = lamp.state();
    if (to === null) return { ...now, kind: 'none' };
    const kind = to.kind ?? (now.kind === 'none' ? 'headlight' : now.kind), next = { ...now, ...to, kind };
    return [begun, now].find((one) => JSON.stringify(one) === JSON.stringify(next)) ?? next;
  }
  // another function that shows surfaces is lit, unless a light was chosen, or chosen away
  function surfaced({ nodes, unit_distance }, now) {
    if (now !== nodes && begun.kind === 'none' && lamp.state() === begun && Math.max(...now.map(({ y }) => extinction(y, unit_distance))) > SURFACE) lamp.set({ ...begun, kind: 'headlight' });
  }

  function choose(k) {
    chosen = k;
    layers.forEach((one, j) => { one.root.hidden = j !== k; });
    history.chosen();
    told(true);
  }
  // what is clicked: its layer, and of a label its row
  function select({ layer, row }) {
    if (layer === undefined) return;
    if (layer !== chosen) choose(list.selectedIndex = layer);
    if (row !== undefined) layers[layer].select?.(row);
  }
  list.append(...layers.map(({ layer }, k) => new Option(layer.title || `layer ${k}`)));
  list.hidden = layers.length < 2;
  list.addEventListener('change', () => choose(list.selectedIndex));

  // the look, MIP or X-ray: of one layer of values
  const kinds = find('.kind'), values = layers.length === 1 ? layers[0].nodes : undefined;
  let drawn = 0;
  const grey = values && greys(look, live.layers[0], history), kept = values && piece(look, history);
  if (values) {
    root.append(grey.root, kept.root);
    grey.draw(0);
  }
  function draw(k) {
    drawn = kinds.selectedIndex = k;
    look.draw(k);
    grey.draw(k);
    told(true);
  }
  function drawAs(k) {
    history.keep();
    draw(k);
  }
  kinds.append(...KINDS.map((name) => new Option(name)));
  kinds.hidden = !values;
  kinds.addEventListener('change', () => drawAs(kinds.selectedIndex));
  if (values) history.add({ key: 'drawn', state: () => drawn, set: draw, text: () => (drawn ? KINDS[drawn] : ''), read: (text) => Math.max(KINDS.indexOf(text), 0) });

  const fold = (folded) => {
    root.classList.toggle('folded', folded);
    find('.fold').textContent = folded ? '▸' : '▾';
    find('.fold').setAttribute('aria-expanded', String(!folded));
  };
  find('.fold').addEventListener('click', () => fold(!root.classList.contains('folded')));
  root.addEventListener('click', ({ target }) => { if (target.className === 'undo') undo(); else if (target.className === 'redo') undo(undone, done); });
  window.addEventListener('keydown', (event) => {
    const key = event.key.toLowerCase();
    if (!(event.ctrlKey || event.metaKey) || (key !== 'z' && key !== 'y')) return;
    event.preventDefault();
    if (key === 'z' && !event.shiftKey) undo();
    else undo(undone, done);
  }, true);

  fold(false);
  enable();
  choose(0);
  return {
    root, fold, look, cut, lamp, parts, layers, select, at: () => layers[chosen], changed(f) { told = f; },
    grey, kept, drawn: () => drawn, next: values && (() => drawAs((drawn + 1) % KINDS.length)),
    alone: () => drawn > 0 || cut.planes().length > 0 || Boolean(kept?.part.state()), lit: () => (lamp.state() === begun ? null : lamp.state()),
    nodes: () => layers[chosen].nodes(), set: (nodes) => layers[chosen].set(nodes),
  };
}
