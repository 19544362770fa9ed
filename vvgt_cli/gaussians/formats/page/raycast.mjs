// The volume itself under the look of the panel: rays through the grids that the page holds, in a canvas over the Gaussians'. While something
// moves, at a third of the resolution; at rest whole, and jittered frames add up until they change nothing.
import { dot, plus } from './lens.mjs';
import { connected, nearest } from './piece.mjs';
import shader from './raycast.glsl';
import { exposed, extinction, functionAt, TABLE, tableOf, WIDE } from './table.mjs';

const BLOCK = 8, ROWS = TABLE / WIDE;  // edge of what is skipped where it is empty; rows of a table
const REST = 150, COARSE = 3, MOST = 32, QUIET = 2;  // ms without a change; part of the resolution; frames at most, and without a change
const FAST = 60, SLOW = 200, THIN = 8;  // ms in which a band of a frame may be done, to be twice, or half as high; its least rows
const HOLE = -65504, PART = 32;  // of what is unknown, which no value near it makes visible; of a step, in half precision: all others are far above it
const cells = (dims) => dims.map((n) => Math.ceil(n / BLOCK));
const STEEP = 2, BENT = 0.1;  // optical depth of a voxel by which extinction differs along a segment that is sampled finer while something moves; at rest
const LOST = 'its graphics were lost', BACK = 5000;  // ms until which they may come back
const FLAT = 0.02;  // steps of values between neighbours up to which rounding may be all there is
const FAINT = 0.05;  // opacity along a ray below which there is nothing
const AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1]], minus = (p, q) => p.map((x, c) => x - q[c]);
const halton = (n, base) => { let f = 1, r = 0; for (; n > 0; n = Math.floor(n / base)) { f /= base; r += f * (n % base); } return r; };

// the least (or greatest) of what each block meets, a voxel beyond its faces included
function reduced(codes, dims, pick) {
  let from = codes, size = [...dims];
  for (let axis = 0; axis < 3; axis++) {
    const to = [...size], stride = size.slice(0, axis).reduce((a, b) => a * b, 1), n = size[axis];
    to[axis] = Math.ceil(n / BLOCK);
    const out = new Uint16Array(to[0] * to[1] * to[2]), outer = size.slice(axis + 1).reduce((a, b) => a * b, 1);
    for (let o = 0, p = 0; o < outer; o++) for (let b = 0; b < to[axis]; b++) {
      const first = Math.max(BLOCK * b - 1, 0), last = Math.min(BLOCK * (b + 1), n - 1);
      for (let i = 0; i < stride; i++, p++) {
        let at = i + stride * (first + n * o), best = from[at];
        for (let k = first; k < last; k++) { at += stride; best = pick(best, from[at]); }
        out[p] = best;
      }
    }
    [from, size] = [out, to];
  }
  return from;
}
const less = (a, b) => (a < b ? a : b), more = (a, b) => (a > b ? a : b);

