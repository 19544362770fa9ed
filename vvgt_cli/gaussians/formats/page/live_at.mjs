// One Gaussian of a live page as live.glsl shows it, and the value at a place; `look` as `liveLook` returns it.
import { around } from './cloud.mjs';

const ROW = 9;  // plane of a row's low byte, before that of its high byte (formats/live.py)

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// what a Gaussian carries: value and spread, log of the length, direction in which values rise and its length r, axis of the normals (viewer's axes)
function carried({ bytes, count, live }, { values: [lo, hi] }, i) {
  const byte = (plane) => bytes[plane * count + i], [first, last] = live.log_lengths;
  const [g, axis] = [3, 6].map((first) => [0, 1, 2].map((k) => ((byte(first + k) - 128) / 127) * (k < 2 ? -1 : 1)));
  return {
    row: byte(0), column: (byte(1) * (live.table[1] - 1)) / 255, value: lo + ((hi - lo) * byte(0)) / 255, gradient: g, axis, r: Math.min(Math.hypot(...g), 1),
    spread: (hi - lo) * live.widest * (byte(1) / 255) ** live.bend, length: Math.exp(first + ((last - first) * byte(2)) / 255),
  };
}

// the unit direction of a direction in the Gaussian's own standard deviations
const along = (direction, arms) => {
  const a = arms.map((arm) => dot(direction, arm)), length = Math.max(Math.hypot(...a), 1e-30);
  return a.map((x) => x / length);
};

const across = (arms, own) => [0, 1, 2].map((c) => arms[0][c] * own[0] + arms[1][c] * own[1] + arms[2][c] * own[2]);
// arms that are so many times as long along one of these directions
const narrowed = (arms, own, times) => {
  const arm = across(arms, own);
  return arms.map((one, k) => one.map((x, c) => x + arm[c] * (times - 1) * own[k]));
};

// what is said of each layer, with what all have in common
export const layersOf = (live) => live.layers.map((layer) => ({ ...live, ...layer }));

// the row of a Gaussian's look, and its layer's number
const rowOf = ({ bytes, count, live }, i) => (live.planes > ROW ? bytes[ROW * count + i] + 256 * bytes[(ROW + 1) * count + i] : 0);
const layerOf = ({ layers }, row) => layers.findLastIndex((layer) => layer.row <= row);
const beyond = ({ planes = [] }, center) => planes.some(({ normal, place }) => dot(normal, center) > place);  // what is cut is not looked at

// opacity whose dilogarithm is y, to 3e-4
const alpha = (y) => {
  const x = Math.min(y, 1.5886);
  return Math.min(x * (1.0006751 + x * (-0.257202 + x * (0.0395146 + x * (-0.0420802 + x * (0.0288972 - x * 0.0082833))))), 0.99);
};

// {center, arms, opacity} of what has an extinction tau, as live.glsl has it; arms are made orthogonal
function seen({ live }, center, arms, tau, length) {
  const axes = arms.map((arm) => [...arm]);
  for (let sweep = 0; sweep < 6; sweep++) {
    for (const [i, j] of [[0, 1], [0, 2], [1, 2]]) {
      const [a, b] = [axes[i], axes[j]], c = dot(a, b), aa = dot(a, a), bb = dot(b, b);
      if (Math.abs(c) < 1e-9 * Math.sqrt(aa * bb)) continue;
      const zeta = (bb - aa) / (2 * c), t = (zeta < 0 ? -1 : 1) / (Math.abs(zeta) + Math.sqrt(1 + zeta * zeta)), cs = 1 / Math.sqrt(1 + t * t);
      axes[i] = a.map((x, k) => cs * (x - t * b[k]));
      axes[j] = b.map((x, k) => cs * (x + t * a[k]));
    }
  }
  const wide = axes.map((axis) => dot(axis, axis) + live.dilation), areas = [0, 1, 2].map((k) => 2 * Math.PI * Math.sqrt(wide[(k + 1) % 3] * wide[(k + 2) % 3]));
  const weights = areas.map((area) => area ** 1.5), total = weights.reduce((sum, weight) => sum + weight), mass = tau * length ** 3;
  const opacity = areas.reduce((sum, area, k) => sum + weights[k] * alpha(mass / area + Math.min(mass / area, 1 / 255)), 0) / total;
  return { center, arms: axes, opacity };
}

// How the page shows Gaussian i, null where it does not
export function looksOf(look) {
  const { live, layers } = look, spreads = live.table[1];
  return (i, { center, arms }) => {
    const number = rowOf(look, i), k = layerOf(look, number), layer = layers[k], { row, column, length, gradient, axis, r } = carried(look, layer, i);
    let tau, first = 0, variance = 1;
    if (layer.labels.length) {
      const { opacity } = look.rows[number];
      tau = -Math.log1p(-Math.min(opacity, 0.99999)) / layer.unit_distance;
    } else {
      const j = Math.min(Math.floor(column), spreads - 2), f = column - j;
      const at = (c) => (1 - f) * look.sums[k][6 * (row * spreads + j) + c] + f * look.sums[k][6 * (row * spreads + j + 1) + c];
      tau = at(3);
      first = at(4) / Math.max(tau, 1e-30);
      variance = Math.max(at(5) / Math.max(tau, 1e-30) - first * first, 0);
      tau *= Math.min(Math.max((live.tail[1] - Math.abs(first)) / (live.tail[1] - live.tail[0]), 0), 1);
    }
    if (tau < 1e-12) return null;
    const unit = along(gradient, arms), facing = r * r, opaque = 1 - Math.exp(-tau * length);
    const thin = Math.sqrt(Math.max(1 - facing * (1 - variance), live.thinnest ** 2) * (1 - opaque * facing * (1 - live.sharp)));
    const arm = across(arms, unit), narrow = narrowed(arms, unit, thin), flat = Math.sqrt(1 - opaque * (1 - facing) * (1 - live.sharp));
    const moved = center.map((x, c) => x + arm[c] * r * first);
    if (beyond(look, moved)) return null;
    return seen(look, moved, narrowed(narrow, along(axis, narrow), flat), tau, length);
  };
}

// {value, in: its unit, layer, row: of its labels} of the layer that is most at a place: the mean of its Gaussians there, each rising along its gradient, or the name of the
// label that is most there. Of several layers, and of labels, what is not shown does not count; a value of null: nothing is there.
export function valueAt(look, numbers, place) {
  const looks = looksOf(look), found = new Map();  // by row
  for (const { i, gaussian, q } of around(numbers, place)) {
    const row = rowOf(look, i), layer = look.layers[layerOf(look, row)];
    if ((look.layers.length > 1 || layer.labels.length) && !looks(i, gaussian)) continue;
    const { value, spread, gradient, r } = carried(look, layer, i), z = dot(along(gradient, gaussian.arms), q), weight = Math.exp(-0.5 * dot(q, q));
    const { sum, weights } = found.get(row) ?? { sum: 0, weights: 0 };
    found.set(row, { sum: sum + weight * (value + spread * r * Math.min(Math.max(z, -2), 2)), weights: weights + weight });
  }
  const [[most, { sum, weights }] = [0, { weights: 0 }]] = [...found].sort((a, b) => b[1].weights - a[1].weights), layer = layerOf(look, most), { labels, row: first, values: [lo, hi], unit } = look.layers[layer], row = most - first;
  if (!weights) return { value: null, in: '' };
  return labels.length ? { value: labels[row].name, in: '', layer, row } : { value: Math.min(Math.max(sum / weights, lo), hi), in: unit, layer };
}
