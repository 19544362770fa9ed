// page.mjs JOB.json MODULES: a picture of the page of `vvgt view`, or of one in a file, in headless Chromium; nothing but its
// own address may be asked for. JOB: {"browser", "url", "size", "camera": {"position", "target", "up", "fov"} in the viewer's
// axes or null for where the page says that it begins, "frame": number to go to or null, "before": JavaScript to evaluate first, or
// none, "out": .png, "actions": [{"click" | "drag" | "fill" | "select" | "key": selector or key, "by": [px, px], "text"}] by mouse, touch and keys in a
// window of "window": [width, height], and "look": .png of all of it afterwards, or none}; prints {"asked": [other URLs], "errors": [of the console], "text": what
// the page says, "seconds": from opening to the first picture, "frames": how many the slider has}.
import fs from 'node:fs';
import path from 'node:path';
import { createRequire } from 'node:module';
import { fileURLToPath } from 'node:url';

const [jobFile, modules] = process.argv.slice(2);
const { chromium } = createRequire(path.join(modules, 'x.js'))('playwright-core');
const job = JSON.parse(fs.readFileSync(jobFile));
const args = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist',
  '--disable-background-networking', '--disable-component-update', '--disable-sync', '--no-first-run',
  '--force-color-profile=srgb', '--disable-gpu-watchdog'];
const browser = await chromium.launch({ executablePath: job.browser, args });
const [width, height] = job.window ?? [job.size, job.size];
const page = await browser.newPage({ reducedMotion: 'reduce', viewport: { width, height }, deviceScaleFactor: 1 });
page.setDefaultTimeout(600000);
const asked = [], errors = [], own = job.url.startsWith('file:') ? job.url : new URL(job.url).origin + '/';
await page.route((url) => /^(https?|wss?):/.test(url.href) && !url.href.startsWith(own), (route) => {
  asked.push(route.request().url());
  return route.abort();
});
const broken = new Promise((_, fail) => { page.on('pageerror', (error) => fail(error)); });
page.on('console', (message) => { if (message.type() === 'error') errors.push(message.text()); });
const begin = Date.now();
await page.goto(job.url);
const there = 'window.vvgt !== undefined || document.getElementById("said").textContent !== "loading"';
while (!await Promise.race([broken, page.evaluate(there)])) await new Promise((done) => setTimeout(done, 200));
if (!await page.evaluate('window.vvgt !== undefined')) {
  throw new Error(await page.evaluate('document.getElementById("said").textContent'));
}
const seconds = (Date.now() - begin) / 1000;
if (job.before) await Promise.race([broken, page.evaluate(job.before)]);
for (const { click, drag, fill, select, key, by, text } of job.actions ?? []) {
  if (click) await page.locator(click).click();
  if (fill) await page.locator(fill).fill(text);
  if (select) await page.locator(select).selectOption(text);
  if (key) await page.keyboard.press(key);
  if (!drag) continue;
  const box = await page.locator(drag).boundingBox(), x = box.x + box.width / 2, y = box.y + box.height / 2;
  await page.mouse.move(x, y);
  await page.mouse.down();
  await page.mouse.move(x + by[0] / 2, y + by[1] / 2);
  await page.mouse.move(x + by[0], y + by[1]);
  await page.mouse.up();
}
if (job.look) {
  await page.waitForTimeout(3000);
  await page.screenshot({ path: job.look });
}
if (job.window) await page.setViewportSize({ width: job.size, height: job.size });
await page.evaluate(() => {  // the picture fills the window, without the tabs of small ones
  document.body.style.setProperty('--tabs', '0px');
  dispatchEvent(new Event('resize'));
});
await page.waitForTimeout(500);
const shoot = async ({ camera, frame }) => {
  const { viewer, show } = window.vvgt, { app } = viewer, canvas = app.graphicsDevice.canvas;
  const entity = app.root.findComponent('camera').entity;
  let ready = true, shift = 0;
  app.systems.gsplat.on('frame:ready', (c, layer, isReady, loading) => { ready = isReady && loading === 0; });
  const { position, target, up, fov } =
    camera ?? { ...JSON.parse(document.getElementById('scene').textContent).camera, up: [0, 1, 0] };
  const { lens } = window.vvgt.where ?? {}, away = position.map((x, k) => x - target[k]), distance = Math.hypot(...away);
  lens?.set({ ...lens.pose(), target, distance });  // a light at the eye is where the page's own camera is
  if (lens) lens.set({ ...lens.pose(), ...lens.toward(away.map((x) => x / distance), up) });
  app.on('update', () => {  // after the viewer's own, which may still be on its way
    entity.setPosition(...position);
    entity.lookAt(...target, ...up);
    entity.camera.fov = fov;
    entity.camera.projectionOffset = { x: 0, y: 0 };
    entity.translateLocal(shift, 0, 0);
  });
  const { look } = window.vvgt.live ?? {};
  if (look?.wanted && !look.said) {  // the volume itself, in a canvas of its own
    lens.middle = [canvas.clientWidth / 2, canvas.clientHeight / 2];
    for (let still = 0; still < 3; still = look.rested ? still + 1 : 0) await new Promise((done) => setTimeout(done, 300));
    if (look.said) throw new Error(look.said);
    return look.canvas.toDataURL('image/png');
  }
  if (frame !== null) await show(frame);
  document.querySelectorAll('#series, #live').forEach((element) => { element.style.display = 'none'; });
  return settled((by) => { shift = by; }, () => new Promise((done) => {
    app.renderNextFrame = true;
    app.once('frameend', () => done(canvas.toDataURL('image/png')));
  }), () => ready);
};
// as the debugger's expression: the page's own policy lets no foreign script in
const settled = fs.readFileSync(path.join(path.dirname(fileURLToPath(import.meta.url)), 'settled.mjs'), 'utf8');
const expression = `${settled.replaceAll('export ', '')}; (${shoot})(${JSON.stringify(job)})`;
const url = await Promise.race([broken, page.evaluate(expression)]);
fs.writeFileSync(job.out, Buffer.from(url.split(',')[1], 'base64'));
const text = await page.evaluate(() => document.getElementById('said').textContent);
const frames = await page.evaluate(() => Number(document.querySelector('#series input')?.max ?? 0) + 1);
console.log(JSON.stringify({ asked, errors, text, seconds, frames }));
await browser.close();
