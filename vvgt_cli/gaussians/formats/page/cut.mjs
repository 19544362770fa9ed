// The cut of a live page: a plane, or a box of six faces. What is beyond is not shown; each face is moved in the picture, too (handles.mjs).
const KINDS = ['no cut', 'cut x', 'cut y', 'cut z', 'free plane', 'box'], FREE = 4, BOX = 5;
const WHOLE = [0, 1, 0, 1, 0, 1], NONE = { kind: 'none', normal: [0, 0, 1], at: 0.5, flipped: false, box: WHOLE };
const HTML = `<select class="axis" aria-label="cut" title="cut"></select><input type="range" min="0" max="1000" aria-label="position of the cut">
<button class="flip" aria-pressed="false" aria-label="show the other side" title="show the other side">⇄</button><span class="hint">drag the faces</span>`;
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const short = (x, digits) => Number(x.toFixed(digits));

// {root, state, set, change, planes, range, name}; `history` as light.mjs has it, `changed()` after every change
export function cutOf(look, { axes, box: [low, high] }, { app }, history, changed) {
  const root = document.createElement('div');
  root.className = 'cut';
  root.innerHTML = HTML;
  const [list, slider, flip, hint] = root.children;
  list.append(...KINDS.map((name) => new Option(name)));
  let now = NONE;

  // how far the box reaches along a direction
  const range = (normal) => axes.reduce(([from, to], axis, k) => {
    const ends = [low[k], high[k]].map((x) => x * dot(axis, normal));
    return [from + Math.min(...ends), to + Math.max(...ends)];
  }, [0, 0]);
  function ahead() {  // towards the eye, and aside, for the plane not to look like a frame
    const { forward, right, up } = app.root.findComponent('camera').entity, aside = ['x', 'y', 'z'].map((c) => 0.5 * right[c] + 0.3 * up[c] - forward[c]);
    return aside.map((x) => x / Math.hypot(...aside));
  }
  const along = ({ normal }) => axes.findIndex((axis) => dot(axis, normal) > 1 - 1e-9);
  const chosen = () => (now.kind === 'none' ? 0 : now.kind === 'box' ? BOX : 1 + along(now) || FREE);

  // what stays: dot(normal, x) <= place of each
  function planes() {
    if (now.kind === 'plane') {
      const [from, to] = range(now.normal), sign = now.flipped ? -1 : 1;
      return [{ normal: now.normal.map((x) => sign * x), place: sign * (from + (to - from) * now.at) }];
    }
    if (now.kind === 'none') return [];
    return axes.flatMap((axis, k) => [0, 1].filter((end) => now.box[2 * k + end] !== end).map((end) => {
      const sign = end ? 1 : -1;
      return { normal: axis.map((x) => sign * x), place: sign * (low[k] + (high[k] - low[k]) * now.box[2 * k + end]) };
    }));
  }

  function show() {
    const plane = now.kind === 'plane';
    list.selectedIndex = chosen();
    slider.value = 1000 * now.at;
    slider.hidden = flip.hidden = !plane;
    hint.hidden = now.kind !== 'box';
    flip.setAttribute('aria-pressed', String(now.flipped));
    look.cut(planes());
    changed();
  }
  const change = (by) => { now = { ...now, ...by }; show(); };

  list.addEventListener('change', () => {
    history.keep();
    const k = list.selectedIndex;
    if (!k) change({ kind: 'none' });
    else if (k === BOX) change({ kind: 'box', box: WHOLE });
    else change({ kind: 'plane', normal: k === FREE ? ahead() : axes[k - 1] });
  });
  let moving = false;
  slider.addEventListener('input', () => {
    if (!moving) history.keep();
    moving = true;
    change({ at: slider.value / 1000 });
  });
  slider.addEventListener('change', () => { moving = false; });
  flip.addEventListener('click', () => { history.keep(); change({ flipped: !now.flipped }); });

  const numbers = (texts, count) => {
    const values = texts.map(Number);
    if (values.length !== count || !values.every(Number.isFinite)) throw new Error('not a cut');
    return values;
  };
  const share = (x) => Math.min(Math.max(x / 1000, 0), 1);
  const part = {
    key: 'cut', state: () => now, set: (then) => { now = then; show(); },
    text() {
      if (now.kind === 'none') return '';
      if (now.kind === 'box') return ['box', ...now.box.map((x) => short(1000 * x, 1))].join(',');
      const k = along(now), name = k < 0 ? ['plane', ...now.normal.map((x) => short(x, 5))] : ['xyz'[k]];
      return [...name, short(1000 * now.at, 1), ...(now.flipped ? ['other'] : [])].join(',');
    },
    read(text) {
      if (!text) return NONE;
      const [word, ...rest] = text.split(','), flipped = rest.at(-1) === 'other', k = 'xyz'.indexOf(word);
      if (word === 'box') {
        const box = numbers(rest, 6).map(share);
        if ([0, 2, 4].some((j) => box[j] >= box[j + 1])) throw new Error('not a cut');
        return { ...NONE, kind: 'box', box };
      }
      const values = numbers(flipped ? rest.slice(0, -1) : rest, word === 'plane' ? 4 : 1), length = Math.hypot(...values.slice(0, 3));
      if (word === 'plane' ? !length : k < 0 || word.length !== 1) throw new Error('not a cut');
      const normal = word === 'plane' ? values.slice(0, 3).map((x) => x / length) : axes[k];
      return { ...NONE, kind: 'plane', normal, at: share(values.at(-1)), flipped };
    },
  };
  history.add(part);
  show();
  return {
    root, part, axes, low, high, range, change, planes, keep: history.keep, state: () => now,
    // the ends of the axes, as letters of the world
    name(letters) { letters.forEach(([a, b], k) => { list.options[k + 1].textContent = /[A-Z]/.test(b) ? `cut ${a}–${b}` : KINDS[k + 1]; }); },
  };
}
