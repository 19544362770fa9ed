// where.mjs JOB MODULES: pages in headless Chromium, used as a person uses them. JOB: JSON {"browser", "size": [w, h], "touch", "motion": whether pages may turn of themselves, "args"}.
// Reads steps [what, ...], a JSON list a line, and answers each with a line {"answer", "asked", "broken"} or {"error"}.
// Steps: open URL; served URL (of vvgt view); refused URL (what a page says that cannot be shown); press KEY; click SELECTOR, or X Y; hover X Y; calm (less motion is asked for); wheel DY; drag X Y X Y; resize W H; eval JS; until JS; settled (until two pictures are the same); shot FILE
// (the page), bare FILE (without what lies over the picture); axe (findings of axe-core); tabs (what Tab misses, and where focus is not seen); save SELECTOR FILE (what a click downloads);
// frame URL (a page that shows one in a frame), within JS (in that frame); framed URL STEPS (eval, click and until in the frame of a site; their answers).
import fs from 'node:fs';
import path from 'node:path';
import readline from 'node:readline';
import { createRequire } from 'node:module';

const [text, modules] = process.argv.slice(2), job = JSON.parse(text);
const { chromium } = createRequire(path.join(modules, 'x.js'))('playwright-core');
const args = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist', '--force-color-profile=srgb', ...(job.args ?? [])];
const browser = await chromium.launch({ executablePath: job.browser, args });
const [width, height] = job.size;
const context = await browser.newContext({ viewport: { width, height }, deviceScaleFactor: 1, hasTouch: job.touch, isMobile: job.touch, reducedMotion: job.motion ? 'no-preference' : 'reduce' });
const page = await context.newPage();
page.setDefaultTimeout(300000);
const asked = [], broken = [];
let own = null;  // address of the server whose page is shown
await page.route((url) => /^(https?|wss?):/.test(url.href) && url.origin !== own, (route) => { asked.push(route.request().url()); return route.abort(); });
page.on('pageerror', (error) => broken.push(String(error)));
page.on('console', (line) => { if (line.type() === 'error' && !line.text().includes('in a sandboxed frame')) broken.push(line.text()); });

async function open(url) {
  if (page.url() !== 'about:blank') await page.goto('about:blank');
  await page.goto(url);
  while (!await page.evaluate('window.vvgt !== undefined')) await page.waitForTimeout(100);  // no function: a served page's policy forbids it
  if (!job.motion) await settled();
}

async function settled() {
  let before = null;
  const frame = 'new Promise((done) => { const { app } = window.vvgt.viewer; app.renderNextFrame = true; app.once("frameend", done); })';
  for (let n = 0; n < 60; n++) {
    for (let k = 0; k < 3; k++) await page.evaluate(frame);
    await page.waitForTimeout(50);
    const now = (await page.screenshot()).toString('base64');
    if (now === before) return;
    before = now;
  }
  throw new Error('the picture does not come to rest');
}

