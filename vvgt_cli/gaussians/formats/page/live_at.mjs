// One Gaussian of a live page as live.glsl shows it, and the value at a place; `look` as `liveLook` returns it.
import { around } from './cloud.mjs';

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// what a Gaussian carries: value and spread, log of the length, direction in which values rise (viewer's axes) and its length r
function carried({ bytes, count, live }, i) {
  const byte = (plane) => bytes[plane * count + i], [lo, hi] = live.values, [first, last] = live.log_lengths;
  const g = [3, 4, 5].map((plane, k) => ((byte(plane) - 128) / 127) * (k < 2 ? -1 : 1));
  return {
    row: byte(0), column: (byte(1) * (live.table[1] - 1)) / 255, value: lo + ((hi - lo) * byte(0)) / 255, gradient: g, r: Math.min(Math.hypot(...g), 1),
    spread: (hi - lo) * live.widest * (byte(1) / 255) ** live.bend, length: Math.exp(first + ((last - first) * byte(2)) / 255),
  };
}

// the unit direction of the gradient in the Gaussian's own standard deviations
const along = (gradient, arms) => {
  const a = arms.map((arm) => dot(gradient, arm)), length = Math.max(Math.hypot(...a), 1e-30);
  return a.map((x) => x / length);
};

// the row of the label that a Gaussian belongs to
const label = ({ bytes, count }, i) => bytes[6 * count + i] + 256 * bytes[7 * count + i];
const beyond = ({ planes }, center) => planes.some(({ normal, place }) => dot(normal, center) > place);  // what is cut is not looked at

function labelled(look) {
  return (i, { center, arms }) => {
    const { opacity } = look.rows[label(look, i)];
    if (opacity <= 0 || beyond(look, center)) return null;
    return { center, arms, opacity: 1 - (1 - Math.min(opacity, 0.99999)) ** (carried(look, i).length / look.live.unit_distance) };
  };
}

export function looksOf(look) {
  const { live } = look, spreads = live.table[1];
  if (live.labels.length) return labelled(look);
  return (i, { center, arms }) => {
    const { row, column, length, gradient, r } = carried(look, i), j = Math.min(Math.floor(column), spreads - 2), f = column - j;
    const at = (c) => (1 - f) * look.sums[6 * (row * spreads + j) + c] + f * look.sums[6 * (row * spreads + j + 1) + c];
    if (at(3) < 1e-12) return null;
    const tau = at(3), first = at(4) / tau, variance = Math.max(at(5) / tau - first * first, 0), unit = along(gradient, arms);
    const thin = Math.sqrt(Math.max(1 - r * r * (1 - variance), live.thinnest ** 2));
    const arm = [0, 1, 2].map((c) => arms[0][c] * unit[0] + arms[1][c] * unit[1] + arms[2][c] * unit[2]);
    const moved = center.map((x, c) => x + arm[c] * r * first);
    if (beyond(look, moved)) return null;
    const axes = arms.map((one, k) => one.map((x, c) => x + arm[c] * (thin - 1) * unit[k]));
    return { center: moved, arms: axes, opacity: -Math.expm1((-tau * length) / Math.sqrt(thin)) };
  };
}

// The name of the label that most of the Gaussians around a place belong to, of those that are shown; null where there are none
function labelAt(look, numbers, place) {
  const weights = new Map();
  for (const { i, q } of around(numbers, place)) {
    const k = label(look, i);
    if (look.rows[k].opacity > 0) weights.set(k, (weights.get(k) ?? 0) + Math.exp(-0.5 * dot(q, q)));
  }
  const [first] = [...weights].sort((a, b) => b[1] - a[1]);
  return first ? look.live.labels[first[0]].name : null;
}

// The mean value of the Gaussians around a place, each rising along its gradient, or their label; null where there are none
export function valueAt(look, numbers, place) {
  if (look.live.labels.length) return labelAt(look, numbers, place);
  let sum = 0, weights = 0;
  for (const { i, gaussian, q } of around(numbers, place)) {
    const { value, spread, gradient, r } = carried(look, i), z = dot(along(gradient, gaussian.arms), q), weight = Math.exp(-0.5 * dot(q, q));
    sum += weight * (value + spread * r * Math.min(Math.max(z, -2), 2));
    weights += weight;
  }
  const [lo, hi] = look.live.values;
  return weights ? Math.min(Math.max(sum / weights, lo), hi) : null;
}
