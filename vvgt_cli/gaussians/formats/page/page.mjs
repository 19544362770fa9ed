// The page of `vvgt view` and of `-o out.html`: SuperSplat's viewer, its camera where `vvgt render --orbit` begins, and a
// slider and a list where there are several frames, functions or labels. Splats are drawn by the file's rule (docs/viewers.md). `make page` bundles it with its packages to viewer.js.gz.
import { createViewer } from '@playcanvas/supersplat-viewer/viewer';
import { Asset, GSPLAT_BUDGET_LIMIT, SHADERLANGUAGE_GLSL, ShaderChunks } from 'playcanvas';
import { Damaged, unlessFailing, wholePly } from './damage.mjs';
import { panel, named } from './panel.mjs';
import { patched } from './patch.mjs';
import { raycaster } from './raycast.mjs';
import { served, waiting } from './server.mjs';
import { framedGrids, sharedGrids } from './volume.mjs';
import { where } from './where.mjs';

const KEPT = 16;  // frames of a series that stay in memory
const PAUSE = 200;  // milliseconds from one frame of a series to the next
const said = document.getElementById('said');
const scene = JSON.parse(document.getElementById('scene').textContent);
const off = { enabled: false };
const settings = {
  version: 2, tonemapping: 'none', background: { color: [0, 0, 0] },
  highPrecisionRendering: true,  // 16 bits a channel: nothing is rounded at every splat
  postEffectSettings: {
    sharpness: { ...off, amount: 0 }, bloom: { ...off, intensity: 0.1, blurLevel: 2 },
    grading: { ...off, brightness: 1, contrast: 1, saturation: 1, tint: [1, 1, 1] },
    vignette: { ...off, intensity: 0.5, inner: 0.3, outer: 0.75, curvature: 1 }, fringing: { ...off, intensity: 0.5 },
  },
  animTracks: [], annotations: [], startMode: 'default', cameras: [{ initial: scene.camera }],
};

// what the file itself holds (base64), or the server's answer
function content({ file, element, whole }) {
  if (!element) return fetch(file);
  const own = bytesOf(element), bytes = whole === undefined ? own : patched(bytesOf(scene.frames[whole].element), own);
  if (!wholePly(bytes)) throw new Damaged('its Gaussians are incomplete');
  if (scene.frames.length === 1) document.getElementById(element).remove();  // of several, one that left memory is read again
  return Promise.resolve(new Response(bytes));
}

