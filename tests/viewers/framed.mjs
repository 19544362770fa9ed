// framed.mjs JOB.json MODULES: a page that holds the page of Gaussians in a frame, as notebooks do, in headless Chromium. JOB:
// {"browser", "url", "out": .png}; prints {"asked": [other URLs], "errors", "kind": what the frame shows, "saved": name of a file}.
import fs from 'node:fs';
import path from 'node:path';
import { createRequire } from 'node:module';

const [jobFile, modules] = process.argv.slice(2);
const { chromium } = createRequire(path.join(modules, 'x.js'))('playwright-core');
const job = JSON.parse(fs.readFileSync(jobFile));
const args = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist',
  '--disable-background-networking', '--disable-component-update', '--disable-sync', '--no-first-run', '--force-color-profile=srgb'];
const browser = await chromium.launch({ executablePath: job.browser, args });
const page = await browser.newPage({ viewport: { width: 900, height: 540 }, deviceScaleFactor: 1, acceptDownloads: true });
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
const kind = await frame.evaluate(() => document.querySelector('#live .named i').textContent);
const [file] = await Promise.all([page.waitForEvent('download'), frame.click('#live .save button:text-is("tf.json")')]);
await page.screenshot({ path: job.out });
console.log(JSON.stringify({ asked, errors, kind, saved: file.suggestedFilename() }));
await browser.close();
