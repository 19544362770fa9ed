// Gaussians that carry values, under any function: their bytes as streams of the engine, the function's table as a texture.
import { FILTER_NEAREST, PIXELFORMAT_RGBA32F, PIXELFORMAT_RGBA8U, PROJECTION_ORTHOGRAPHIC, Texture } from 'playcanvas';
import { Damaged } from './damage.mjs';
import { drawn } from './grey.mjs';
import { layersOf } from './live_at.mjs';
import modifier from './live.glsl';
import { exposed, sumsOf, texelsOf } from './live_table.mjs';

const STREAMS = [['vvgtValues', [0, 1, 2, 9]], ['vvgtGradient', [3, 4, 5, 10]], ['vvgtAxis', [6, 7, 8]]];  // and the planes of each one's r, g, b and a
const MOST_OPAQUE = 1 - 1e-5;  // opacity of which there still is an extinction

// the planes of bytes, one after the other, that the page holds (gzip in base64), `size` of them
export async function unpacked(id, alone, size) {
  try {
    const element = document.getElementById(id), text = atob(element.textContent);
    const stream = new Blob([Uint8Array.from(text, (c) => c.charCodeAt(0))]).stream();
    if (alone) element.remove();  // of several frames, one that left memory is read again
    const bytes = new Uint8Array(await new Response(stream.pipeThrough(new DecompressionStream('gzip'))).arrayBuffer());
    if (bytes.length === size) return bytes;
  } catch { /* said below */ }
  throw new Damaged('its values are incomplete');
}

