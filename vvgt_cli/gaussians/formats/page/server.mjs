// The look of a page: under its own the Gaussians are shown, under others the volume itself; a server converts it for these meanwhile. Files to save.
import { Asset, Entity } from 'playcanvas';
import { save as download } from './saved.mjs';

const QUIET = 300, ASK = 300;  // milliseconds without a change after which the server is asked; between two looks
const NAMES = { ply: 'the Gaussians', html: 'a page', json: 'the transfer function' };
const pause = (ms) => new Promise((done) => setTimeout(done, ms));

// A page whose Gaussians are being made: what the server says until they are there.
export async function waiting(said) {
  for (;;) {
    let now;
    try {
      now = await (await fetch('state')).json();
    } catch {
      if (said.textContent === 'loading' || !said.dataset.failed) said.textContent = 'vvgt view has stopped';
      return;
    }
    if (now.state !== 'first' && now.state !== 'failed') return location.reload();
    said.textContent = now.said;
    if (now.state === 'failed') said.dataset.failed = true;
    await pause(ASK);
  }
}

// nodes {x, y, rgb} as a file of a function; the ends of the range are nodes, so that no program stretches it
export function functionFile(nodes, { values: [lo, hi], opacity_unit_distance, name }) {
  const all = [...nodes];
  if (all[0].x > lo) all.unshift({ ...all[0], x: lo });
  if (all.at(-1).x < hi) all.push({ ...all.at(-1), x: hi });
  const points = all.map(({ x, y, rgb }) => ({ x, rgb: rgb.map((c) => Number(c.toFixed(4))), opacity: Number(y.toPrecision(6)) }));
  return { name: name || 'transfer function', points, opacity_unit_distance };
}

// labels as a table that --labels reads
const labelsFile = (rows) => Object.fromEntries(rows.map(({ number, ...rest }) => [number, rest]));

const send = (to, what) => fetch(to, { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(what) });
const reason = async (answer) => (answer.status === 400 ? answer.text() : `the server answered ${answer.status}`);

// The Gaussians: the page's own, and what the server has made since in their place.
function gaussiansOf({ app }) {
  const first = app.root.findByName('gsplat');
  let entity = null, seen = true;
  function put(now = seen) {
    seen = now;
    if (entity) entity.enabled = seen;
    first.enabled = seen && !entity;
    app.renderNextFrame = true;
  }
  async function load(file, still) {
    const asset = new Asset(file, 'gsplat', { url: file, filename: file });
    await new Promise((done, fail) => {
      asset.once('load', done);
      asset.once('error', fail);
      app.assets.add(asset);
      app.assets.load(asset);
    });
    const old = still() ? entity && [entity, app.assets.get(entity.gsplat.asset)] : [null, asset];
    if (still()) {
      entity = new Entity('better', app);
      entity.addComponent('gsplat', { asset: asset.id, unified: true });
      entity.setLocalRotation(first.getLocalRotation());
      first.parent.addChild(entity);
    }
    old?.[0]?.destroy();
    if (old) { app.assets.remove(old[1]); old[1].unload(); }
    put();
  }
  return { load, put };
}

