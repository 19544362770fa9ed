// Window and level of a MIP and of an X-ray: two sliders, of values and of the share that is absorbed.
import { shown } from './facts.mjs';

const WHOLE = [0, 1], LEAST = 0.005;  // from black to white, of the range; the narrowest window

// {root, draw(kind): for which, ends(): the values that are black and white}; `history` as light.mjs has it
export function greys(look, { values: [lo, hi], unit }, history) {
  const root = document.createElement('div');
  root.className = 'greys';
  root.innerHTML = ['window', 'level'].map((name) => `<label title="${name} (arrow keys)">${name[0].toUpperCase()}<input type="range" min="0" max="1" step="0.005" aria-label="${name}"></label>`).join('');
  const [wide, level] = root.querySelectorAll('input');
  let now = { 1: WHOLE, 2: WHOLE }, kind = 0, moving = false;
  const of = (x) => (kind === 1 ? lo + x * (hi - lo) : 100 * x), said = (x) => `${shown(x, 4)}${kind === 1 ? unit && ` ${unit}` : ' %'}`;

  function show() {
    root.hidden = !kind;
    const [from, to] = now[kind] ?? WHOLE;
    [wide.value, level.value] = [to - from, (from + to) / 2];
    wide.setAttribute('aria-valuetext', said(of(to - from) - of(0)));
    level.setAttribute('aria-valuetext', said(of((from + to) / 2)));
    look.grey([from, to]);
    history.changed(true);
  }
  for (const slider of [wide, level]) {
    slider.addEventListener('input', () => {
      if (!moving) history.keep();
      moving = true;
      const half = Math.max(Number(wide.value), LEAST) / 2, middle = Number(level.value);
      now = { ...now, [kind]: [middle - half, middle + half] };
      show();
    });
    slider.addEventListener('change', () => { moving = false; });
  }
  const written = () => [...now[1], ...now[2]].map((x) => Number(x.toFixed(4)));
  history.add({
    key: 'window', state: () => now, set(then) { now = then; show(); },
    text: () => (written().join() === [...WHOLE, ...WHOLE].join() ? '' : written().join()),
    read(text) {
      const ends = (text || [...WHOLE, ...WHOLE].join()).split(',').map(Number);
      if (ends.length !== 4 || !(ends[0] < ends[1] && ends[2] < ends[3])) throw new Error('not a window');
      return { 1: ends.slice(0, 2), 2: ends.slice(2) };
    },
  });
  return { root, draw(to) { kind = to; show(); }, ends: () => (now[kind] ?? WHOLE).map(of) };
}
