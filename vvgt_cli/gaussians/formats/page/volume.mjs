// Grids of the volume that a page holds (page_values.py): decoded, placed in the world, looked up; and how slices of them lie.
import { Damaged } from './damage.mjs';

const BODY = [['axial', 'L', 'A'], ['coronal', 'L', 'S'], ['sagittal', 'P', 'S']], OTHER = [['z', 'x', 'y'], ['y', 'x', 'z'], ['x', 'y', 'z']];  // name, what is to the right, what is up
const ORDERS = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

const FRAMES = 3;  // whose grids stay in memory

const through = (m, p) => [0, 1, 2].map((r) => m[4 * r] * p[0] + m[4 * r + 1] * p[1] + m[4 * r + 2] * p[2] + m[4 * r + 3]);

function inverted(m) {
  const [a, b, c, , d, e, f, , g, h, i] = m, det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g);
  const rows = [[e * i - f * h, c * h - b * i, b * f - c * e], [f * g - d * i, a * i - c * g, c * d - a * f], [d * h - e * g, b * g - a * h, a * e - b * d]].map((row) => row.map((x) => x / det));
  return rows.flatMap((row) => [...row, -row.reduce((sum, x, k) => sum + x * m[4 * k + 3], 0)]);
}

export const edgesOf = (affine) => [0, 1, 2].map((k) => Math.hypot(affine[k], affine[4 + k], affine[8 + k]));

// the matrix of the one after the other
const chained = (m, n) => [0, 1, 2].flatMap((r) => [0, 1, 2, 3].map((c) => m[4 * r] * n[c] + m[4 * r + 1] * n[4 + c] + m[4 * r + 2] * n[8 + c] + (c === 3 ? m[4 * r + 3] : 0)));

// what an element of the page holds (gzip in base64), `size` bytes
async function unpacked(id, size, again) {
  try {
    const element = document.getElementById(id), stream = new Blob([Uint8Array.from(atob(element.textContent), (c) => c.charCodeAt(0))]).stream();
    if (!again) element.remove();
    const bytes = new Uint8Array(await new Response(stream.pipeThrough(new DecompressionStream('gzip'))).arrayBuffer());
    if (bytes.length === size) return bytes;
  } catch { /* said below */ }
  throw new Damaged('its values are incomplete');
}

// {...facts, codes, value(code): NaN unknown, at(index): its code, -1 outside, near(x, y, z): that between the eight around it, toWorld, toIndex, from(other): indices of another grid to its own}
async function gridOf(facts, again = false) {
  const { dims: [nx, ny, nz], bits, element, affine, lo, step, missing, cell } = facts, n = nx * ny * nz, bytes = await unpacked(element, (bits / 8) * n, again);
  const codes = bits === 8 ? new Uint8Array(n) : new Uint16Array(n), high = bits === 8 ? null : bytes.subarray(n);
  for (let i = 0; i < n; i++) {
    const folded = high ? bytes[i] | (high[i] << 8) : bytes[i];
    codes[i] = ((folded >>> 1) ^ -(folded & 1)) + (i % nx ? codes[i - 1] : 0);
  }
  const inverse = inverted(affine);
  return {
    ...facts, codes, mean: facts.labels || Math.max(...cell) === 1 ? '' : `mean of ${cell.join(' × ')} voxels`,
    value: (code) => (code < missing ? NaN : lo + step * (code - missing)),
    at(index) { return codes[this.offset(index)] ?? -1; },
    offset(index) {
      const [x, y, z] = index.map(Math.round);
      return x < 0 || y < 0 || z < 0 || x >= nx || y >= ny || z >= nz ? -1 : x + nx * (y + ny * z);
    },
    near(x, y, z) {
      if (!(x >= -0.5 && y >= -0.5 && z >= -0.5 && x < nx - 0.5 && y < ny - 0.5 && z < nz - 0.5)) return -1;
      if (missing) return codes[Math.round(x) + nx * (Math.round(y) + ny * Math.round(z))] || -1;
      const i = Math.max(Math.floor(x), 0), j = Math.max(Math.floor(y), 0), k = Math.max(Math.floor(z), 0), first = i + nx * (j + ny * k);
      const f = Math.max(x - i, 0), g = Math.max(y - j, 0), h = Math.max(z - k, 0), dx = i + 1 < nx ? 1 : 0, dy = j + 1 < ny ? nx : 0, dz = k + 1 < nz ? nx * ny : 0;
      const line = (at) => codes[at] + (codes[at + dx] - codes[at]) * f, plane = (at) => { const a = line(at); return g ? a + (line(at + dy) - a) * g : a; }, low = plane(first);
      return Math.round(h ? low + (plane(first + dz) - low) * h : low);
    },
    toWorld: (index) => through(affine, index), toIndex: (place) => through(inverse, place),
    from: (other) => { const m = chained(inverse, other.affine); return (index) => through(m, index); },
    edges: edgesOf(affine),
  };
}

