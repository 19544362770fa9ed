// A transfer function: at a value, as the table that rays look it up in, and as an X-ray has it.
export const TABLE = 1 << 14, WIDE = 256;  // entries over the range of values; of a row of the texture
const MAX_OPACITY = 1 - 1e-5, PARTS = 16;

// Opacity and colour at x of nodes {x, y, rgb} in ascending order: at an x of several nodes the last one's opacity and the
// first one's colour, as in VTK.
export function functionAt(nodes, x) {
  let after = 0, from = 0;
  while (after < nodes.length && nodes[after].x <= x) after++;
  while (from < nodes.length && nodes[from].x < x) from++;
  const between = (next, of) => {
    if (next === 0) return of(nodes[0]);
    if (next === nodes.length) return of(nodes[next - 1]);
    const [a, b] = [nodes[next - 1], nodes[next]], w = (x - a.x) / (b.x - a.x);
    return (1 - w) * of(a) + w * of(b);
  };
  return { y: between(after, (n) => n.y), rgb: [0, 1, 2].map((c) => between(from, (n) => n.rgb[c])) };
}

const depth = (opacity) => -Math.log1p(-Math.min(Math.max(opacity, 0), MAX_OPACITY));
export const extinction = (opacity, distance) => depth(opacity) / distance;

// {texels: at each entry extinction times r, g, b and 1, then its sums up to each, times the entries' distance; seen: how many entries before each show anything}
export function tableOf(nodes, { values: [lo, hi] }, distance) {
  const texels = new Float32Array(8 * TABLE), seen = new Uint16Array(TABLE + 1), sum = [0, 0, 0, 0];
  let last = null;
  for (let i = 0; i < TABLE; i++) {
    const { y, rgb } = functionAt(nodes, lo + ((hi - lo) * i) / (TABLE - 1)), tau = extinction(y, distance), now = [...rgb.map((c) => c * tau), tau];
    if (last) now.forEach((x, c) => { sum[c] += (x + last[c]) / (2 * (TABLE - 1)); });
    texels.set(now, 4 * i);
    texels.set(sum, 4 * (TABLE + i));
    seen[i + 1] = seen[i] + (tau > 0 ? 1 : 0);
    last = now;
  }
  return { texels, seen };
}

// The unit distance of its X-ray (exposed_distance of look/tables.py): a ray as long as the box through the volume's mean keeps 1/e
export function exposed(nodes, { values: [lo, hi], histogram, unit_distance }) {
  const step = (hi - lo) / histogram.length;
  let sum = 0, all = 0;
  histogram.forEach((count, k) => {
    all += count;
    for (let n = 0; count && n < PARTS; n++) sum += (count / PARTS) * depth(functionAt(nodes, lo + step * (k + (n + 0.5) / PARTS)).y);
  });
  return (2 * sum) / all || unit_distance;
}