// {live, layers, bytes, count, sums, rows, planes, apply(nodes, k), sketch(nodes, k), labels(list, k), cut(planes), light(of light.mjs), frame(k, resource)} of a viewer that has loaded its Gaussians, once they are shown so
export async function liveLook({ app }, live) {
  const entity = app.root.findByName('gsplat'), { gsplat } = entity, { resource } = app.assets.get(gsplat.asset);
  const { planes } = live, layers = layersOf(live), carried = new WeakMap();  // bytes of the resources that have them
  async function carry(k, to) {
    if (carried.has(to)) return carried.get(to);
    const bytes = await unpacked(live.elements[k], live.elements.length === 1, planes * to.gsplatData.numSplats), count = bytes.length / planes;
    to.format.addExtraStreams(STREAMS.map(([name]) => ({ name, format: PIXELFORMAT_RGBA8U })));
    for (const [name, own] of STREAMS) {
      const texture = to.getTexture(name), texels = texture.lock();
      own.forEach((plane, c) => { for (let i = 0; plane < planes && i < count; i++) texels[4 * i + c] = bytes[plane * count + i]; });
      texture.unlock();
    }
    carried.set(to, bytes);
    return bytes;
  }
  const bytes = await carry(0, resource), count = bytes.length / planes;
  const [means, spreads] = live.table, nearest = { minFilter: FILTER_NEAREST, magFilter: FILTER_NEAREST };
  const table = new Texture(app.graphicsDevice, { name: 'vvgtTable', width: means, height: 2 * spreads * layers.length, format: PIXELFORMAT_RGBA32F, mipmaps: false, ...nearest });
  const labels = new Texture(app.graphicsDevice, { name: 'vvgtLabels', width: layers.reduce((sum, layer) => sum + Math.max(layer.labels.length, 1), 0), height: 1, format: PIXELFORMAT_RGBA32F, mipmaps: false, ...nearest });
  const [first, last] = live.log_lengths;
  let again = 0, shown, kind = 0;
  const set = (name, value) => {
    gsplat.setParameter(name, value);
    app.renderNextFrame = true;
    again = 2;
  };
  // a light that depends on the eye, or a highlight: again when the camera has moved
  const camera = app.root.findComponent('camera').entity;
  let follows = false, eye = [0, 0, 0, 0];
  const eyeNow = () => {
    const flat = camera.camera.projection === PROJECTION_ORTHOGRAPHIC, { x, y, z } = flat ? camera.forward : camera.getPosition();
    return [x, y, z, Number(flat)];
  };
  app.on('update', () => {
    const now = eyeNow();
    if (!follows || Math.hypot(...now.map((x, k) => x - eye[k])) < 1e-4) return;
    eye = now;
    set('vvgtEye', eye);
  });
  // what is set while the engine takes up another state may be lost: set once more when it is ready
  app.on('update', () => { if (again) app.renderNextFrame = true; });
  app.systems.gsplat.on('frame:ready', (camera, layer, ready, loading) => {
    if (!again || !ready || loading) return;
    gsplat.setParameter('vvgtTable', table);
    gsplat.setParameter('vvgtLabels', labels);
    drawn(app, kind);
    app.renderNextFrame = true;
    if (!--again) shown();
  });
  function tabulate(k, nodes = look.nodes[k], sums = look.sums[k]) {
    table.lock().set(texelsOf(kind === 2 ? sumsOf(nodes, exposed(nodes, layers[k])) : sums, live.table), k * means * 2 * spreads * 4);
    table.unlock();
    set('vvgtTable', table);
  }
  const look = {
    live, layers, bytes, count, nodes: [], sums: [], rows: [], planes: [],  // what a place is found and read by
    // the function of a layer
    apply(nodes, k) {
      look.nodes[k] = nodes;
      look.sums[k] = sumsOf(nodes, layers[k]);
      tabulate(k);
    },
    // how it would look under other nodes; places are still read under its own
    sketch: (nodes, k) => tabulate(k, nodes, sumsOf(nodes, layers[k])),
    // one of `KINDS`, of one layer of values
    draw(number) {
      kind = number;
      tabulate(0);
      set('vvgtKind', kind);
    },
    // what each label of a layer looks like: [{rgb, opacity}], in the order of the file
    labels(list, k) {
      const texels = labels.lock(), { row, unit_distance } = layers[k];
      list.forEach(({ rgb, opacity }, j) => {
        look.rows[row + j] = { rgb, opacity };
        texels.set([...rgb, -Math.log1p(-Math.min(Math.max(opacity, 0), MOST_OPAQUE)) / unit_distance], 4 * (row + j));
      });
      labels.unlock();
      set('vvgtLabels', labels);
    },
    // at most six {normal, place}: dot(normal, x) <= place stays
    cut(planes) {
      const numbers = new Float32Array(24);
      planes.forEach(({ normal, place }, k) => numbers.set([...normal, place], 4 * k));
      look.planes = planes;
      set('vvgtCut[0]', numbers);
    },
  };
  // what frame k's Gaussians carry goes with them, before they are shown
  look.frame = async (k, to) => {
    look.bytes = await carry(k, to);
    look.count = look.bytes.length / planes;
    again = 2;
  };
  look.light = ({ kind, from, ambient, diffuse, specular, power }) => {
    follows = kind !== 'none' && (kind === 'headlight' || specular > 0);
    eye = eyeNow();
    gsplat.setParameter('vvgtEye', eye);
    gsplat.setParameter('vvgtToward', [...from, kind === 'headlight' ? 1 : 0]);
    set('vvgtLight', [kind === 'none' ? -1 : ambient, diffuse, specular, power]);
  };
  look.ready = () => new Promise((done) => { shown = done; });  // once what was set is drawn
  look.light(live.light);
  gsplat.setParameter('vvgtOpaque', [live.sharp, live.dilation, ...live.tail]);
  gsplat.setParameter('vvgtSpread', [live.widest, live.bend]);
  gsplat.setParameter('vvgtKind', kind);
  set('vvgtFacts', [first, last - first, live.thinnest, spreads]);
  look.cut([]);
  layers.forEach((layer, k) => {
    if (layer.labels.length) return look.labels(layer.labels, k);
    labels.lock().set([k, 0, 0, -1], 4 * layer.row);
    labels.unlock();
    look.apply(layer.nodes, k);
  });
  set('vvgtTable', table);
  set('vvgtLabels', labels);
  gsplat.setWorkBufferModifier({ glsl: modifier });
  await look.ready();
  return look;
}
