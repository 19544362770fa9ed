// A story: steps, each a text with what is seen then, in the caption below the picture; shown by buttons, keys and swipes, written by the reader in a panel.
// A step is {text} with the texts of a link, {link}, or with what a story.json states (docs/page.md): {camera, cut, function, labels, layer, light, slices, frame}.
import { listed } from './keys.mjs';
import { partsOf, put, saidBy } from './link.mjs';
import { save } from './saved.mjs';

const MOST = 100, LONG = 2000;  // steps; letters of a text
const GLIDE = 900, MOST_AT_ONCE = 0.25, SWIPE = 40;  // milliseconds from view to view; share of it in one frame, however slow; px
const HTML = `<button class="back" aria-label="previous step" title="previous step (Page Up)">‹</button><div aria-live="polite" aria-atomic="true"><span></span><p></p></div><button class="next" aria-label="next step" title="next step (Page Down)">›</button>`;
const WRITE = `<p>A step is what is seen now, with a text.</p><ol></ol><div role="group" aria-label="the whole story"><button class="add">add a step</button><button class="save" title="save this page as it is now, with its story" hidden>save page</button><button class="json" title="save the story for --story">story.json</button></div>`;
const still = matchMedia('(prefers-reduced-motion: reduce)'), numbers = ({ target, pitch, yaw, distance }) => [...target, pitch, yaw, distance];

// of the parts that a link has: what a step says of them
function texts({ link, frame, camera } = {}) {
  try {
    return link ? partsOf(link) : new Map([['frame', frame ? String(frame) : ''], ['projection', camera?.orthographic ? 'orthographic' : '']]);
  } catch { return new Map(); }  // damaged: as the page begins
}

function marksIn(text) {
  try { return JSON.parse(text || '[]'); } catch { return []; }
}

// the camera from one pose to another; ends early when somebody else moves it, or going() ends
function glide(lens, from, to, going, moving) {
  const turn = (((to.yaw - from.yaw) % 360) + 540) % 360 - 180;
  let last = null, t = 0, drawn = performance.now();
  return new Promise((done) => {
    const step = () => {
      t = Math.min(t + Math.min((performance.now() - drawn) / GLIDE, MOST_AT_ONCE), 1);
      drawn = performance.now();
      const s = t * t * (3 - 2 * t), mix = (a, b) => a + (b - a) * s;
      if (!going() || (last && numbers(lens.pose()).some((x, k) => Math.abs(x - last[k]) > 1e-3))) return done();
      lens.set(t < 1 ? { target: from.target.map((x, k) => mix(x, to.target[k])), pitch: mix(from.pitch, to.pitch), yaw: from.yaw + turn * s, distance: from.distance * (to.distance / from.distance) ** s } : to);
      last = numbers(lens.pose());
      moving();
      return t < 1 ? requestAnimationFrame(step) : done();
    };
    step();
  });
}

