// headset.mjs JOB.json MODULES: the page in an emulated Meta Quest 3 (iwer), in headless Chromium. JOB: {"browser", "url", "out": .png};
// prints {"asked": [other URLs], "offered": [kinds], "eyes": [{"viewport": [x, y, width, height] from below, "projection", "view": 16 numbers
// by column}] in the viewer's axes, "after": whether the page has its view back}.
import fs from 'node:fs';
import path from 'node:path';
import { createRequire } from 'node:module';

const [jobFile, modules] = process.argv.slice(2);
const require = createRequire(path.join(modules, 'x.js')), { chromium } = require('playwright-core');
const job = JSON.parse(fs.readFileSync(jobFile));
const args = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist',
  '--disable-background-networking', '--disable-component-update', '--disable-sync', '--no-first-run', '--force-color-profile=srgb'];
const browser = await chromium.launch({ executablePath: job.browser, args });
const page = await browser.newPage({ reducedMotion: 'reduce', viewport: { width: 800, height: 400 }, deviceScaleFactor: 1 });
page.setDefaultTimeout(600000);
const asked = [];
await page.route((url) => /^(https?|wss?):/.test(url.href), (route) => {
  asked.push(route.request().url());
  return route.abort();
});
page.on('pageerror', (error) => { throw error; });
await page.addInitScript({ path: path.join(modules, 'node_modules/iwer/build/iwer.min.js') });
await page.addInitScript(() => {
  const device = window.device = new IWER.XRDevice(IWER.metaQuest3);
  device.installRuntime({ forceInstall: true });
  device.stereoEnabled = true;
});
await page.goto(job.url);
await page.waitForFunction('window.vvgt !== undefined');
const pose = () => page.evaluate(() => { const { x, y, z } = vvgt.viewer.app.root.findComponent('camera').entity.getPosition(); return [x, y, z]; });
await page.waitForTimeout(3000);
await page.evaluate(() => { const { lens } = vvgt.where; lens.set({ ...lens.pose(), yaw: 150 }); });
await page.waitForTimeout(1000);
const before = await pose();
const offered = await page.evaluate(() => [...document.querySelectorAll('#tools .xr:not([hidden])')].map((button) => button.textContent));
await page.locator('#tools .xr', { hasText: 'VR' }).click();
await page.waitForFunction('vvgt.viewer.app.xr.active && vvgt.viewer.app.xr.views.list.length === 2');
await page.evaluate(() => device.position.set(0.01, 1.6, 0));  // a head is never still: Gaussians are sorted when it moves
await page.waitForTimeout(6000);
const eyes = await page.evaluate(() => vvgt.viewer.app.xr.views.list.map(({ viewport: { x, y, z, w }, projMat, viewOffMat }) => (
  { viewport: [x, y, z, w], projection: [...projMat.data], view: [...viewOffMat.data] })));
await page.screenshot({ path: job.out });
await page.evaluate('vvgt.viewer.app.xr.session.end()');
await page.waitForTimeout(3000);
const after = (await pose()).every((x, k) => Math.abs(x - before[k]) < 1e-3);
console.log(JSON.stringify({ asked, offered, eyes, after }));
await browser.close();
