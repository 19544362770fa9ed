// One Gaussian of a live page as live.glsl shows it, and the value at a place; `look` as `liveLook` returns it.
import { around } from './cloud.mjs';

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// what a Gaussian carries: value and spread, log of the length, direction in which values rise (viewer's axes) and its length r
function carried({ bytes, live }, i) {
  const count = bytes.length / 6, byte = (plane) => bytes[plane * count + i], [lo, hi] = live.values, [first, last] = live.log_lengths;
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

export function looksOf(look) {
  const { live } = look, spreads = live.table[1];
  return (i, { center, arms }) => {
    const { row, column, length, gradient, r } = carried(look, i), j = Math.min(Math.floor(column), spreads - 2), f = column - j;
    const at = (c) => (1 - f) * look.sums[6 * (row * spreads + j) + c] + f * look.sums[6 * (row * spreads + j + 1) + c];
    if (at(3) < 1e-12) return null;
    const tau = at(3), first = at(4) / tau, variance = Math.max(at(5) / tau - first * first, 0), unit = along(gradient, arms);
    const thin = Math.sqrt(Math.max(1 - r * r * (1 - variance), live.thinnest ** 2));
    const arm = [0, 1, 2].map((c) => arms[0][c] * unit[0] + arms[1][c] * unit[1] + arms[2][c] * unit[2]);
    const moved = center.map((x, c) => x + arm[c] * r * first), { plane } = look;
    if (plane && dot(plane.normal, moved) > plane.place) return null;  // what is cut is not looked at
    const axes = arms.map((one, k) => one.map((x, c) => x + arm[c] * (thin - 1) * unit[k]));
    return { center: moved, arms: axes, opacity: -Math.expm1((-tau * length) / Math.sqrt(thin)) };
  };
}

// The mean value of the Gaussians around a place, each rising along its gradient; null where there are none
export function valueAt(look, numbers, place) {
  let sum = 0, weights = 0;
  for (const { i, gaussian, q } of around(numbers, place)) {
    const { value, spread, gradient, r } = carried(look, i), z = dot(along(gradient, gaussian.arms), q), weight = Math.exp(-0.5 * dot(q, q));
    sum += weight * (value + spread * r * Math.min(Math.max(z, -2), 2));
    weights += weight;
  }
  const [lo, hi] = look.live.values;
  return weights ? Math.min(Math.max(sum / weights, lo), hi) : null;
}