// a function that returns all grids, read at its first call; those of a server are fetched, and their contents put in elements as in a file
export function sharedGrids(values) {
  let read = null;
  const all = async () => {
    let facts = values;
    if (values.from) {
      const answer = await fetch(values.from);
      if (!answer.ok) throw new Error(`vvgt view: ${await answer.text()}`);
      const { contents, ...rest } = await answer.json();
      ({ facts } = rest);
      for (const [id, textContent] of Object.entries(contents)) document.body.append(Object.assign(document.createElement('script'), { type: 'application/octet-stream', id, textContent }));
    }
    const grids = [];
    for (const one of facts) grids.push(await gridOf(one));
    return grids;
  };
  return () => (read ??= all());
}

// how much an axis of a grid is one of the world's, 0 to 1; and the grid's axis that is nearest to each of the world's
const share = ({ affine, edges }, k, axis) => Math.abs(affine[4 * k + axis]) / edges[axis];
function orderOf(grid) {
  const total = (order) => order.reduce((sum, axis, k) => sum + share(grid, k, axis), 0);
  return ORDERS.reduce((best, one) => (total(one) > total(best) + 1e-9 ? one : best));
}

// The largest angle between an axis of a grid and the world's that is nearest, whole degrees
export const tiltOf = (grid) => Math.round(Math.max(...orderOf(grid).map((axis, k) => (Math.acos(Math.min(share(grid, k, axis), 1)) * 180) / Math.PI)));

// A grid without codes along the world's axes, around a grid and as fine
export function uprightOf(grid) {
  const ends = Array.from({ length: 8 }, (_, n) => grid.toWorld(grid.dims.map((size, k) => ((n >> k) & 1 ? size - 0.5 : -0.5)))), edges = orderOf(grid).map((axis) => grid.edges[axis]);
  const [low, high] = [Math.min, Math.max].map((pick) => [0, 1, 2].map((k) => pick(...ends.map((p) => p[k])))), dims = edges.map((edge, k) => Math.ceil((high[k] - low[k]) / edge - 1e-6));
  const first = dims.map((n, k) => (low[k] + high[k] - (n - 1) * edges[k]) / 2), affine = edges.flatMap((edge, k) => [...[0, 1, 2].map((c) => (c === k ? edge : 0)), first[k]]);
  return { dims, edges, affine, toWorld: (index) => through(affine, index), toIndex: (p) => p.map((x, k) => (x - first[k]) / edges[k]) };
}

// the same of the frame that is shown: `framed` has the facts of each, shown() its number
export function framedGrids(framed, shown) {
  const read = new Map();
  return () => {
    const k = shown();
    if (!read.has(k)) read.set(k, Promise.all(framed[k].map((facts) => gridOf(facts, true))));
    if (read.size > FRAMES) read.delete(read.keys().next().value);
    return read.get(k);
  };
}

// The three slices along a grid's own axes, each named after the axis of the world that is nearest: {name, across, along, up: {axis, world: that axis, sign}, letters: of its four sides}
export function viewsOf(grid, { letters, anatomical }) {
  const { affine } = grid, order = orderOf(grid);
  const towards = (letter) => {
    const k = letters.findIndex((pair) => pair.includes(letter)), axis = order[k], end = letters[k].indexOf(letter);
    return { axis, world: k, sign: (end ? 1 : -1) * (affine[4 * k + axis] < 0 ? -1 : 1), ends: [letters[k][1 - end], letter] };
  };
  return (anatomical ? BODY : OTHER).map(([name, right, above]) => {
    const along = towards(right), up = towards(above);
    return { name, along, up, across: 3 - along.axis - up.axis, letters: { left: along.ends[0], right: along.ends[1], bottom: up.ends[0], top: up.ends[1] } };
  });
}
