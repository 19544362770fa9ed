// lab.mjs JOB.json MODULES: a notebook in JupyterLab, its cells run one by one, in headless Chromium. JOB: {"browser", "url",
// "out": .png}; prints {"before": yaw of the page before the second cell}.
import fs from 'node:fs';
import path from 'node:path';
import { createRequire } from 'node:module';

const [jobFile, modules] = process.argv.slice(2);
const { chromium } = createRequire(path.join(modules, 'x.js'))('playwright-core');
const job = JSON.parse(fs.readFileSync(jobFile));
const args = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist', '--no-first-run'];
const browser = await chromium.launch({ executablePath: job.browser, args });
const page = await browser.newPage({ reducedMotion: 'reduce', viewport: { width: 1200, height: 900 } });
page.setDefaultTimeout(300000);
await page.goto(job.url);
await page.waitForFunction('window.jupyterapp?.shell.currentWidget?.sessionContext?.session?.kernel?.status === "idle"');
const run = (cell) => page.evaluate(async (index) => {
  const notebook = jupyterapp.shell.currentWidget;
  notebook.content.activeCellIndex = index;
  await jupyterapp.commands.execute('notebook:run-cell');
  const [error] = notebook.content.widgets[index].model.outputs.toJSON().filter(({ output_type: type }) => type === 'error');
  if (error) throw new Error(error.evalue);
}, cell);
await page.evaluate(() => {
  window.heard = [];
  addEventListener('message', ({ data }) => { if (data?.vvgt) window.heard.push(data); });
});
const heard = (what) => page.waitForFunction(`window.heard.some((said) => ${what})`);
await run(0);
await heard("said.vvgt === 'loaded'");
const frame = await (await page.$('iframe[title="Gaussian splats"]')).contentFrame();
const pose = () => frame.evaluate('window.vvgt.where.lens.pose().yaw');
await page.waitForTimeout(2000);  // "left", as Python asks
await frame.evaluate('window.vvgt.where.lens.set({ ...window.vvgt.where.lens.pose(), yaw: 33 })');
await heard("Math.abs(said.camera?.yaw - 33) < 0.1");
await page.waitForTimeout(1000);
const before = await pose();
await run(1);
await heard("said.cut?.at === 0.25 && said.camera.pitch === -90");
await page.waitForTimeout(1000);
await page.screenshot({ path: job.out });
await run(2);
console.log(JSON.stringify({ before }));
await browser.close();
