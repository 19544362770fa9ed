// Places that are clicked, with their values.
import { cloudOf, seen } from './cloud.mjs';
import { shown } from './facts.mjs';
import { element, label } from './svg.mjs';

const STILL = 6;  // pixels that a click stays within

// pick(x, y), also at every click; picked(place): what is there, or null
export function pickerOf(lens, worldNow, dataNow, look, picked) {
  const { canvas } = lens;
  let of = null, cloud = null, down = null;

  async function pick(x, y) {
    const data = dataNow(), ray = lens.ray(x, y);
    if (look && !look.said) {
      const place = await look.pick(ray);
      return picked(place && { place, world: worldNow().place(place), ...look.at(place) });
    }
    if (!data.numSplats) return;  // streamed: not here
    if (of !== data) [of, cloud] = [data, cloudOf(data)];
    const place = seen(cloud, ray, lens.flat);
    picked(place && { place, world: worldNow().place(place), value: null, in: '' });
  }

  canvas.addEventListener('pointerdown', (event) => {
    down = event.isPrimary && !event.button ? { id: event.pointerId, x: event.offsetX, y: event.offsetY } : null;  // not of two fingers
  });
  canvas.addEventListener('pointerup', (event) => {
    const still = down && event.pointerId === down.id && Math.hypot(event.offsetX - down.x, event.offsetY - down.y) < STILL;
    if (still) pick(down.x, down.y);
    down = null;
  });
  canvas.addEventListener('pointercancel', () => { down = null; });
  canvas.addEventListener('mousedown', (event) => event.preventDefault());  // after a tap it would take the focus from a new note
  return pick;
}

// The value at a place, in words; '' where it is unknown
export const valueText = ({ value, in: of }) => (value === null ? '' : `${typeof value === 'string' ? value : shown(value, 4, true)}${of && ` ${of}`}`);

// A place in words: letters of the side where the space is one of the body
export function placeText(place, { letters, anatomical, unit }) {
  const digits = (x) => shown(x, Math.abs(x) < 100 ? 3 : 5, true), text = valueText(place);
  const along = place.world.map((x, k) => (anatomical ? `${letters[k][x < 0 ? 0 : 1]} ${digits(Math.abs(x))}` : `${letters[k][1]} ${digits(x)}`));
  return `${along.join(', ')}${unit && ` ${unit}`}${text && `: ${text}${place.mean ? ` (${place.mean})` : ''}`}`;
}

const LOOKS = [{ stroke: '#000', 'stroke-width': 4, 'stroke-opacity': 0.6, fill: 'none' }, { stroke: '#fc3', 'stroke-width': 1.5, fill: 'none' }];
export const drawPath = (group, d) => group.append(...LOOKS.map((look) => element('path', { d, ...look })));

// a ring at a pixel, with text beside it
export function drawPlace(group, [x, y], text, size = 14) {
  drawPath(group, `M${(x + 5).toFixed(1)},${y.toFixed(1)}a5,5 0 1 0 0,.01Z`);
  group.append(label(text, x + 8, y - 6, { fill: '#fc3', 'font-size': size }));
}

// The lines that cross in the slices, in the picture
export function drawCross(group, lens, lines) {
  for (const [a, b] of lines.map((line) => line.map(lens.project))) {
    if (a && b) group.append(element('line', { x1: a[0], y1: a[1], x2: b[0], y2: b[1], stroke: '#fff', 'stroke-width': 1, 'stroke-opacity': 0.6 }));
  }
}
