// served.mjs JOB.json MODULES: the page of `vvgt view VOLUME` in headless Chromium, by mouse: it waits, shows the volume, a node is
// dragged, the better form comes, another change goes back, files are saved. JOB: {"browser", "url", "size": [w, h], "folder", "camera"};
// pictures live.png and better.png (square, of that camera) and what is saved go to the folder; prints what the page
// said: {"began", "dragging", "live", "better", "cut", "uncut", "lit", "changed", "moved", "saved", "refused"}.
import fs from 'node:fs';
import path from 'node:path';
import { createRequire } from 'node:module';
import { fileURLToPath } from 'node:url';

const [jobFile, modules] = process.argv.slice(2);
const { chromium } = createRequire(path.join(modules, 'x.js'))('playwright-core');
const job = JSON.parse(fs.readFileSync(jobFile)), [width, height] = job.size;
const args = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist',
  '--disable-background-networking', '--disable-component-update', '--disable-sync', '--no-first-run', '--force-color-profile=srgb'];
const browser = await chromium.launch({ executablePath: job.browser, args });
const page = await browser.newPage({ reducedMotion: 'reduce', viewport: { width, height }, deviceScaleFactor: 1, acceptDownloads: true });
page.setDefaultTimeout(600000);
page.on('pageerror', (error) => { console.error(error); process.exit(1); });
const settled = fs.readFileSync(path.join(path.dirname(fileURLToPath(import.meta.url)), 'settled.mjs'), 'utf8').replaceAll('export ', '');
const until = async (expression) => {
  while (!await page.evaluate(expression).catch(() => false)) await page.waitForTimeout(100);  // the page loads itself anew
};
const shown = () => page.evaluate(() => document.querySelector('#live .named i').textContent);
const place = () => page.evaluate(() => {
  const { x, y, z } = window.vvgt.viewer.app.root.findComponent('camera').entity.getPosition();
  return [x, y, z];
});
const grasp = async (k) => {
  const box = await page.evaluate((n) => {
    const { x, y, width: w, height: h } = document.querySelectorAll('#live .node')[n].getBoundingClientRect();
    return [x + w / 2, y + h / 2];
  }, k);
  await page.mouse.move(...box);
  await page.mouse.down();
  return box;
};
const shoot = async (name) => {
  const take = async (seen) => {
    const { viewer, where: { lens } } = window.vvgt, { app } = viewer, canvas = app.graphicsDevice.canvas;
    const { clientWidth: w, clientHeight: h } = canvas, back = Math.max(w, h) / Math.min(w, h);
    const camera = app.root.findComponent('camera').entity, { position, target } = seen;
    const away = position.map((x, i) => x - target[i]), distance = Math.hypot(...away);
    let ready = true, shift = 0;
    app.systems.gsplat.on('frame:ready', (c, layer, isReady, loading) => { ready = isReady && loading === 0; });
    lens.set({ target, distance: back * distance, ...lens.toward(away.map((x) => x / distance), [0, 1, 0]) });
    lens.middle = [w / 2, h / 2];
    const put = () => camera.translateLocal(shift, 0, 0);
    app.on('update', put);
    const { look } = window.vvgt.live;
    if (look.wanted) {  // the volume itself, in a canvas of its own
      for (let still = 0; still < 3; still = look.rested ? still + 1 : 0) await new Promise((done) => setTimeout(done, 300));
      app.off('update', put);
      return look.canvas.toDataURL('image/png');
    }
    const url = await settled((by) => { shift = by; }, () => new Promise((done) => {
      app.renderNextFrame = true;
      app.once('frameend', () => done(canvas.toDataURL('image/png')));
    }), () => ready);
    app.off('update', put);
    return url;
  };
  const url = await page.evaluate(`${settled}; (${take})(${JSON.stringify(job.camera)})`);
  fs.writeFileSync(path.join(job.folder, name), Buffer.from(url.split(',')[1], 'base64'));
};
const save = async (label) => {
  const [file] = await Promise.all([page.waitForEvent('download'), page.click(`#live .save button:text-is("${label}")`)]);
  await file.saveAs(path.join(job.folder, file.suggestedFilename()));
  return file.suggestedFilename();
};

const noted = {};
await page.goto(job.url);
await until('window.vvgt !== undefined');
await page.evaluate('window.vvgt.where.slices.toggle()');
noted.slices = await page.evaluate('window.vvgt.where.slices.state.base.dims');
await page.evaluate('window.vvgt.where.slices.toggle()');
noted.began = await shown();
const tab = async (k) => { if (await page.isVisible('#tabs')) await page.click(`#tabs button:nth-child(${k})`); };
await tab(1);
const low = height * (await page.isVisible('#tabs') ? 0.3 : 0.75);
await page.mouse.move(width / 2, low);  // turn the camera
await page.mouse.down();
await page.mouse.move(width / 2 + 60, low + 10, { steps: 3 });
await page.mouse.up();
for (let last, now = await place(); String(last) !== String(now); [last, now] = [now, await place()]) await page.waitForTimeout(2000);  // it glides
const before = await place(), [x, y] = await grasp(1);
await page.mouse.move(x + 12, y - 20, { steps: 4 });
noted.dragging = await shown();
await page.waitForTimeout(1000);
noted.asked = await page.evaluate(() => document.querySelector('#live p').textContent);  // nothing: it is still held
await page.mouse.up();
await until('document.querySelector("#live p").textContent.startsWith("converting")');
noted.live = await shown();
await page.screenshot({ path: path.join(job.folder, 'page-live.png') });
await until('document.querySelector("#live .named i").textContent.startsWith("converted, ")');
await page.waitForTimeout(2000);
noted.better = await shown();
noted.moved = (await place()).map((v, i) => Math.abs(v - before[i]));
await page.screenshot({ path: path.join(job.folder, 'page-better.png') });
await shoot('better.png');
await page.evaluate((note) => window.vvgt.where.marks.part.set(JSON.stringify([['note', [[0, 0, 0]], note]])), job.note);
noted.saved = [await save('.ply'), await save('.html'), await save('tf.json')];
await tab(2);
await page.selectOption('#live .axis', { index: 1 });
noted.cut = await shown();
await page.selectOption('#live .axis', { index: 0 });
noted.uncut = await shown();
await tab(1);
await page.evaluate(() => document.querySelector('#live .light').closest('details').setAttribute('open', ''));
await page.selectOption('#live .light select', 'headlight');
noted.lit = [await shown()];
await until('document.querySelector("#live .named i").textContent.startsWith("converted, ")');
noted.lit.push(await shown());
await page.keyboard.press('Control+z');
await page.evaluate(() => {  // the same function, of the volume itself
  const post = window.fetch;
  window.fetch = (to, how) => (to === 'function' ? Promise.reject(new Error('not now')) : post(to, how));
  window.vvgt.live.set(window.vvgt.live.nodes());
});
noted.changed = await shown();
await shoot('live.png');
noted.refused = await page.evaluate(() => document.querySelector('#live p').textContent);
console.log(JSON.stringify(noted));
await browser.close();
