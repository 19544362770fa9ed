// A transfer function and its means over normal laws of values, as vvgt_cli/gaussians/live.py has them (its float64 twin).
const FINE = 1 << 14;  // values over the range that a function is tabulated at
const MAX_OPACITY = 1 - 1e-5, MOST_COVERED = 1 - 1e-6, PARTS = 16, NO_GRAIN = 1e-6;

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

function rint(x) {
  const low = Math.floor(x), rest = x - low;
  return rest > 0.5 || (rest === 0.5 && low % 2) ? low + 1 : low;
}

// (means, spreads, 6) float64: extinction times r, g, b, 1, z and z^2; `live` as live_json of formats/live.py says it
export function sumsOf(nodes, live) {
  const [lo, hi] = live.values, [means, spreads] = live.table, { law, grain } = live, [wider, amount] = live.around;
  const fine = new Float64Array(4 * FINE);  // of each value what it covers times r, g, b and 1
  let most = 0;
  for (let i = 0; i < FINE; i++) {
    const { y, rgb } = functionAt(nodes, lo + (hi - lo) * (i * (1 / (FINE - 1))));
    const tau = -Math.log1p(-Math.min(Math.max(y, 0), MAX_OPACITY)) / live.unit_distance, covers = -Math.expm1(-tau * grain);
    most = Math.max(most, tau);
    fine.set([rgb[0] * covers, rgb[1] * covers, rgb[2] * covers, covers], 4 * i);
  }
  const sums = new Float64Array(means * spreads * 6), own = new Float64Array(6), near = new Float64Array(6);
  const under = (mean, spread, out) => {
    out.fill(0);
    for (const z of law) {
      const k = 4 * rint(Math.min(Math.max(mean + spread * z, 0), 1) * (FINE - 1)), covers = fine[k + 3];
      for (let c = 0; c < 4; c++) out[c] += fine[k + c];
      out[4] += covers * z;
      out[5] += covers * z * z;
    }
  };
  for (let j = 0; j < spreads; j++) {
    const spread = live.widest * (j / (spreads - 1)) ** live.bend;
    for (let i = 0; i < means; i++) {
      const to = 6 * (i * spreads + j), mean = i * (1 / (means - 1));
      under(mean, spread, own);
      if (!own[3]) continue;
      under(mean, wider * spread, near);
      const tau = Math.min(-Math.log1p(-Math.min(own[3] / law.length, MOST_COVERED)) / grain, most);
      for (let c = 0; c < 3; c++) {
        const color = own[c] / own[3], mixed = near[3] ? near[c] / near[3] : color;
        sums[to + c] = tau * Math.min(Math.max(color + amount * (color - mixed), 0), 1);
      }
      sums[to + 3] = tau;
      for (let c = 4; c < 6; c++) sums[to + c] = (tau * own[c]) / own[3];
    }
  }
  return sums;
}

// A layer as the table of its X-ray is made (exposed_distance of look/tables.py): a ray as long as the box through the volume's mean keeps 1/e
export function exposed(nodes, layer) {
  const [lo, hi] = layer.values, { histogram } = layer, step = (hi - lo) / histogram.length;
  let sum = 0, all = 0;
  histogram.forEach((count, k) => {
    all += count;
    for (let n = 0; count && n < PARTS; n++) sum -= (count / PARTS) * Math.log1p(-Math.min(Math.max(functionAt(nodes, lo + step * (k + (n + 0.5) / PARTS)).y, 0), MAX_OPACITY));
  });
  return { ...layer, grain: layer.grain * NO_GRAIN, unit_distance: (2 * sum) / all || layer.unit_distance };
}

// The same as a texture of RGBA32F, means wide: rows of r, g, b and extinction, then as many of z and z^2
export function texelsOf(sums, [means, spreads]) {
  const texels = new Float32Array(means * spreads * 2 * 4);
  for (let i = 0; i < means; i++) {
    for (let j = 0; j < spreads; j++) {
      const from = 6 * (i * spreads + j);
      texels.set(sums.subarray(from, from + 4), 4 * (j * means + i));
      texels.set(sums.subarray(from + 4, from + 6), 4 * ((spreads + j) * means + i));
    }
  }
  return texels;
}
