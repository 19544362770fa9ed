// Elements of the drawing over the picture. All looks are attributes: the drawing is also made part of a saved picture.
import { hex } from './color.mjs';
import { functionAt } from './table.mjs';

const SVG = 'http://www.w3.org/2000/svg';

export function element(name, attributes = {}, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

// stops of a gradient over the values [lo, hi], of the nodes of a function
export function stops(nodes, [lo, hi]) {
  const end = (x) => ({ x, ...functionAt(nodes, x) }), all = [end(lo), ...nodes.filter(({ x }) => x >= lo && x <= hi), end(hi)];
  return all.map(({ x, rgb }) => element('stop', { offset: (x - lo) / (hi - lo || 1), 'stop-color': hex(rgb) }));
}

// text that is legible over anything
export function label(text, x, y, attributes = {}) {
  const look = { fill: '#fff', stroke: '#000', 'stroke-width': 3, 'stroke-opacity': 0.7, 'paint-order': 'stroke', 'font-size': 13, 'font-family': 'system-ui, sans-serif' };
  return element('text', { x: x.toFixed(1), y: y.toFixed(1), ...look, ...attributes }, text);
}

// Moves texts up or down to where they lie over no other text, neither of these nor of those that stay
export function moveApart(texts, stay) {
  const boxes = stay.map((text) => text.getBBox());
  for (const text of texts.filter(({ textContent }) => textContent)) {
    const { x, y, width, height } = text.getBBox(), free = (by) => boxes.every((b) => x >= b.x + b.width || b.x >= x + width || y + by >= b.y + b.height || b.y >= y + by + height);
    const by = Array.from({ length: 41 }, (_, k) => ((k % 2 ? -1 : 1) * Math.ceil(k / 2) * height) / 4).find(free) ?? 0;
    text.setAttribute('y', (Number(text.getAttribute('y')) + by).toFixed(1));
    boxes.push({ x, y: y + by, width, height });
  }
}