// what the shader has for each layer
function layersText(layers) {
  const joined = (mark, text) => layers.map((layer, k) => text(k, layer)).join(mark), each = (text) => joined('\n', text), single = layers.length === 1 && !layers[0].labels;
  return `uniform vec3 rim;  // half a voxel of the grid of all layers, which has the first one's box and the finest voxels
struct Sample { ${joined(' ', (k, { labels }) => `${labels ? 'vec4' : 'float'} s${k};`)} };  // values, and optics of labels
${each((k, { labels, one }) => `uniform ${labels ? 'usampler3D' : 'sampler3D'} v${k};
uniform sampler3D b${k};
uniform mat4 m${k};
uniform vec3 n${k}, f${k};  // dims; value at 0, what it gains, first row of the table
${k ? `uniform mat4 g${k}, h${k};  // from the first grid to this one, and back
vec3 framed${k}(vec3 q) {  // as \`vvgt render\` lays layers on one grid: between its faces and its outermost voxels' centres nothing changes
  vec3 first = (h${k} * vec4(q, 1.0)).xyz, c = clamp(first, rim, 1.0 - rim);
  return q + mat3(g${k}) * (c - first);
}` : 'vec3 framed0(vec3 q) { return q; }'}
vec2 empty${k}(vec3 p, vec3 d, float best) {  // how far to the end of a block; 1: it shows something
  vec3 edge = n${k} / ${BLOCK}.0, q = (m${k} * vec4(p, 1.0)).xyz, r = mat3(m${k}) * d * edge;
  if (!within(q)) return vec2(ds, 0.0);
  ivec3 block = clamp(ivec3(floor(q * edge)), ivec3(0), ivec3(ceil(edge)) - 1);
  vec2 there = texelFetch(b${k}, block, 0).rg;
  return vec2(leaving(block, q * edge, r), (kind == 1 ? there.g > best : there.r > 0.0) ? 1.0 : 0.0);
}
${labels ? `vec4 look${k}(ivec3 i) { return entry(float(texelFetch(v${k}, i, 0).r), int(f${k}.z)); }
vec4 at${k}(vec3 p) {
  vec3 q = (m${k} * vec4(p, 1.0)).xyz, x = clamp(framed${k}(q) * n${k} - 0.5, vec3(0.0), n${k} - 1.0), f = fract(x);
${k ? '  if (!within(q)) return vec4(0.0);' : ''}
  ivec3 i = ivec3(x), j = min(i + 1, ivec3(n${k}) - 1);
  return mix(mix(mix(look${k}(i), look${k}(ivec3(j.x, i.yz)), f.x), mix(look${k}(ivec3(i.x, j.y, i.z)), look${k}(ivec3(j.xy, i.z)), f.x), f.y),
    mix(mix(look${k}(ivec3(i.xy, j.z)), look${k}(ivec3(j.x, i.y, j.z)), f.x), mix(look${k}(ivec3(i.x, j.yz)), look${k}(j), f.x), f.y), f.z);
}
// the gradient of extinction, smoothed as vvgt_cli/dvr/relief.py does: of a sum over 3 x 3 x 3 voxels, by central differences that are interpolated
vec3 smooth${k}(vec3 p) {
  vec3 q = clamp(framed${k}((m${k} * vec4(p, 1.0)).xyz) * n${k} - 0.5, vec3(0.0), n${k} - 1.0), f = fract(q), g = vec3(0.0);
  ivec3 first = ivec3(q), last = ivec3(n${k}) - 1;
  float own = look${k}(first).a;
  bool inside = true;  // as most of a body is
  for (int c = 0; c < 16 && inside; c++) inside = look${k}(clamp(first + ivec3(c & 1, (c >> 1) & 1, (c >> 2) & 1) * (c < 8 ? 5 : 1) - (c < 8 ? 2 : 0), ivec3(0), last)).a == own;
  if (inside) return vec3(0.0);
  vec3 sums[6] = vec3[6](vec3(0.0), 1.0 - f, vec3(1.0), vec3(1.0), f, vec3(0.0)), rises[6] = vec3[6](f - 1.0, vec3(-1.0), -f, 1.0 - f, vec3(1.0), f);
  for (int z = 0; z < 6; z++) for (int y = 0; y < 6; y++) for (int x = 0; x < 6; x++) {
    vec3 s = vec3(sums[x].x, sums[y].y, sums[z].z), w = vec3(rises[x].x, rises[y].y, rises[z].z) * s.yxx * s.zzy;
    if (w != vec3(0.0)) g += w * (look${k}(clamp(first + ivec3(x, y, z) - 2, ivec3(0), last)).a - own);
  }
  return (g * n${k}) * mat3(m${k});
}` : `float value${k}(vec3 p) {
  vec3 q = (m${k} * vec4(p, 1.0)).xyz;
  return ${k ? '!within(q) ? -1e4 : ' : ''}f${k}.x + f${k}.y * texture(v${k}, framed${k}(q)).r;
}
vec3 gradient${k}(vec3 p) {
  vec3 e = 1.0 / n${k}, q = clamp(framed${k}((m${k} * vec4(p, 1.0)).xyz), 0.5 * e, 1.0 - 0.5 * e);
  float a[6] = float[6](${[' + ', ' - '].flatMap((sign) => ['e.x, 0, 0', '0, e.y, 0', '0, 0, e.z'].map((way) => `texture(v${k}, framed${k}(q${sign}vec3(${way}))).r`)).join(', ')});
  for (int i = 0; i < 6; i++) if (f${k}.x + f${k}.y * a[i] < -0.5) return vec3(0.0);
  vec3 rise = vec3(a[0] - a[3], a[1] - a[4], a[2] - a[5]);
  return all(lessThan(abs(rise), vec3(${FLAT * one}))) ? vec3(0.0) : (rise * n${k} * f${k}.y) * mat3(m${k});
}`}`)}
vec2 empty(vec3 p, vec3 d, float best) {
  vec2 span = vec2(1e9, 0.0), one;
${each((k) => `  one = empty${k}(p, d, best);
  span = vec2(min(span.x, one.x), max(span.y, one.y));`)}
  return span;
}
float kept(vec3 p) { return texture(piece, (m0 * vec4(p, 1.0)).xyz).r; }
Sample sampled(vec3 p) { return Sample(${joined(', ', (k, { labels }) => (labels ? `at${k}(p)` : `value${k}(p)`))}); }
Sample blended(Sample a, Sample b, float f) { return Sample(${joined(', ', (k) => `mix(a.s${k}, b.s${k}, f)`)}); }
bool steep(Sample a, Sample b) {
  vec4 off = vec4(0.0);
${each((k, { labels }) => (labels ? '' : `  if (min(a.s${k}, b.s${k}) > -0.5) off = max(off, abs(entry(clamp(b.s${k}, 0.0, 1.0) * LAST, int(f${k}.z)) - entry(clamp(a.s${k}, 0.0, 1.0) * LAST, int(f${k}.z))));`))}
  return max(max(off.r, off.g), max(off.b, off.a)) > most;
}
${each((k, { labels }) => `vec4 optics${k}(Sample a, Sample b) { return ${labels ? `0.5 * (a.s${k} + b.s${k})` : `min(a.s${k}, b.s${k}) < -0.5 ? vec4(0.0) : between(a.s${k}, b.s${k}, int(f${k}.z))`}; }`)}
vec4 optics(Sample a, Sample b) { return ${joined(' + ', (k) => `optics${k}(a, b)`)}; }
float greater(Sample a, Sample b) { return ${single ? 'max(a.s0, b.s0)' : '0.0'}; }
// colour c of a segment from a to b under the light: each layer has its own normals
vec3 lighted(vec3 c, Sample a, Sample b, vec3 p, vec3 d) {
  ${layers.length === 1 ? `return lit(c, ${layers[0].labels ? 'smooth' : 'gradient'}0(p), d);` : `vec3 plain = vec3(0.0), shaded = vec3(0.0);
  float all = 0.0;
  vec4 one;
${each((k, { labels }) => `  one = optics${k}(a, b);
  if (one.a > 0.0) { all += one.a; plain += one.rgb; shaded += one.a * lit(one.rgb / one.a, ${labels ? 'smooth' : 'gradient'}${k}(p), d); }`)}
  return all > 0.0 ? clamp(c + (shaded - plain) / all, 0.0, 1.0) : c;`}
}
vec4 onFace(vec3 p) {
  vec4 seen = vec4(0.0);
${each((k, { labels }) => (labels ? '' : `  if (faced == ${k}) {
    float s = value${k}(p);
    if (s >= -0.5) seen = vec4(vec3(clamp((s - face.x) * face.y, 0.0, 1.0)), 1.0);
  }`))}
${each((k, { labels }) => (labels ? `  {
    vec3 q = (m${k} * vec4(p, 1.0)).xyz;
    vec4 own = within(q) ? look${k}(min(ivec3(q * n${k}), ivec3(n${k}) - 1)) : vec4(0.0);
    if (own.a > 0.0) seen = vec4(mix(own.rgb / own.a, seen.rgb, 0.5 * seen.a), 1.0);
  }` : ''))}
  return seen;
}
`;
}

