// Places that are clicked, with their values; in measuring, two and the distance between them.
import { cloudOf, seen } from './cloud.mjs';
import { looksOf, valueAt } from './live_at.mjs';
import { shown } from './facts.mjs';
import { element, label } from './svg.mjs';

const STILL = 6;  // pixels that a click stays within

// picked(place): of every place that is found
export function rulerOf(lens, worldNow, dataNow, look, changed, picked) {
  const { canvas } = lens;
  let measuring = false, places = [], of = null, cloud = null, down = null;

  function pick(x, y) {
    const data = dataNow();
    if (!data.numSplats) return null;  // streamed: not here
    if (of !== data) [of, cloud] = [data, cloudOf(data)];
    places = measuring && places.length < 2 ? places : [];
    const place = seen(cloud, lens.ray(x, y), look && looksOf(look), lens.flat);
    if (place) places.push({ place, world: worldNow().place(place), ...(look ? valueAt(look, cloud, place) : { value: null, in: '' }) });
    changed(measuring && !place ? 'nothing under the pointer' : '');
    if (place) picked(places.at(-1));
    return place && places.at(-1);
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
  canvas.addEventListener('dblclick', () => {
    if (places.length && !measuring) lens.set({ ...lens.pose(), target: places.at(-1).place });
  });

  return {
    pick,
    get places() { return places; },
    get measuring() { return measuring; },
    measure(now) {
      measuring = now;
      canvas.classList.toggle('measuring', now);
      places = [];
      changed();
    },
    distance: () => (places.length > 1 ? Math.hypot(...places[0].world.map((x, k) => x - places[1].world[k])) : null),
  };
}

// The value at a place, in words; '' where it is unknown
export const valueText = ({ value, in: of }) => (value === null ? '' : `${typeof value === 'string' ? value : shown(value, 4)}${of && ` ${of}`}`);

// A place in words: letters of the side where the space is one of the body
export function placeText(place, { letters, anatomical, unit }) {
  const digits = (x) => shown(x, Math.abs(x) < 100 ? 3 : 5), text = valueText(place);
  const along = place.world.map((x, k) => (anatomical ? `${letters[k][x < 0 ? 0 : 1]} ${digits(Math.abs(x))}` : `${letters[k][1]} ${digits(x)}`));
  return `${along.join(', ')}${unit && ` ${unit}`}${text && `: ${text}`}`;
}

// The lines that cross in the slices, in the picture
export function drawCross(group, lens, lines) {
  for (const [a, b] of lines.map((line) => line.map(lens.project))) {
    if (a && b) group.append(element('line', { x1: a[0], y1: a[1], x2: b[0], y2: b[1], stroke: '#fff', 'stroke-width': 1, 'stroke-opacity': 0.6 }));
  }
}

export function drawRuler(group, { lens, world, ruler }) {
  const at = ruler.places.map(({ place }) => lens.project(place)), [a, b] = at, distance = ruler.distance();
  if (a && b) {
    const line = { x1: a[0], y1: a[1], x2: b[0], y2: b[1] };
    group.append(element('line', { ...line, stroke: '#000', 'stroke-width': 4, 'stroke-opacity': 0.6 }), element('line', { ...line, stroke: '#fc3', 'stroke-width': 1.5 }));
  }
  at.forEach((p, k) => {
    if (!p) return;
    group.append(element('circle', { cx: p[0], cy: p[1], r: 5, fill: 'none', stroke: '#000', 'stroke-width': 4, 'stroke-opacity': 0.6 }), element('circle', { cx: p[0], cy: p[1], r: 5, fill: 'none', stroke: '#fc3', 'stroke-width': 1.5 }));
    group.append(label(ruler.measuring ? String(k + 1) : valueText(ruler.places[k]), p[0] + 8, p[1] - 6, { fill: '#fc3', 'font-size': ruler.measuring ? 12 : 14 }));
  });
  if (a && b) group.append(label(`${shown(distance, 4)}${world.unit && ` ${world.unit}`}`, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2 - 8, { fill: '#fc3', 'text-anchor': 'middle', 'font-weight': 600 }));
}
