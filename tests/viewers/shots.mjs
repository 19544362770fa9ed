// shots.mjs JOBS.json MODULES: pictures of files as web viewers draw them, in headless Chromium.
// JOBS: {"browser": path, "jobs": [{"viewer": page, "file": path, "size": px, "options": query or nothing,
//   "cameras": [{"rotation", "translation", "fov": degrees} or null for (0, 0, 3) in the viewer's axes, y up], "out": [.png]}]}
import fs from 'node:fs';
import http from 'node:http';
import path from 'node:path';
import { createRequire } from 'node:module';
import { fileURLToPath } from 'node:url';

const [jobsFile, modules] = process.argv.slice(2);
const { chromium } = createRequire(path.join(modules, 'x.js'))('playwright-core');
const { browser: executablePath, jobs } = JSON.parse(fs.readFileSync(jobsFile));
const pages = path.dirname(fileURLToPath(import.meta.url));
const TYPES = {
  '.html': 'text/html', '.js': 'text/javascript', '.mjs': 'text/javascript', '.wasm': 'application/wasm', '.css': 'text/css',
};

// pages at /, packages at /node_modules/, the folders of the jobs' files at /file/<job>/, and nothing else
function located(url) {
  const file = /^\/file\/(\d+)(\/.+)$/.exec(url);
  const [root, rest] = file ? [path.dirname(jobs[Number(file[1])].file), file[2]]
    : url.startsWith('/node_modules/') ? [path.join(modules, 'node_modules'), url.slice(13)] : [pages, url];
  const found = path.join(root, path.normalize(rest));
  return found.startsWith(root) ? found : undefined;
}

const server = http.createServer((request, response) => {
  const found = located(decodeURIComponent(new URL(request.url, 'http://x').pathname));
  if (!found || !fs.existsSync(found) || !fs.statSync(found).isFile()) return response.writeHead(404).end();
  response.writeHead(200, { 'content-type': TYPES[path.extname(found)] ?? 'application/octet-stream' });
  return fs.createReadStream(found).pipe(response);
});
await new Promise((ready) => server.listen(0, '127.0.0.1', ready));

const args = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist',
  '--disable-background-networking', '--disable-component-update', '--disable-sync', '--no-first-run',
  '--force-color-profile=srgb'];
const browser = await chromium.launch({ executablePath, args });
for (const [index, job] of jobs.entries()) {
  const page = await browser.newPage({ viewport: { width: job.size, height: job.size }, deviceScaleFactor: 1 });
  page.setDefaultTimeout(300000);
  const broken = new Promise((_, fail) => {
    page.on('pageerror', (error) => fail(new Error(`${job.viewer}: ${error.message}`)));
  });
  page.on('console', (message) => { if (message.type() === 'error') console.error(`${job.viewer}: ${message.text()}`); });
  const query = `file=/file/${index}/${path.basename(job.file)}&size=${job.size}&${job.options ?? ''}`;
  await page.goto(`http://127.0.0.1:${server.address().port}/${job.viewer}.html?${query}`);
  await Promise.race([broken, page.waitForFunction('window.show !== undefined')]);
  for (const [view, camera] of job.cameras.entries()) {
    const url = await Promise.race([broken, page.evaluate((c) => window.show(c), camera)]);
    fs.writeFileSync(job.out[view], Buffer.from(url.split(',')[1], 'base64'));
  }
  await page.close();
}
await browser.close();
server.close();