const HIDE = '#cut, #tabs, #tools, [data-tab]:not([data-tab=""]) :is(#slices, #marks), #live, #named, #series, #where, #places, .listed { opacity: 0 !important; transition: none !important }';
const steps = {
  open, settled,
  served: (url) => { own = new URL(url).origin; return open(url); },
  refused: async (url) => {
    await page.goto(url);
    await page.waitForFunction(() => !['', 'loading'].includes(document.getElementById('said').textContent) || window.vvgt);
    const engine = broken.findIndex((line) => line.startsWith('Failed to load resource')); // the viewer's own report of damaged data
    if (engine >= 0) broken.splice(engine, 1);
    return page.locator('#said').textContent();
  },
  press: (key) => page.keyboard.press(key),
  click: (...at) => {
    if (at.length === 1) return job.touch ? page.tap(at[0]) : page.click(at[0]);
    return job.touch ? page.touchscreen.tap(...at) : page.mouse.click(...at);
  },
  calm: () => page.emulateMedia({ reducedMotion: 'reduce' }),
  hover: (x, y) => page.mouse.move(x, y),
  wheel: (by) => page.mouse.wheel(0, by),
  drag: async (x, y, toX, toY) => {
    if (job.touch) {
      const fingers = await context.newCDPSession(page), at = (k) => [{ x: x + (k / 8) * (toX - x), y: y + (k / 8) * (toY - y) }];
      await fingers.send('Input.dispatchTouchEvent', { type: 'touchStart', touchPoints: at(0) });
      for (let k = 1; k <= 8; k++) await fingers.send('Input.dispatchTouchEvent', { type: 'touchMove', touchPoints: at(k) });
      await fingers.send('Input.dispatchTouchEvent', { type: 'touchEnd', touchPoints: [] });
      return;
    }
    await page.mouse.move(x, y);
    await page.mouse.down();
    await page.mouse.move(toX, toY, { steps: 8 });
    await page.mouse.up();
  },
  resize: (width, height) => page.setViewportSize({ width, height }),
  eval: (text) => page.evaluate(text),
  frame: async (url) => {
    await page.goto(url);
    await page.frames()[1].waitForFunction('window.vvgt !== undefined');
  },
  within: (text) => page.frames()[1].evaluate(text),
  until: async (text) => { await page.waitForFunction(text); },
  shot: async (file) => { await page.screenshot({ path: file }); },
  bare: async (file) => {
    await page.evaluate((text) => {  // no element, which a served page's policy forbids
      const style = new CSSStyleSheet();
      style.replaceSync(text);
      document.adoptedStyleSheets = [style];
    }, HIDE);
    await page.screenshot({ path: file });
    await page.evaluate(() => { document.adoptedStyleSheets = []; });
  },
  axe: async () => {
    await page.evaluate(fs.readFileSync(path.join(modules, 'node_modules', 'axe-core', 'axe.min.js'), 'utf8'));
    const { violations } = await page.evaluate('axe.run()');
    return violations.flatMap(({ id, nodes }) => nodes.map(({ target, failureSummary }) => `${id}: ${target}: ${failureSummary}`));
  },
  tabs: async () => {
    await page.evaluate(() => {
      const focusable = [...document.querySelectorAll('a[href], button, input, select, summary, [tabindex="0"]')];
      window.missed = new Set(focusable.filter((e) => e.checkVisibility({ visibilityProperty: true }) && !e.disabled));
      document.body.tabIndex = -1;  // begin at the first, wherever the focus was
      document.body.focus();
      document.body.removeAttribute('tabindex');
    });
    const unseen = [];
    for (let n = 0; n < 300; n++) {
      await page.keyboard.press('Tab');
      const found = await page.evaluate(() => {
        const now = document.activeElement, { outlineStyle, boxShadow } = getComputedStyle(now), name = now.getAttribute('aria-label') ?? now.title ?? now.tagName;
        const marked = [...now.querySelectorAll('circle')].some((circle) => getComputedStyle(circle).stroke === 'rgb(68, 170, 255)');
        if (now === document.body || !window.missed.has(now)) return null;  // all round
        window.missed.delete(now);
        return { name, seen: now.matches(':focus-visible') && (outlineStyle !== 'none' || boxShadow !== 'none' || marked) };
      });
      if (!found) break;
      if (!found.seen) unseen.push(found.name);
    }
    return { unseen, missed: await page.evaluate(() => [...window.missed].map((e) => `${e.tagName} ${e.getAttribute('aria-label') ?? e.title}`)) };
  },
  framed: async (url, what) => {
    await page.goto(url);
    const frame = page.frames()[1], answers = [];
    await frame.waitForFunction('window.vvgt !== undefined');
    const within = { eval: (text) => frame.evaluate(text), click: (selector) => (job.touch ? frame.tap(selector) : frame.click(selector)), until: async (text) => { await frame.waitForFunction(text); } };
    for (const [name, ...rest] of what) answers.push((await within[name](...rest)) ?? null);
    broken.splice(0, Infinity, ...broken.filter((line) => !/^(Download is disallowed|Permissions policy violation)/.test(line)));
    await page.goto('about:blank');
    return answers;
  },
  save: async (selector, file) => {
    const [download] = await Promise.all([page.waitForEvent('download'), steps.click(selector)]);
    await download.saveAs(file);
    return download.suggestedFilename();
  },
};
for await (const line of readline.createInterface({ input: process.stdin })) {
  const [what, ...rest] = JSON.parse(line);
  try {
    console.log(JSON.stringify({ answer: (await steps[what](...rest)) ?? null, asked, broken }));
  } catch (error) {
    console.log(JSON.stringify({ error: String(error.stack) }));
  }
}
await browser.close();