// panel: {root, look, layers, at(): the chosen one of them, changed(f), alone(): a cut, MIP or X-ray, which the volume itself has alone; lit(): another light than the file's, or null}; server: {converts, name}, none of a page in a file.
// The Gaussians are shown under the look that they were made for, else the volume itself.
export function served(panel, viewer, server) {
  const { root, look: volume, layers } = panel, kind = root.querySelector('.named i'), name = server?.name ?? document.title;
  const row = document.createElement('div'), text = document.createElement('p');
  row.className = 'save';
  row.textContent = 'Save';
  [kind, text].forEach((one) => one.setAttribute('role', 'status'));
  root.append(text, row);
  const better = gaussiansOf(viewer);
  const look = ({ named, rows, nodes }) => (rows ? { labels: rows().map(({ number, color, opacity }) => ({ number, color, opacity })) } : { function: functionFile(nodes(), named()) });
  const shown = () => (layers.length > 1 ? { layers: layers.map(look) } : look(layers[0]));
  let number = server ? null : 0, told = server ? '' : 'Gaussians', busy = false, unable = '', down = false, timer = 0, change = 0;  // number of the better form, and what it is

  const say = (line, failed) => {
    text.textContent = line;
    text.className = failed ? 'failed' : '';
  };

  const begun = JSON.stringify(shown());
  const able = () => server?.converts || (!panel.lit() && JSON.stringify(shown()) === begun);  // there can be Gaussians under this look
  const improved = () => Boolean(volume.said) || (number !== null && !panel.alone() && able());
  function put() {
    volume.show(!improved());
    const [what, why = ''] = (improved() ? told : 'volume').split(/: (.*)/s);
    root.dataset.shows = what;
    if (server) kind.textContent = what;  // on a reader's screen (i) says it
    if (!busy) say(why || volume.said);
  }
  panel.covering = (now) => {
    better.put(!now);
    if (volume.said === unable) return;
    unable = volume.said;
    put();
  };

  function end(line = '', failed = false) {
    busy = false;
    say(line, failed);
  }

  async function convert() {
    const mine = change;
    busy = true;
    try {
      const answer = await send('function', { ...(shown().function ?? shown()), light: panel.lit() });
      if (!answer.ok) throw new Error(await reason(answer));
      const job = (await answer.json()).number;
      while (mine === change) {
        const state = await (await fetch('state')).json();
        if (mine !== change) return;
        if (state.number !== job) break;  // of another page
        if (state.state === 'failed') throw new Error(state.said);
        if (state.state === 'done') {
          if (number !== job) await better.load(state.file, () => mine === change);
          if (mine !== change) return;
          if (number !== job || told !== state.said) {
            [number, told, busy] = [job, state.said, false];
            put();
          }
          if (state.scored) return;
        } else say(`converting under this look: ${state.said}`);
        await pause(ASK);
      }
      if (mine === change && busy) end();
    } catch (error) {
      if (mine === change) end(error instanceof TypeError ? 'vvgt view has stopped' : error.message, true);
    }
  }

  function changed(cut) {
    if (cut) return put();
    if (busy) send('function', null).catch(() => {});  // what is being done ends
    change++;
    [number, busy] = [null, false];
    put();
    clearTimeout(timer);
    timer = setTimeout(ready, QUIET);
  }

  function ready() {
    clearTimeout(timer);
    if (down) timer = setTimeout(ready, QUIET);
    else if (able()) convert();
  }

  async function save(file) {
    if (file === 'json') {
      const { named, rows, nodes } = panel.at(), content = rows ? labelsFile(rows()) : functionFile(nodes(), named());
      return download(new Blob([`${JSON.stringify(content, null, 1)}\n`], { type: 'application/json' }), rows ? 'labels.json' : 'tf.json');
    }
    try {
      const answer = await send('save', { file, number, ...shown(), light: panel.lit() });
      if (!answer.ok) throw new Error(await reason(answer));
      const link = file === 'html' && panel.begins?.(), at = (start) => `${start}"link": ${JSON.stringify(link).replaceAll('<', '\\u003c')}, `;
      download(link ? new Blob([(await answer.text()).replace('id="scene">{', at)], { type: 'text/html' }) : await answer.blob(), `${name}.${file}`);
    } catch (error) {
      say(error instanceof TypeError ? 'vvgt view has stopped' : error.message, true);
    }
  }

  for (const file of server ? ['ply', 'html', 'json'] : ['json']) {
    const button = document.createElement('button');
    const tell = () => {
      const labelled = file === 'json' && Boolean(panel.at().rows);
      [button.textContent, button.title] = [file !== 'json' ? `.${file}` : labelled ? 'labels.json' : 'tf.json', `save ${labelled ? 'the table of labels' : NAMES[file]}`];
    };
    tell();
    root.addEventListener('change', tell);
    button.addEventListener('click', () => save(file));
    row.append(button);
  }
  panel.changed(put);
  put();
  if (server) {
    for (const event of ['pointerdown', 'pointerup', 'pointercancel']) {
      root.addEventListener(event, () => { down = event === 'pointerdown'; }, true);
    }
    window.addEventListener('pointerup', () => { down = false; }, true);
    panel.changed(changed);
    changed(false);  // for the function to begin with
  }
}
