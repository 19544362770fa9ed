// Places that are picked, with their values, and the distance between two.
import { cloudOf, seen } from './cloud.mjs';
import { looksOf, valueAt } from './live_at.mjs';
import { shown } from './facts.mjs';
import { element, label } from './svg.mjs';

const STILL = 6;  // pixels that a click stays within
const OURS = ['pick', 'orbitTarget:set', 'navigateTo'];  // what the viewer would do at a click

export function rulerOf(viewer, lens, worldNow, dataNow, look, changed) {
  const { canvas } = lens, fire = viewer.events.fire;
  let measuring = false, places = [], of = null, cloud = null, down = null;
  viewer.events.fire = (name, ...rest) => (measuring && OURS.includes(name) ? viewer.events : fire.call(viewer.events, name, ...rest));

  function pick(x, y) {
    const data = dataNow();
    if (of !== data) [of, cloud] = [data, cloudOf(data)];
    const place = seen(cloud, lens.ray(x, y), look && looksOf(look), lens.flat);
    if (!place) return null;
    const read = look ? valueAt(look, cloud, place) : { value: null, in: '' };
    places = places.length > 1 ? [] : places;
    places.push({ place, world: worldNow().place(place), ...read });
    changed();
    return places.at(-1);
  }

  canvas.addEventListener('pointerdown', (event) => {
    down = event.isPrimary && !event.button ? { id: event.pointerId, x: event.offsetX, y: event.offsetY } : null;  // not of two fingers
  });
  canvas.addEventListener('pointerup', (event) => {
    const still = down && event.pointerId === down.id && Math.hypot(event.offsetX - down.x, event.offsetY - down.y) < STILL;
    if (measuring && still && !pick(down.x, down.y)) changed('nothing there');
    down = null;
  });
  canvas.addEventListener('pointercancel', () => { down = null; });

  return {
    pick,
    get places() { return places; },
    get measuring() { return measuring; },
    measure(now) {
      measuring = now;
      canvas.classList.toggle('measuring', now);
      if (!now) places = [];
      changed();
    },
    distance: () => (places.length > 1 ? Math.hypot(...places[0].world.map((x, k) => x - places[1].world[k])) : null),
  };
}

// A place in words: letters of the side where the space is one of the body
export function placeText({ world, value, in: of }, { letters, anatomical, unit }) {
  const digits = (x) => shown(x, Math.abs(x) < 100 ? 3 : 5);
  const along = world.map((x, k) => (anatomical ? `${letters[k][x < 0 ? 0 : 1]} ${digits(Math.abs(x))}` : `${letters[k][1]} ${digits(x)}`));
  const read = value === null ? '' : `: ${typeof value === 'string' ? value : shown(value, 4)}${of && ` ${of}`}`;
  return `${along.join(', ')}${unit && ` ${unit}`}${read}`;
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
    group.append(label(String(k + 1), p[0] + 8, p[1] - 6, { fill: '#fc3', 'font-size': 12 }));
  });
  if (a && b) group.append(label(`${shown(distance, 4)}${world.unit && ` ${world.unit}`}`, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2 - 8, { fill: '#fc3', 'text-anchor': 'middle', 'font-weight': 600 }));
}