// seen: the parts of links; apply(what): of messages; slices: of where.mjs, or null; begins: steps of the file; moving(text): draws again, with a line that says something; page(): saves it, or null
export function storyOf({ lens, live, seen, apply, slices, moving, begins = [], page }) {
  const root = Object.assign(document.createElement('section'), { id: 'story', hidden: true, innerHTML: HTML }), write = listed('steps', 'Write a story');
  root.setAttribute('aria-label', 'story');
  write.root.lastChild.innerHTML = WRITE;
  document.body.append(root, write.root);
  const find = (selector) => write.root.querySelector(selector), [back, said, next] = root.children, rows = find('ol'), marks = seen.find(({ key }) => key === 'marks');
  let list = begins, now = -1, turn = 0;

  // rulers and notes that the step has not brought
  const own = () => {
    const brought = marksIn(texts(list[now]).get('marks')).map((one) => JSON.stringify(one));
    return marksIn(decodeURIComponent(marks.get())).filter((one) => !brought.includes(JSON.stringify(one)));
  };

  function fit() {  // the caption takes its place from the picture
    const high = `${root.hidden ? 0 : root.offsetHeight}px`, { style } = document.body;
    if (style.getPropertyValue('--told') === high) return;
    style.setProperty('--told', high);
    dispatchEvent(new Event('resize'));
  }
  function tell() {
    root.hidden = !list.length;
    for (const [k, text] of [list.length ? `${now + 1} / ${list.length}` : '', list[now]?.text ?? ''].entries()) {
      if (said.children[k].textContent !== text) said.children[k].textContent = text;  // or it would be read again
    }
    [back.disabled, next.disabled] = [now < 1, now > list.length - 2];
    [...rows.children].forEach((row, k) => row.firstChild.setAttribute('aria-current', k === now ? 'step' : 'false'));
    find('.json').disabled = !list.length;
    fit();
  }

  function rowOf(step, k) {
    const row = document.createElement('li'), text = Object.assign(document.createElement('textarea'), { value: step.text, maxLength: LONG, rows: 2, placeholder: 'text of the step' });
    const button = (sign, name, press, off) => {
      const made = Object.assign(document.createElement('button'), { textContent: sign, title: name, disabled: Boolean(off) });
      made.setAttribute('aria-label', name);
      made.addEventListener('click', press);
      return made;
    };
    const move = (to) => {
      const moved = list.toSpliced(k, 1).toSpliced(to, 0, step);
      set(moved, now === k ? to : moved.indexOf(list[now]));
      rows.children[to].querySelector(to < k ? '.up' : '.down').focus();
    };
    text.setAttribute('aria-label', `text of step ${k + 1}`);
    text.addEventListener('input', () => { step.text = text.value; tell(); });
    row.append(button(`${k + 1}`, `show step ${k + 1}`, () => show(k)), text,
      Object.assign(button('↑', `move step ${k + 1} up`, () => move(k - 1), !k), { className: 'up' }), Object.assign(button('↓', `move step ${k + 1} down`, () => move(k + 1), k > list.length - 2), { className: 'down' }),
      button('✕', `remove step ${k + 1}`, () => { set(list.toSpliced(k, 1), Math.min(now > k ? now - 1 : now, list.length - 2)); (rows.children[k] ?? rows.lastChild ?? find('.add')).querySelector?.('textarea').focus(); }));
    return row;
  }
  function set(steps, at) {
    [list, now] = [steps, at];
    rows.replaceChildren(...list.map(rowOf));
    tell();
  }

  // what a step of a file states, in the order in which it is shown: the camera last
  async function state({ camera = 'reset', slices: sliced, frame, link, text, ...look }, going) {
    if (live && Object.keys(look).length) {
      const layer = live.layers[look.layer ?? 0]?.layer, preset = typeof look.function === 'string' && (layer?.presets?.find(({ name }) => name === look.function) ?? { nodes: layer?.nodes });
      const lit = preset && look.light === undefined && preset.light !== undefined ? { light: preset.light ? { kind: 'headlight', ...preset.light } : { kind: 'none' } } : {};
      apply({ ...lit, ...look, ...(preset && { function: { points: preset.nodes.map(({ x, y, rgb }) => ({ x, opacity: y, rgb })) } }) });
    }
    if (sliced && slices) {
      await slices.toggle(true);
      if (!going()) return;
      const { window, level, at } = slices.state, given = sliced === true ? {} : sliced;
      await slices.part.set([given.window ?? window, given.level ?? level, ...(given.at ?? at), given.on_cut ? 1 : 0].join(','));
    }
    if (!going()) return;
    apply({ camera: typeof camera === 'string' ? camera : 'reset' });
    if (typeof camera !== 'string') {
      const part = seen.find(({ key }) => key === 'view'), [x, y, z, pitch, yaw, distance] = part.get().split(',').map(Number);
      const { target, ...to } = { target: [x, y, z], pitch, yaw, distance, ...camera };
      part.set([...target, to.pitch, to.yaw, to.distance].join(','));
    }
  }

  let shown = Promise.resolve();  // when the step asked for last is seen
  const show = (k, at_once) => (shown = go(k, at_once));
  async function go(k, at_once = still.matches) {
    if (!list[k]) return;
    const mine = ++turn, going = () => mine === turn, step = list[k], from = lens.pose(), wanted = texts(step);
    const all = [...marksIn(wanted.get('marks')), ...own()];
    let why = '';
    now = k;
    tell();
    await put(seen.filter(({ key }) => key !== 'view'), new Map([...wanted, ['marks', all.length ? JSON.stringify(all) : '']]));
    if (!going()) return;
    if (wanted.has('view')) await put(seen.filter(({ key }) => key === 'view'), wanted);
    else await state(step, going).catch(({ message }) => { why = message; });
    if (!going()) return;
    if (!at_once) await glide(lens, from, lens.pose(), going, moving);
    moving(why);
  }
  const by = (n) => show(Math.min(Math.max(now + n, 0), list.length - 1));

  back.addEventListener('click', () => by(-1));
  next.addEventListener('click', () => by(1));
  let down = null;
  root.addEventListener('pointerdown', ({ isPrimary, pointerType, clientX: x, clientY: y }) => { down = isPrimary && pointerType !== 'mouse' ? { x, y } : null; });  // a mouse selects text
  root.addEventListener('pointerup', ({ clientX: x, clientY: y }) => {
    if (down && Math.abs(x - down.x) > SWIPE && Math.abs(x - down.x) > Math.abs(y - down.y)) by(x < down.x ? 1 : -1);
    down = null;
  });
  new ResizeObserver(fit).observe(root);
  find('.add').addEventListener('click', () => {
    if (list.length >= MOST) return;
    const text = own().flatMap(([kind, , words]) => (kind === 'note' && words ? [words] : [])).join('\n');  // a note becomes a step
    const step = { text, link: '' };
    set(list.toSpliced(now + 1, 0, step), now + 1);
    step.link = saidBy(seen);  // beside the caption, which may be new
    rows.children[now].querySelector('textarea').focus();
  });
  find('.json').addEventListener('click', () => save(new Blob([`${JSON.stringify({ steps: list }, null, 1)}\n`], { type: 'application/json' }), 'story.json'));
  find('.save').hidden = !page;
  find('.save').addEventListener('click', page);
  const begun = JSON.stringify(begins);
  set(begins, begins.length ? 0 : -1);

  return {
    root, write, show, next: () => by(1), back: () => by(-1),
    begin: () => show(0, true),
    get list() { return list; },
    get now() { return now; },
    get shown() { return shown; },
    parts: [
      {
        key: 'story', get: () => (JSON.stringify(list) === begun ? '' : encodeURIComponent(JSON.stringify(list))),
        set(text) {
          const read = text ? JSON.parse(text) : JSON.parse(begun);
          if (!read.slice(0, MOST).every((step) => typeof step?.text === 'string')) throw new Error('no story');
          set(read.slice(0, MOST).map((step) => ({ ...step, text: step.text.slice(0, LONG) })), read.length ? 0 : -1);
        },
      },
      {
        key: 'step', get: () => (now > 0 ? String(now + 1) : ''),
        set(text) {
          if (!(Number(text || 1) <= list.length && Number(text || 1) >= 1)) return;
          now = Number(text || 1) - 1;
          tell();
        },
      },
    ],
  };
}
