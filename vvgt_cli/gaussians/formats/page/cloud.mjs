// The Gaussians that a page shows, and the place that is seen along a ray: where half of what the ray meets is in front.
import { Quat, Vec3, Vec4 } from 'playcanvas';

const REACH = 3;  // standard deviations that a Gaussian is looked for in
const FAINT = 0.05;  // opacity along a ray below which there is nothing
const ROW = 14;  // numbers of a Gaussian: mean, three arms (standard deviations), opacity, the longest arm

// Their numbers in the viewer's axes, which have PLY (x, y, z) at (-x, -y, z)
export function cloudOf(data) {
  const p = new Vec3(), r = new Quat(), s = new Vec3(), c = new Vec4(), iterator = data.createIter(p, r, s, c);
  const numbers = new Float32Array(data.numSplats * ROW);
  for (let i = 0; i < data.numSplats; i++) {
    iterator.read(i);
    r.normalize();
    const { x, y, z, w } = r, size = (data.isCompressed ? [Math.exp(s.x), Math.exp(s.y), Math.exp(s.z)] : [s.x, s.y, s.z]);
    const turn = [
      [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
      [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
      [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ];
    const arms = turn.flatMap((arm, k) => [-arm[0] * size[k], -arm[1] * size[k], arm[2] * size[k]]);
    numbers.set([-p.x, -p.y, p.z, ...arms, c.w, Math.max(...size)], i * ROW);
  }
  return numbers;
}

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// Rows of the inverse of the matrix of three arms as columns
export function inverse([a, b, c]) {
  const rows = [cross(b, c), cross(c, a), cross(a, b)], volume = dot(a, rows[0]) || 1e-30;
  return rows.map((row) => row.map((x) => x / volume));
}

export const own = (rows, d) => rows.map((row) => dot(row, d));
const one = (numbers, i) => {
  const at = numbers.subarray(i * ROW, (i + 1) * ROW);
  return { center: [...at.subarray(0, 3)], arms: [0, 1, 2].map((k) => [...at.subarray(3 + 3 * k, 6 + 3 * k)]), opacity: at[12] };
};

// The place that is seen along a ray, null where there is nothing
export function seen(numbers, { origin, direction }, flat = false) {
  const length = Math.hypot(...direction), d = direction.map((x) => x / length), hits = [];
  for (let i = 0; i < numbers.length / ROW; i++) {
    const at = i * ROW, x = numbers[at] - origin[0], y = numbers[at + 1] - origin[1], z = numbers[at + 2] - origin[2];
    const along = x * d[0] + y * d[1] + z * d[2], reach = REACH * numbers[at + 13];
    if (x * x + y * y + z * z - along * along > reach * reach || (!flat && along < -reach)) continue;
    const it = one(numbers, i);
    if (it.opacity < 1 / 255) continue;
    const rows = inverse(it.arms), o = own(rows, origin.map((v, k) => v - it.center[k])), e = own(rows, d);
    const t = -dot(o, e) / dot(e, e), q = o.map((v, k) => v + t * e[k]), alpha = it.opacity * Math.exp(-0.5 * dot(q, q));
    if (alpha > 1 / 255 && (flat || t > 0)) hits.push([t, Math.min(alpha, 0.99)]);
  }
  hits.sort((a, b) => a[0] - b[0]);
  const total = 1 - hits.reduce((rest, [, alpha]) => rest * (1 - alpha), 1);
  if (total < FAINT) return null;
  let rest = 1;
  for (const [t, alpha] of hits) {
    rest *= 1 - alpha;
    if (1 - rest >= total / 2) return origin.map((v, k) => v + t * d[k]);
  }
  return null;
}
