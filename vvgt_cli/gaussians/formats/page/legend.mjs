// The legend: values of the function's range with their colours, as wide as they are opaque; or labels with their colours.
import { hex } from './color.mjs';
import { shown } from './facts.mjs';
import { functionAt } from './table.mjs';
import { round } from './scale.mjs';
import { element, label, stops } from './svg.mjs';

const HIGH = 130, WIDE = 18;
const ROW = 18, LETTER = 7, MOST = 12;  // px of a label, of a letter of its name, labels at most

// Round values between two
export function ticks(lo, hi, many = 4) {
  const step = round((hi - lo) / many) || 1, values = [];
  for (let k = Math.ceil(lo / step - 1e-9); k * step <= hi + 1e-9 * step; k++) values.push(Number((k * step).toPrecision(12)));
  return values;
}

export function drawLegend(group, { nodes, live, right, bottom }) {
  const [lo, hi] = live.values, span = hi - lo || 1, top = bottom - HIGH, height = (v) => bottom - (HIGH * (v - lo)) / span;
  const gradient = element('linearGradient', { id: 'where-legend', gradientUnits: 'userSpaceOnUse', x1: 0, y1: bottom, x2: 0, y2: top });
  gradient.append(...stops(nodes, live.values));
  const edge = Array.from({ length: HIGH + 1 }, (_, k) => {
    const y = functionAt(nodes, lo + (span * k) / HIGH).y;
    return `${(right - 2 - (WIDE - 2) * Math.cbrt(Math.min(Math.max(y, 0), 1))).toFixed(1)},${bottom - k}`;
  });
  group.append(
    element('rect', { x: right - WIDE, y: top, width: WIDE, height: HIGH, fill: '#000', 'fill-opacity': 0.5, stroke: '#888' }), gradient,
    element('path', { d: `M${right},${bottom}L${edge.join('L')}L${right},${top}Z`, fill: 'url(#where-legend)' }),
  );
  const values = ticks(lo, hi);
  for (const v of values) {
    group.append(element('path', { d: `M${right - WIDE - 4},${height(v)}h4`, stroke: '#ccc' }));
    group.append(label(shown(v, 5), right - WIDE - 7, height(v) + 4, { 'text-anchor': 'end', 'font-size': 12 }));
  }
  group.append(label([live.quantity, live.unit].filter(Boolean).join(', ') || 'value', right, top - 9, { 'text-anchor': 'end', 'font-size': 12 }));
  return values;
}

// The first labels, from the bottom up; a name that is wider than half the picture is cut
export function drawLabels(group, { labels, of, right, bottom, high }) {
  const many = Math.min(labels.length, MOST, Math.max(Math.floor(high / 3 / ROW), 1)), rest = of - many;
  const longest = Math.floor(right / 2 / LETTER), lines = [...labels.slice(0, many), ...(rest > 0 ? [{ name: `and ${rest} more` }] : [])];
  lines.forEach(({ name, rgb }, k) => {
    const y = bottom - (lines.length - 1 - k) * ROW, text = name.length > longest ? `${name.slice(0, longest - 1)}…` : name;
    if (rgb) group.append(element('rect', { x: right - 12, y: y - 11, width: 12, height: 12, rx: 2, fill: hex(rgb), stroke: '#000', 'stroke-opacity': 0.6 }));
    group.append(label(text, right - 18, y, { 'text-anchor': 'end', 'font-size': 12 }));
  });
  return lines.map(({ name }) => name);
}
