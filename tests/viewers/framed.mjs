// framed.mjs JOB.json MODULES: a page that holds the page of Gaussians in a frame, as notebooks do, in headless Chromium. JOB:
// {"browser", "url", "out": .png}; prints {"asked": [other URLs], "errors", "heard": what the page sends when a view and something wrong are asked for, "stored": whether the frame has a storage, "covered": buttons under something else, "saved": name of a file}.
import fs from 'node:fs';
import path from 'node:path';
import { createRequire } from 'node:module';

const [jobFile, modules] = process.argv.slice(2);
const { chromium } = createRequire(path.join(modules, 'x.js'))('playwright-core');
const job = JSON.parse(fs.readFileSync(jobFile));
const args = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist',
  '--disable-background-networking', '--disable-component-update', '--disable-sync', '--no-first-run', '--force-color-profile=srgb'];
const browser = await chromium.launch({ executablePath: job.browser, args });
const page = await browser.newPage({ reducedMotion: 'reduce', viewport: { width: 900, height: 540 }, deviceScaleFactor: 1, acceptDownloads: true });
page.setDefaultTimeout(600000);
const asked = [], errors = [];
await page.route((url) => /^(https?|wss?):/.test(url.href), (route) => {
  asked.push(route.request().url());
  return route.abort();
});
page.on('pageerror', (error) => errors.push(String(error)));
await page.goto(job.url);
const frame = page.frames()[1], end = Date.now() + 300000;
while (!await frame.evaluate('window.vvgt !== undefined')) {
  if (Date.now() > end) throw new Error(await frame.evaluate('document.getElementById("said").textContent'));
  await page.waitForTimeout(300);
}
await page.waitForTimeout(3000);
await page.evaluate(() => {
  window.heard = [];
  addEventListener('message', ({ data }) => window.heard.push(data));
  for (const what of [{ camera: 'left', cut: { kind: 'plane', normal: [0, 0, 2], at: 0.25 } }, { cut: { kind: 'plane', normal: [0, 0] } }, { light: { kind: 'sun' } }, { labels: 'skull' }, { cut: null }]) {
    document.querySelector('iframe').contentWindow.postMessage({ vvgt: 'set', ...what }, '*');
  }
});
await page.waitForFunction('window.heard.length > 4');
const heard = await page.evaluate(() => window.heard.map(({ vvgt, camera, cut, message }) => ({ vvgt, yaw: camera?.yaw, at: cut?.at, normal: cut?.normal, message })));
const stored = await frame.evaluate(() => { try { return Boolean(localStorage); } catch { return false; } });
const covered = await frame.evaluate(() => [...document.querySelectorAll('button')].filter((button) => {
  const { x, y, width, height } = button.getBoundingClientRect(), over = document.elementFromPoint(x + width / 2, y + height / 2);
  return width && over !== button && !button.contains(over);
}).map((button) => button.title));
const [file] = await Promise.all([page.waitForEvent('download'), frame.click('#live .save button:text-is("tf.json")')]);
await page.screenshot({ path: job.out });
console.log(JSON.stringify({ asked, errors, heard, stored, covered, saved: file.suggestedFilename() }));
await browser.close();
