// What the file says of itself: the comments of its header (docs/conventions.md, "The .ply") as the engine hands them on.
const UP = {  // world axes as PLY has them, rows, by the axis that is up (frames.py)
  none: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], x: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], '-x': [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
  y: [[1, 0, 0], [0, -1, 0], [0, 0, -1]], '-y': [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
  z: [[1, 0, 0], [0, 0, -1], [0, 1, 0]], '-z': [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
};
const OPPOSITE = { R: 'L', L: 'R', A: 'P', P: 'A', S: 'I', I: 'S' };

// The legend of a baked look, of JSON {values, unit, nodes} or {labels, of}; null where it is damaged
function legendOf(text) {
  try {
    const { values, unit, quantity, nodes, labels, of } = JSON.parse(text), rgb = (hex) => [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16) / 255);
    if (labels) return { labels: labels.map(([name, hex]) => ({ name: String(name), rgb: rgb(hex) })), of };
    if (!values.every(Number.isFinite)) return null;
    return { values, unit, quantity, nodes: nodes.map(([x, y, hex]) => ({ x, y, rgb: rgb(hex) })) };
  } catch { return null; }
}

// How near the volume's the pictures are, as the conversion measured, of the JSON of a certificate (docs/certificate.md); '' where it is damaged
function qualityOf(text) {
  try {
    const { psnr, live_psnr: live, size } = JSON.parse(text), dB = live ?? psnr;
    return Number.isFinite(dB) ? `${dB.toFixed(1)} dB PSNR on test views of ${Number(size)} px (higher is better)${Number.isFinite(live) ? ', under its own function and light' : ''}` : '';
  } catch { return ''; }
}

// {version, scale, centre, frame, up, space, 'length-unit', function, size, rule, 'unit-distance', label, light, unit, legend, quality}: text and numbers
export function factsOf(comments) {
  const facts = { up: 'none', space: 'none', frame: 'unit' };
  for (const comment of comments ?? []) {
    const [, key, text = ''] = /^vvgt\s+(\S+)\s*(.*)$/.exec(comment.trim()) ?? [], rest = text.split(/\s+/);
    if (!key) continue;
    if (key === 'frame') {
      facts.frame = rest[0];
      if (rest[1] === 'scale') [facts.scale, facts.centre] = [Number(rest[2]), rest.slice(4, 7).map(Number)];
    } else if (key === 'unit-distance') [facts[key], facts.label] = [Number(rest[0]), text.slice(rest[0].length).trim()];
    else if (key === 'size') [facts.size, facts.rule] = [Number(rest[0]), rest[2]];
    else if (key === 'function') facts.function = JSON.parse(text);
    else if (key === 'legend') facts.legend = legendOf(text);
    else if (key === 'certificate') facts.quality = qualityOf(text);
    else if (key === 'live') { if (rest[0] === 'unit') facts.unit = rest.slice(1).join(' '); }
    else if (text) facts[key] = text;
    else facts.version = key;
  }
  if (!(facts.up in UP)) facts.up = 'none';
  return facts;
}

// The file's world beside the viewer's axes, which have PLY (x, y, z) at (-x, -y, z): directions of its axes there, the letters
// at both ends of each, the unit of lengths ('' unknown), and how long one of the viewer's lengths is in it.
// What is streamed is shown `enlarged` times as large.
export function worldOf(facts, enlarged = 1) {
  const rows = UP[facts.up], half = [-1, -1, 1], unit = enlarged * (facts.frame === 'unit' && facts.scale ? facts.scale : 1);
  const centre = facts.frame === 'unit' && facts.centre ? facts.centre : [0, 0, 0];
  const axes = [0, 1, 2].map((k) => [0, 1, 2].map((row) => half[row] * rows[row][k]));
  const anatomical = /^[RL][AP][SI]$/.test(facts.space);
  const letters = [0, 1, 2].map((k) => (anatomical ? [OPPOSITE[facts.space[k]], facts.space[k]] : ['−', ''].map((sign) => sign + 'xyz'[k])));
  const known = anatomical ? 'mm' : (facts['length-unit'] ?? '').replace(/^um$/, 'µm');
  return {
    axes, letters, anatomical, unit: known, length: 1 / unit,
    at: (p) => [0, 1, 2].map((row) => axes.reduce((sum, axis, k) => sum + axis[row] * (p[k] - centre[k]) * unit, 0)),  // and back
    place: (p) => axes.map((axis, k) => (axis[0] * p[0] + axis[1] * p[1] + axis[2] * p[2]) / unit + centre[k]),
  };
}

export const DIAGNOSIS = 'not for diagnosis';
export const isMedical = ({ anatomical }, values) => anatomical || Boolean(values?.some?.(({ unit }) => unit === 'HU'));

// A length, a coordinate or a value as it is read, with all digits before the point if it is `whole`
export function shown(x, digits = 4, whole = false) {
  const text = String(Number(x.toPrecision(whole ? Math.min(Math.max(String(Math.trunc(Math.abs(x))).length, digits), 15) : digits)));
  return text.replace('-', '−');
}
