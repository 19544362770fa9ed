// Messages between the page and the site that shows it in a frame (docs/page.md, "In a site").
import { dot } from './lens.mjs';
import { functionFile } from './server.mjs';

const OFTEN = 100;  // milliseconds between two messages of a change
const KINDS = ['none', 'headlight', 'direction'];

const numbers = (list, count, what) => {
  if (!Array.isArray(list) || (count && list.length !== count) || !list.every(Number.isFinite)) throw new Error(`${what}: expected ${count || 'a list of'} numbers`);
  return list;
};

function cutFrom({ kind, normal, at = 0.5, flipped = false, box }) {
  if (kind === 'none') return { kind };
  if (kind === 'box') {
    if (numbers(box, 6, 'cut.box').some((x, k) => x < 0 || x > 1 || (k % 2 && x <= box[k - 1]))) throw new Error('cut.box: expected from and to of each axis, in [0, 1]');
    return { kind, box };
  }
  const length = Math.hypot(...numbers(normal, 3, 'cut.normal'));
  if (kind !== 'plane' || !length || !(at >= 0 && at <= 1)) throw new Error('cut: expected kind none, box or plane; normal is not 0, at in [0, 1]');
  return { kind, normal: normal.map((x) => x / length), at, flipped: Boolean(flipped) };
}

function nodesFrom({ points }) {
  if (!Array.isArray(points) || points.length < 2) throw new Error('function: expected at least two points');
  return points.map(({ x, opacity, rgb }, k) => {
    numbers([x, opacity, ...numbers(rgb, 3, 'rgb')], 5, 'a point');
    if (k && x < points[k - 1].x) throw new Error('function: expected points in ascending order');
    return { x, y: Math.min(Math.max(opacity, 0), 1), rgb };
  });
}

// views: {name: shows that view}; axes: of the file's world in the viewer's; returns say(what, facts), to the site, and apply(what), of a message
export function messages({ live, lens, views, axes, moving }, app) {
  const say = (vvgt, facts) => { if (parent !== window) parent.postMessage({ vvgt, ...facts }, '*'); };
  const toWorld = (d) => axes().map((axis) => dot(axis, d)), fromWorld = (d) => [0, 1, 2].map((c) => axes().reduce((sum, axis, k) => sum + axis[c] * d[k], 0));
  const cut = () => ({ ...live.cut.state(), normal: toWorld(live.cut.state().normal) }), light = () => ({ ...live.lamp.state(), from: toWorld(live.lamp.state().from) });
  const rounded = (what) => JSON.parse(JSON.stringify(what, (key, x) => (typeof x === 'number' ? Number(x.toFixed(6)) : x)));
  const state = () => ({
    camera: rounded({ ...lens.pose(), orthographic: lens.flat }),
    ...(live && {
      cut: rounded(cut()), light: rounded(light()),
      layers: live.layers.map(({ named, nodes, rows }) => (nodes ? { function: functionFile(nodes(), named()) } : { labels: rows() })),
    }),
  });
  const set = {
    camera(to) {
      if (typeof to === 'string') {
        if (!Object.hasOwn(views, to)) throw new Error(`camera: expected one of ${Object.keys(views).join(', ')}, or an object`);
        return views[to]();
      }
      const { target, pitch, yaw, distance } = { ...lens.pose(), ...to };
      numbers([...numbers(target, 3, 'camera.target'), pitch, yaw, distance], 6, 'camera');
      lens.set({ target, pitch, yaw, distance: Math.max(distance, 1e-6) });
      if (to.orthographic !== undefined) lens.flat = Boolean(to.orthographic);
    },
    cut(to) {
      const next = cutFrom(to);
      live.cut.keep();
      live.cut.change({ ...next, ...(next.normal && { normal: fromWorld(next.normal) }) });
    },
    light(to) {
      const next = { ...light(), ...to };
      const length = Math.hypot(...numbers(next.from, 3, 'light.from'));
      if (!KINDS.includes(next.kind) || !length || numbers([next.ambient, next.diffuse, next.specular], 3, 'light').some((x) => x < 0 || x > 1000)) throw new Error(`light: expected kind ${KINDS.join(', ')}; from other than 0, the others from 0 to 1000`);
      live.cut.keep();
      live.lamp.set({ ...next, from: fromWorld(next.from.map((x) => x / length)) });
    },
    function(to, layer) {
      if (!layer.nodes) throw new Error('function: the layer has labels');
      layer.set(nodesFrom(to));
    },
    labels(to, layer) {
      if (!layer.rows) throw new Error('labels: the layer has a function');
      layer.set(to);
    },
  };
  function apply(data) {
    for (const key of Object.keys(set).filter((name) => data[name] !== undefined)) {
      const layer = live?.layers[data.layer ?? 0];
      if (key !== 'camera' && !layer) throw new Error(live ? `layer ${data.layer}: not there` : `${key}: cannot be changed on this page`);
      try {
        set[key](data[key], layer);
      } catch (error) { throw error instanceof TypeError ? new Error(`${key}: not in the documented form (${error.message})`) : error; }
    }
    moving();
  }
  addEventListener('message', ({ source, data }) => {
    if (source !== parent || parent === window || data?.vvgt !== 'set') return;
    try {
      apply(data);
    } catch ({ message }) { say('error', { message }); }
  });
  let told = '', last = 0;
  if (parent !== window) {
    app.on('update', () => {
      if (!told || performance.now() - last < OFTEN) return;
      const now = state(), text = JSON.stringify(now);
      last = performance.now();
      if (text !== told) say('changed', now);
      told = text;
    });
  }
  return {
    say, apply,
    loaded() {
      const now = state();
      told = JSON.stringify(now);
      say('loaded', { title: document.title, ...now });
    },
  };
}
