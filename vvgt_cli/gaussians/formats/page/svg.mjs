// Elements of the drawing over the picture. All looks are attributes: the drawing is also made part of a saved picture.
const SVG = 'http://www.w3.org/2000/svg';

export function element(name, attributes = {}, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

// text that is legible over anything
export function label(text, x, y, attributes = {}) {
  const look = { fill: '#fff', stroke: '#000', 'stroke-width': 3, 'stroke-opacity': 0.7, 'paint-order': 'stroke', 'font-size': 13, 'font-family': 'system-ui, sans-serif' };
  return element('text', { x: x.toFixed(1), y: y.toFixed(1), ...look, ...attributes }, text);
}