const SHOWN = `#version 300 es
precision highp float;
uniform sampler2D sums, older;
uniform vec2 size;
uniform float frames, all;
out vec4 color;
void main() {
  vec2 at = gl_FragCoord.xy / size;
  vec3 now = floor(255.0 * clamp(texture(sums, at).rgb / frames, 0.0, 1.0) + 0.5);
  if (all < 0.5 && now == floor(255.0 * clamp(texture(older, at).rgb / (frames - 1.0), 0.0, 1.0) + 0.5)) discard;
  color = vec4(now / 255.0, 1.0);
}`, CORNERS = '#version 300 es\nvoid main() { gl_Position = vec4(vec2(float((gl_VertexID & 1) << 2), float((gl_VertexID & 2) << 1)) - 1.0, 0.0, 1.0); }';

function programOf(gl, fragment) {
  const made = gl.createProgram(), places = new Map();
  for (const [type, text] of [[gl.VERTEX_SHADER, CORNERS], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(`its shaders: ${gl.getAttachedShaders(made).map((one) => gl.getShaderInfoLog(one)).join(' ').slice(0, 300)}`);
  return (kind, name, ...values) => {
    if (!places.has(name)) places.set(name, gl.getUniformLocation(made, name));
    gl.useProgram(made);
    gl[`uniform${kind}`](places.get(name), ...values);
  };
}

function textureOf(gl, unit, target, internal, [nx, ny, nz]) {
  const made = gl.createTexture(), smooth = [gl.R8, gl.R16F, gl.RGBA8].includes(internal) ? gl.LINEAR : gl.NEAREST;
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(target, made);
  for (const wrap of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) gl.texParameteri(target, wrap, gl.CLAMP_TO_EDGE);
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, filter, smooth);
  if (nz) gl.texStorage3D(target, 1, internal, nx, ny, nz);
  else gl.texStorage2D(target, 1, internal, nx, ny);
  return made;
}

// a grid as a texture of unit 2 + 2 k, its blocks as one of 3 + 2 k: {k, grid, layer, labels, blocks, scale: of values to the layer's range}
function uploaded(gl, grid, layer, k) {
  const { dims: [nx, ny, nz], codes, missing, lo, step, bits } = grid, [first, last] = layer.values, span = last - first || 1, labels = Boolean(grid.labels), room = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
  if (Math.max(nx, ny, nz) > room) throw new Error(`it draws at most ${room} voxels along an axis`);
  const whole = labels || (bits === 8 && !missing), byte = bits === 8, middle = Math.round((grid.level - lo) / step) + missing;
  const [internal, format, type] = labels ? [byte ? gl.R8UI : gl.R16UI, gl.RED_INTEGER, byte ? gl.UNSIGNED_BYTE : gl.UNSIGNED_SHORT] : whole ? [gl.R8, gl.RED, gl.UNSIGNED_BYTE] : [gl.R16F, gl.RED, gl.FLOAT];
  const values = textureOf(gl, 2 + 2 * k, gl.TEXTURE_3D, internal, grid.dims), blocks = textureOf(gl, 3 + 2 * k, gl.TEXTURE_3D, gl.RG8, cells(grid.dims));
  gl.activeTexture(gl.TEXTURE2 + 2 * k);
  for (let z = 0; z < nz; z++) {  // half precision is exact to 2048 steps on both sides of the middle of most values
    const slice = codes.subarray(z * nx * ny, (z + 1) * nx * ny);
    gl.texSubImage3D(gl.TEXTURE_3D, 0, 0, 0, z, nx, ny, 1, format, type, whole ? slice : Float32Array.from(slice, (code) => (code < missing ? HOLE : (code - middle) / PART)));
  }
  const entry = (code) => Math.min(Math.max(((lo + step * (Math.max(code, missing) - missing) - first) / span) * (TABLE - 1), 0), TABLE - 1);
  return {
    k, grid, layer, labels, one: whole ? 1 / 255 : 1 / PART, held: [values, blocks],
    scale: labels ? [0, 0] : whole ? [(lo - first) / span, (255 * step) / span] : [(lo + step * (middle - missing) - first) / span, (PART * step) / span],
    entries: labels ? [] : [less, more].map((pick, end) => Uint16Array.from(reduced(codes, grid.dims, pick), (code) => (end ? Math.ceil : Math.floor)(entry(code)))),
  };
}

// {layers, nodes, rows, planes: what is shown; apply(nodes, k), labels(list, k), cut(planes), light(of light.mjs), draw(kind), face({layer, from, to} or null): values on the cut; show(now);
// picture(size): a canvas; pick(ray): a place; at(place): its value; rested: nothing changes any more; said: why it cannot}; begin(lens, world, covering(now)) comes first
export function raycaster(facts, gridsOf, { app }) {
  const canvas = Object.assign(document.createElement('canvas'), { id: 'volume', hidden: true });
  let gl = null, ray = null, put = null, looks = null, drawn = [], grids = [], lens = null, world = null, covering = null, starting = null, deep = 0;
  let wanted = false, covers = false, version = 0, kind = 0, lamp = facts.light, face = null, grey = [0, 1], piece = null, mask = null, chosen = null;
  let compiled = '', key = '', since = 0, frame = 0, quiet = 0, row = 0, rows = 64, pair = [], fence = null, begun = 0, query = null, waiting = 0, turn = 0, busy = Promise.resolve(), still = 0;

  const distance = (k, nodes) => (kind === 2 ? exposed(nodes, look.layers[k]) : look.layers[k].unit_distance);
  // table and blocks of a layer, under its look or other nodes
  function tabulate(k, nodes = look.nodes[k]) {
    version++;
    for (const one of gl ? drawn.filter(({ grid }) => grid.layer === k) : []) {
      const size = cells(one.grid.dims), blocks = new Uint8Array(2 * size[0] * size[1] * size[2]);
      let texels = new Float32Array(8 * TABLE);
      if (one.labels) {
        look.rows[k].forEach(({ rgb, opacity }, j) => { const tau = extinction(opacity, one.layer.unit_distance); texels.set([...rgb.map((c) => c * tau), tau], 4 * (j + 1)); });
        const seen = Uint8Array.from({ length: look.rows[k].length + 1 }, (_, j) => (texels[4 * j + 3] > 0 ? 1 : 0)), said = seen.join('');
        if (said !== one.said) [one.said, one.there] = [said, reduced(Uint8Array.from(one.grid.codes, (code) => seen[code]), one.grid.dims, more)];
        one.there.forEach((is, b) => { blocks[2 * b] = 255 * is; });
      } else {
        const { texels: of, seen } = tableOf(nodes, one.layer, distance(k, nodes)), [low, high] = one.entries;
        texels = of;
        low.forEach((first, b) => {
          blocks[2 * b] = seen[Math.min(high[b] + 2, TABLE)] > seen[Math.max(first - 1, 0)] ? 255 : 0;
          blocks[2 * b + 1] = Math.ceil((255 * high[b]) / (TABLE - 1));
        });
      }
      gl.activeTexture(gl.TEXTURE0);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 2 * ROWS * one.k, WIDE, 2 * ROWS, gl.RGBA, gl.FLOAT, texels);
      gl.activeTexture(gl.TEXTURE3 + 2 * one.k);
      gl.texSubImage3D(gl.TEXTURE_3D, 0, 0, 0, 0, ...size, gl.RG, gl.UNSIGNED_BYTE, blocks);
    }
  }

  const place = (grid, index) => world().at(grid.toWorld(index)), index = (grid, p) => grid.toIndex(world().place(p));
  const edgesOf = (grid) => AXES.map((e) => minus(place(grid, e), place(grid, [0, 0, 0])));
  async function start() {
    const mine = ++turn, read = await gridsFor();
    if (mine !== turn) return;
    grids = read;
    gl = canvas.getContext('webgl2', { alpha: false, antialias: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error('it has no WebGL 2');
    if (gl.isContextLost()) throw new Error(LOST);
    if (gl.getParameter(gl.MAX_TEXTURE_IMAGE_UNITS) < 3 + 2 * grids.length) throw new Error(`${grids.length} layers are too many for it`);
    deep = gl.getExtension('EXT_color_buffer_float') ? gl.RGBA32F : 0;
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    drawn.forEach(({ held }) => held.forEach((texture) => gl.deleteTexture(texture)));
    if (looks) gl.deleteTexture(looks);
    drawn = grids.map((grid, k) => uploaded(gl, grid, look.layers[grid.layer], k));
    putMask();
    looks = textureOf(gl, 0, gl.TEXTURE_2D, gl.RGBA32F, [WIDE, 2 * ROWS * drawn.length]);
    const text = shader.replace('LAYERS', () => layersText(drawn)).replaceAll('TABLE', TABLE);
    if (!ray || text !== compiled) [ray, put, compiled] = [programOf(gl, text), programOf(gl, SHOWN), text];
    ray('1i', 'looks', 0);
    ray('1i', 'before', 1);
    ray('1i', 'piece', masked());
    put('1i', 'sums', 1);
    put('1i', 'older', 0);
    const part = (grid, at) => at.map((x, c) => (x + 0.5) / grid.dims[c]), voxel = (grid, at) => at.map((x, c) => x * grid.dims[c] - 0.5);
    const matrix = (to) => { const o = to([0, 0, 0]); return [...AXES.flatMap((e) => [...minus(to(e), o), 0]), ...o, 1]; };
    const between = (from, to) => matrix((at) => part(to, index(to, place(from, voxel(from, at)))));
    const finer = (axis, grid) => AXES.map((_, c) => Math.round((Math.abs(between(grids[0], grid)[4 * axis + c]) * grid.dims[c]) / grids[0].dims[axis] - 1e-6));  // as dvr/layers.py has it
    ray('3f', 'rim', ...AXES.map((_, axis) => 0.5 / (grids[0].dims[axis] * Math.max(1, ...grids.flatMap((grid) => finer(axis, grid))))));
    for (const { k, grid, scale } of drawn) {
      ray('1i', `v${k}`, 2 + 2 * k);
      ray('1i', `b${k}`, 3 + 2 * k);
      ray('Matrix4fv', `m${k}`, false, matrix((p) => part(grid, index(grid, p))));
      if (k) ray('Matrix4fv', `g${k}`, false, between(grids[0], grid));
      if (k) ray('Matrix4fv', `h${k}`, false, between(grid, grids[0]));
      ray('3f', `n${k}`, ...grid.dims);
      ray('3f', `f${k}`, ...scale, 2 * ROWS * k);
    }
    look.step = Math.min(...grids.flatMap(edgesOf).map((edge) => Math.hypot(...edge)));
    look.layers.forEach((_, k) => tabulate(k));
  }
  // the texture of what is kept, of a voxel where everything is
  const masked = () => 2 + 2 * grids.length;
  function putMask() {
    version++;
    if (!gl) return;
    if (piece) gl.deleteTexture(piece);
    piece = textureOf(gl, masked(), gl.TEXTURE_3D, gl.R8, mask ? grids[0].dims : [1, 1, 1]);
    gl.texSubImage3D(gl.TEXTURE_3D, 0, 0, 0, 0, ...(mask ? grids[0].dims : [1, 1, 1]), gl.RED, gl.UNSIGNED_BYTE, mask ?? Uint8Array.of(255));
  }
  function fail({ message }) {
    look.said = `This browser cannot show the volume itself: ${message}. The conversion is shown, under its own look.`;
    gl = null;
    covers = null;
    cover(false);
  }
  // what the graphics had is gone: the conversion is shown until they are back, and all is uploaded anew
  canvas.addEventListener('webglcontextlost', (event) => {
    event.preventDefault();
    [gl, fence, query, pair, piece, frame] = [null, null, null, [], null, 0];
    cover(false);
    waiting = setTimeout(() => fail(new Error(LOST)), BACK);
  });
  canvas.addEventListener('webglcontextrestored', () => {
    clearTimeout(waiting);
    [starting, ray, looks, drawn, key, look.said, covers] = [null, null, null, [], '', '', null];
    covering?.(false);
  });
  function cover(now) {
    if (now === covers) return;
    covers = now;
    canvas.hidden = !now;
    covering(now);
  }

  // two textures that frames are added up in
  const targets = (size, internal) => [0, 1].map(() => {
    const sums = textureOf(gl, 1, gl.TEXTURE_2D, internal || gl.RGBA8, size), to = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, to);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, sums, 0);
    return { sums, to, size };
  });
  const freed = (some) => some.forEach(({ sums, to }) => { gl.deleteTexture(sums); gl.deleteFramebuffer(to); });
  const bound = (unit, texture) => { gl.activeTexture(gl.TEXTURE0 + unit); gl.bindTexture(gl.TEXTURE_2D, texture); };
  const onto = (to, [wide, high]) => { gl.bindFramebuffer(gl.FRAMEBUFFER, to); gl.viewport(0, 0, wide, high); };

  // origin and direction at the lower left corner of a part of the window, and what they gain across and up
  function raysOf([left, top, right, bottom]) {
    const [a, b, c] = [[left, bottom], [right, bottom], [left, top]].map(([x, y]) => lens.ray(x, y));
    return ['origin', 'direction'].map((name) => [...a[name], ...minus(b[name], a[name]), ...minus(c[name], a[name])]);
  }
  // rows of frame n, added to what the first texture has, in the second one
  function band([from, { to, size }], rays, n, first, many, times) {
    const cuts = Array.from({ length: 6 }, (_, k) => (look.planes[k] ? [...look.planes[k].normal, look.planes[k].place] : [0, 0, 0, 1]));
    ray('3fv', 'origin', rays[0]);
    ray('3fv', 'direction', rays[1]);
    ray('2f', 'size', ...size);
    ray('3f', 'jitter', n ? halton(n, 2) : 0.5, n ? halton(n, 3) : 0.5, n * 0.61803398875);
    ray('1f', 'ds', look.step * times * (kind === 1 ? 0.5 : 1));
    ray('1f', 'most', (times < 1 ? BENT : STEEP) / look.step);
    ray('1f', 'again', n);
    ray('1i', 'kind', kind);
    ray('1i', 'alone', mask ? 1 : 0);
    ray('2f', 'grey', grey[0], 1 / (grey[1] - grey[0]));
    ray('4fv', 'cuts', cuts.flat());
    ray('4f', 'light', ...(lamp.kind === 'none' ? [-1, 0, 0, 1] : [lamp.ambient, lamp.diffuse, lamp.specular, lamp.power]));
    ray('4f', 'toward', ...lamp.from, lamp.kind === 'headlight' ? 1 : 0);
    ray('4f', 'face', ...(face ? [face.from, 1 / Math.max(face.to - face.from, 1e-6), 0, 1] : [0, 0, 0, 0]));
    ray('1i', 'faced', face ? grids.findIndex(({ layer }) => layer === face.layer) : 0);
    bound(0, looks);
    bound(1, from.sums);
    onto(to, size);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, first, size[0], many);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
    begun = performance.now();
    fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }
  const done = () => {
    if (!fence) return true;
    if (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) return false;
    gl.deleteSync(fence);
    fence = null;
    const took = performance.now() - begun;
    if (took < FAST) rows = Math.min(2 * rows, 4096);
    else if (took > SLOW) rows = Math.max(Math.ceil(rows / 2), THIN);
    return true;
  };
  // the mean of frames; all, or what has changed
  function shown([sums, older], to, size, frames, all) {
    put('2f', 'size', ...size);
    put('1f', 'frames', frames);
    put('1f', 'all', all ? 1 : 0);
    bound(1, sums.sums);
    bound(0, older.sums);
    onto(to, size);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    bound(0, looks);
  }

  function tick() {
    if (wanted && !starting && world()) starting = start().catch(fail).then(() => { version++; });
    cover(Boolean(wanted && ray && gl && !app.xr?.active && key));
    if (!wanted || !ray || !gl || still || app.xr?.active || !done()) return;
    const { width, height, clientWidth: wide, clientHeight: high } = lens.canvas, size = [width, height], rays = raysOf([0, 0, wide, high]), said = JSON.stringify([rays, size, version]), now = performance.now();
    if (said !== key) {
      if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = size;
      [key, since, frame, row, quiet, query] = [said, now, 0, 0, 0, null];
      const small = targets(size.map((n) => Math.ceil(n / COARSE)), 0);
      band(small, rays, 0, 0, height, 1);
      shown([small[1], small[0]], null, size, 1, true);
      return freed(small);
    }
    if (now - since < REST || frame >= (deep ? MOST : 1) || quiet >= QUIET) return;
    if (query && gl.getQueryParameter(query, gl.QUERY_RESULT_AVAILABLE)) {
      quiet = gl.getQueryParameter(query, gl.QUERY_RESULT) ? 0 : quiet + 1;
      gl.deleteQuery(query);
      query = null;
    }
    if (pair[0]?.size.join() !== size.join()) { freed(pair); pair = targets(size, deep); }
    band(pair, rays, frame, row, rows, 0.5);
    row += rows;
    if (row < height) return;
    [row, frame] = [0, frame + 1];
    pair.reverse();
    query ??= gl.createQuery();
    gl.beginQuery(gl.ANY_SAMPLES_PASSED, query);
    shown(pair, null, size, frame, frame === 1);
    gl.endQuery(gl.ANY_SAMPLES_PASSED);
  }

  // a canvas of a part of the window, of so many frames
  async function drawing(size, part, frames) {
    if (!deep) frames = 1;
    const rays = raysOf(part), pixels = new Uint8ClampedArray(4 * size[0] * size[1]), made = Object.assign(document.createElement('canvas'), { width: size[0], height: size[1] });
    const sums = targets(size, deep), [last, spare] = targets(size, 0), pause = () => new Promise((next) => { setTimeout(next, 4); });
    for (let n = 0; n < frames; n++, sums.reverse()) {
      for (let first = 0, many = 0; first < size[1]; first += many) {
        many = rows;
        band(sums, rays, n, first, many, 0.5);
        while (gl && !done()) await pause();
        if (!gl) throw new Error(look.said || LOST);
      }
    }
    shown(sums, last.to, size, frames, true);
    gl.bindFramebuffer(gl.FRAMEBUFFER, last.to);
    gl.readPixels(0, 0, ...size, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    freed([...sums, last, spare]);
    const to = made.getContext('2d');
    to.putImageData(new ImageData(pixels, ...size), 0, 0);
    to.globalCompositeOperation = 'copy';
    to.setTransform(1, 0, 0, -1, 0, size[1]);  // rows go up
    to.drawImage(made, 0, 0);
    return made;
  }
  const alone = (task) => (busy = busy.catch(() => {}).then(async () => {
    starting ??= start().catch(fail);
    await starting;
    if (!gl) throw new Error(look.said);
    still++;
    try { return await task(); } finally { still--; version++; }
  }));

  const gridsFor = async () => (await gridsOf()).filter(({ layer }) => look.layers[layer]);
  const tauOf = (grid, code) => (code < grid.missing ? 0 : extinction(functionAt(look.nodes[grid.layer], grid.value(code)).y, distance(grid.layer, look.nodes[grid.layer])));
  const cutOff = (p) => look.planes.some(({ normal, place: most }) => dot(normal, p) > most) || (mask && !mask[grids[0].offset(index(grids[0], p))]);
  // the value and the extinction of each layer at a place
  const meets = (p) => grids.map((grid) => {
    const at = index(grid, p), layer = look.layers[grid.layer];
    if (grid.labels) {
      const own = grid.labels[grid.at(at) - 1], seen = own && look.rows[grid.layer][grid.at(at) - 1];
      return { layer: grid.layer, value: own?.name ?? null, in: '', row: own && grid.at(at) - 1, tau: seen ? extinction(seen.opacity, layer.unit_distance) : 0 };
    }
    const code = grid.near(...at), value = code < 0 ? NaN : grid.value(code), nodes = look.nodes[grid.layer];
    return Number.isNaN(value) ? { value: null, in: '', tau: 0 } : { layer: grid.layer, value, in: layer.unit, mean: grid.mean, tau: extinction(functionAt(nodes, value).y, distance(grid.layer, nodes)) };
  });

  const look = {
    canvas, layers: facts.layers, nodes: facts.layers.map(({ nodes }) => nodes), rows: facts.layers.map(({ labels }) => labels), planes: [], said: '',
    apply(nodes, k) { look.nodes[k] = nodes; tabulate(k); },
    labels(list, k) { look.rows[k] = list; tabulate(k); },
    cut(planes) { look.planes = planes; version++; },
    light(now) { lamp = now; version++; },
    draw(now) { kind = now; if (look.nodes[0]) tabulate(0); },
    face(now) { face = now; version++; },
    grey(now) { grey = now; version++; },
    // what is connected to a voxel, {at: index, least: extinction}, stays; null: everything
    async keep(now, going) {
      [mask, chosen] = [null, now];
      if (now) {
        const grid = (grids = await gridsFor())[0], most = grid.bits === 8 ? 256 : 1 << 16, seen = Uint8Array.from({ length: most }, (_, code) => (tauOf(grid, code) >= now.least ? 1 : 0));
        const body = await connected(grid, now.at[0] + grid.dims[0] * (now.at[1] + grid.dims[1] * now.at[2]), seen, () => new Promise((next) => { setTimeout(() => next(going())); }));
        if (!going()) return;
        mask = body;
      }
      putMask();
    },
    // another frame is shown
    renew() {
      starting = null;
      if (chosen) look.keep(chosen, () => true);
    },
    // the voxel at a place that shows most: {at: its index, tau: its extinction}, null where none does
    seedAt(p) {
      const [grid] = grids, [nx, ny] = grid.dims, [i, tau] = nearest(grid, index(grid, p), (code) => tauOf(grid, code));
      return i < 0 ? null : { at: [i % nx, Math.floor(i / nx) % ny, Math.floor(i / (nx * ny))], tau };
    },
    begin(...given) { [lens, world, covering] = given; app.on('update', tick); },
    show(now) { wanted = now; },
    get wanted() { return wanted; },
    get shows() { return covers; },
    get rested() { return Boolean(look.said) || !wanted || (covers && !still && (frame >= (deep ? MOST : 1) || quiet >= QUIET) && key.endsWith(`,${version}]`)); },
    picture: (size, frames = 16, part = [0, 0, lens.canvas.clientWidth, lens.canvas.clientHeight]) => alone(() => drawing(size, part, frames)),
    // where half of what a ray meets is in front, of a MIP where its greatest value is; null: nothing
    async pick({ origin, direction }) {
      grids = await gridsFor();
      const d = direction.map((x) => x / Math.hypot(...direction)), [o, r] = [index(grids[0], origin), minus(index(grids[0], plus(origin, d)), index(grids[0], origin))], passed = [];
      const ends = o.map((x, c) => [(-0.5 - x) / r[c], (grids[0].dims[c] - 0.5 - x) / r[c]]), step = Math.min(...grids.flatMap(edgesOf).map((edge) => Math.hypot(...edge))) / 2;
      let [t, end] = [Math.max(...ends.map((some) => Math.min(...some)), 0), Math.min(...ends.map((some) => Math.max(...some)))], rest = 1;
      for (t += step / 2; t < end; t += step) {
        const p = plus(origin, d, t);
        if (cutOff(p)) continue;
        const met = meets(p);
        if (kind !== 1) rest *= Math.exp(-met.reduce((sum, { tau }) => sum + tau, 0) * step);
        passed.push([p, kind === 1 ? met[0].value ?? -Infinity : rest]);
      }
      if (kind === 1) return passed.reduce((best, one) => (one[1] > best[1] ? one : best), [null, -Infinity])[0];
      return 1 - rest < FAINT ? null : passed.find(([, left]) => 1 - left >= (1 - rest) / 2)[0];
    },
    // {value, in, layer, row} of the layer that is most at a place
    at(p) {
      const { tau, ...most } = meets(p).reduce((best, one) => (one.tau > best.tau ? one : best));
      return most;
    },
  };
  return look;
}
