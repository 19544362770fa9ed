// The scale bar: a round length where the view turns about.
import { element, label } from './svg.mjs';
import { shown } from './facts.mjs';

// The longest of 1, 2, 5 times a power of ten that is no longer than `most`
export function round(most) {
  const power = 10 ** Math.floor(Math.log10(most));
  return power * [5, 2, 1].find((n) => n * power <= most * (1 + 1e-9));
}

export function drawScale(group, { lens, world, wide, high, left }) {
  const pixel = lens.perPixel() * world.length, most = Math.min(160, wide / 3) * pixel;
  if (!(most > 0 && most < Infinity)) return null;
  const length = round(most), across = length / pixel, y = high - 24;
  const path = `M${left},${y - 5}v10M${left},${y}h${across}M${left + across},${y - 5}v10`;
  group.append(element('path', { d: path, fill: 'none', stroke: '#000', 'stroke-width': 5, 'stroke-opacity': 0.6 }), element('path', { d: path, fill: 'none', stroke: '#fff', 'stroke-width': 2 }));
  const text = `${shown(length)}${world.unit && ` ${world.unit}`}`;
  group.append(label(text, left + across / 2, y - 9, { 'text-anchor': 'middle' }));
  return { length, across, text };
}