function bytesOf(element) {
  const text = atob(document.getElementById(element).textContent), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

// The engine's shaders count in half pixels: their 0.3 is 0.075 px^2. Splats are drawn after this and the first content.
function draw(app, { dilation, shifted, reach }) {
  const chunks = ShaderChunks.get(app.graphicsDevice, SHADERLANGUAGE_GLSL);
  const change = (name, old, now) => {
    const text = chunks.get(name);
    if (!text.includes(old)) throw new Error(`${name} of the engine is another one`);
    chunks.set(name, text.replaceAll(old, now));
  };
  change('gsplatCornerVS', '+ 0.3', `+ ${(4 * dilation).toFixed(6)}`);
  if (reach < 4) change('gsplatPS', 'A > 1.0', `A > ${(reach / 4).toFixed(6)}`);
  if (!shifted) change('gsplatPS', '(exp(x * -4.0) - EXP4) * INV_EXP4', 'exp(x * -4.0)');
}

function series(viewer, changed) {
  const { app } = viewer, entity = app.root.findByName('gsplat');
  const assets = new Map([[0, Promise.resolve(app.assets.get(entity.gsplat.asset))]]);  // by frame, the last used last
  const box = Object.assign(document.createElement('section'), { id: 'series' });
  box.setAttribute('aria-label', 'frames');
  box.innerHTML = '<button aria-label="play" title="play">▶</button><input type="range" min="0" value="0" aria-label="frame"><select aria-label="choose a frame"></select>';
  const [button, slider, list] = box.children;
  slider.max = scene.frames.length - 1;
  list.append(...scene.frames.map((frame) => new Option(frame.name)));
  document.body.append(box);
  let wanted = 0, playing = false;

  function loaded(k) {
    if (!assets.has(k)) {
      const { file, element } = scene.frames[k], contents = element && content(scene.frames[k]);
      assets.set(k, new Promise((done, fail) => {
        const asset = new Asset(file, 'gsplat', { url: file, filename: file, contents });
        asset.once('load', () => done(asset));
        asset.once('error', fail);
        app.assets.add(asset);
        app.assets.load(asset);
      }));
    }
    const asset = assets.get(k);
    assets.delete(k);
    assets.set(k, asset);
    return asset;
  }

  // one frame after the other, whatever is asked for meanwhile; the promise is of the one asked for last
  let shown = 0, busy = null;
  function show(k) {
    wanted = k;
    slider.value = list.selectedIndex = k;
    busy ??= turn().finally(() => { busy = null; });
    return busy;
  }

  async function turn() {
    while (shown !== wanted) {
      const k = wanted;
      try {
        const asset = await loaded(k);
        if (wanted !== k) continue;
        entity.gsplat.asset = asset.id;
        app.renderNextFrame = true;
        said.textContent = '';
        shown = k;
        changed();
      } catch (error) {
        assets.delete(k);
        said.textContent = `${scene.frames[k].name} could not be loaded: ${error}`;
        shown = -1;  // asked for again, it is tried again
        if (wanted === k) return;
      }
      while (assets.size > KEPT) {
        const [old, gone] = assets.entries().next().value;
        assets.delete(old);
        gone.then((asset) => { app.assets.remove(asset); asset.unload(); }, () => {});
      }
    }
  }

  async function play() {
    while (playing) {
      const next = (wanted + 1) % scene.frames.length, begin = performance.now();
      await loaded(next).catch(() => {});
      await new Promise((done) => setTimeout(done, Math.max(0, PAUSE - (performance.now() - begin))));
      if (playing) await show(next);
    }
  }

  slider.addEventListener('input', () => show(Number(slider.value)));
  list.addEventListener('input', () => show(list.selectedIndex));
  button.addEventListener('click', () => {
    playing = !playing;
    button.textContent = playing ? '❚❚' : '▶';
    button.title = playing ? 'pause' : 'play';
    button.setAttribute('aria-label', button.title);
    if (playing) play();
  });
  return show;
}

async function start() {
  if (!document.createElement('canvas').getContext('webgl2')) throw new Error('WebGL 2 is missing or turned off');
  if (scene.waits) return waiting(said);
  document.body.classList.toggle('begins', !scene.streamed);  // what is shown before its place is known
  const { file } = scene.frames[0];
  const response = scene.streamed ? null : await content(scene.frames[0]);  // what is streamed the engine fetches itself
  if (response && !response.ok) throw new Error(`${scene.frames[0].name} could not be loaded`);
  let deliver;
  const viewer = await createViewer({
    container: document.getElementById('view'), contentUrl: file, contentFilename: file, settings, ui: false,
    contents: response ? new Promise((done) => { deliver = done; }) : undefined, aa: scene.rule.compensate,
    noanim: true,
    renderer: 'webgl',  // the one whose pictures are measured; WebGPU leaves more splats out
  });
  draw(viewer.app, scene.rule);
  viewer.app.scene.gsplat.alphaClipForward = Math.max(scene.rule.minAlpha, 1e-6);  // the shader divides by it
  viewer.app.scene.gsplat.minPixelSize = Math.sqrt(32 * scene.rule.minVariance);
  if (scene.streamed) viewer.app.scene.gsplat.splatBudgetMode = GSPLAT_BUDGET_LIMIT;  // levels by distance, not as many as fit
  deliver?.(response);
  if (!viewer.state.loaded) await unlessFailing(viewer.app, new Promise((done) => viewer.events.once('loaded:changed', done)));
  Object.assign(viewer.state, { cameraMode: 'orbit', inputEnabled: false });  // the viewer would turn the object; keys are ours
  if (!scene.look) document.body.append(named());
  const frame = () => Math.max(document.querySelector('#series select')?.selectedIndex ?? 0, 0);
  const grids = scene.framed ? framedGrids(scene.framed, frame) : scene.values ? sharedGrids(scene.values) : null, live = scene.look ? panel(raycaster(scene.look, grids, viewer), viewer, scene.look) : null;
  if (live) served(live, viewer, scene.server);
  const show = scene.frames.length > 1 ? series(viewer, () => live?.look.renew()) : null, here = where(viewer, scene, live, show, scene.framed ? null : grids);
  const linked = await here.restored;
  document.body.classList.remove('begins');
  said.textContent = '';
  window.vvgt = { viewer, live, show, where: here };
  here.site.loaded();
  if (!linked && !scene.story?.length && scene.outermost.length) here.turn();
}

start().catch((error) => {
  const text = error.message ?? String(error);
  said.textContent = error instanceof Damaged ? `This page is damaged: ${text}. Download it again.` : `This browser cannot show the 3D view: ${text}.`;
  document.getElementById('view').hidden = true;
  if (parent !== window) parent.postMessage({ vvgt: 'error', message: said.textContent }, '*');
});
