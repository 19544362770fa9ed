// Rulers, angles and notes: places of the world, drawn over the picture, listed, and as text of a link.
import { shown } from './facts.mjs';
import { hide } from './keys.mjs';
import { plus } from './lens.mjs';
import { drawPath, drawPlace } from './ruler.mjs';
import { label } from './svg.mjs';

const POINTS = { ruler: 2, angle: 3, note: 1 }, KINDS = Object.keys(POINTS);
const MOST = 100, LONG = 200;  // of a page; letters of a note
const HTML = `<div role="group" aria-label="kind">${KINDS.map((kind) => `<button data-kind="${kind}">${kind}</button>`).join('')}<button class="save" title="save this page as it is now, with its rulers, angles and notes" hidden>save page</button></div><ul></ul>`;

const size = (a) => Math.hypot(...a);
const wordsOf = (text) => String(text).slice(0, LONG).replace(/[\p{Cc}\p{Cs}\ufffe\uffff]/gu, '');  // what a picture of SVG takes
export function amountOf({ kind, places }) {
  const [a, b, c] = places;
  if (kind === 'ruler') return size(plus(b, a, -1));
  const [u, v] = [plus(a, b, -1), plus(c, b, -1)].map((w) => w.map((x) => x / size(w)));  // NaN where points coincide
  return (2 * Math.atan2(size(plus(u, v, -1)), size(plus(u, v))) * 180) / Math.PI;
}

// worldNow(): of where.mjs; changed(): what is drawn; save(): this page, or null where it cannot be saved.
// {root, open, toggle(), renew(), take(place): clicked; list, begun: places of the next; draw(group, all), part: of links}
export function marksOf(worldNow, changed, save) {
  const root = Object.assign(document.createElement('section'), { id: 'marks', hidden: true, innerHTML: HTML });
  root.setAttribute('aria-label', 'rulers, angles and notes');
  const buttons = [...root.querySelectorAll('[data-kind]')], rows = root.lastChild, saving = root.querySelector('.save');
  let kind = 'ruler', list = [], begun = [];

  const text = (mark) => (mark.kind === 'note' ? mark.text : `${Number.isFinite(amountOf(mark)) ? shown(amountOf(mark), 4) : '–'}${mark.kind === 'angle' ? '°' : worldNow().unit && ` ${worldNow().unit}`}`);
  const number = (k) => (list.length > 1 ? `${k + 1}: ` : '');

  function rowOf(mark, k) {
    const row = document.createElement('li'), name = `${mark.kind} ${k + 1}`, said = document.createElement(mark.kind === 'note' ? 'input' : 'span');
    const gone = Object.assign(document.createElement('button'), { textContent: '✕', title: `remove ${name}` });
    gone.setAttribute('aria-label', `remove ${name}${mark.kind === 'note' ? '' : `, ${text(mark)}`}`);
    gone.addEventListener('click', () => {
      put(list.toSpliced(k, 1));
      (rows.children[Math.min(k, list.length - 1)]?.lastChild ?? buttons[0]).focus();
    });
    if (mark.kind === 'note') {
      Object.assign(said, { value: mark.text, maxLength: LONG, placeholder: 'text of the note' });
      said.setAttribute('aria-label', `text of ${name}`);
      said.addEventListener('input', () => { mark.text = wordsOf(said.value); changed(); });
    } else said.textContent = `${mark.kind} ${text(mark)}`;
    row.append(`${k + 1}`, said, gone);
    return row;
  }
  function put(now = list) {
    rows.replaceChildren(...now.map(rowOf));
    list = now;
    changed();
  }
  function choose(now) {
    [kind, begun] = [now, []];
    for (const button of buttons) button.setAttribute('aria-pressed', String(button.dataset.kind === kind));
    changed();
  }
  function show(open) {
    if (open) root.hidden = false;
    else hide(root, document.querySelector('#tools .measure'));
    choose(kind);
  }
  buttons.forEach((button) => button.addEventListener('click', () => choose(button.dataset.kind)));
  saving.hidden = !save;
  saving.addEventListener('click', save);
  choose(kind);

  return {
    root, toggle: () => show(root.hidden), renew: () => put(),  // in another unit
    get open() { return !root.hidden; },
    get list() { return list; },
    get begun() { return begun; },
    // what is drawn: of each mark, and of the next one's points, {kind, places, told}
    get drawn() { return [...list.map((mark, k) => ({ kind: mark.kind, places: mark.places, told: number(k) + text(mark) })), ...(begun.length ? [{ kind: 'begun', places: begun, told: '' }] : [])]; },
    // what is still to be done, in words
    get hint() { return list.length < MOST ? `${kind}: click point ${begun.length + 1} of ${POINTS[kind]}` : `at most ${MOST}`; },
    take({ world }) {
      if (list.length >= MOST) return;
      begun = [...begun, world];
      if (begun.length < POINTS[kind]) return changed();
      const made = { kind, places: begun, text: '' };
      begun = [];
      put([...list, made]);
      if (kind === 'note') rows.lastChild.querySelector('input').focus();
      rows.lastChild.scrollIntoView({ block: 'nearest' });
    },
    draw(group, { lens, world, cross }) {
      const seen = (places) => places.map((p) => lens.project(world.at(p)));
      const line = (at) => { if (at.length > 1 && at.every(Boolean)) drawPath(group, `M${at.map((p) => p.map((x) => x.toFixed(1)).join(',')).join('L')}`); };
      list.forEach((mark, k) => {
        const at = seen(mark.places), told = number(k) + text(mark);
        line(at);
        at.forEach((p) => { if (p) drawPlace(group, p, mark.kind === 'note' ? told : ''); });
        const middle = mark.kind === 'angle' ? at[1] : mark.kind === 'ruler' && at.every(Boolean) && plus(at[0], plus(at[1], at[0], -1), 0.5);
        if (middle) group.append(label(told, middle[0], middle[1] - 9, { fill: '#fc3', 'text-anchor': 'middle', 'font-weight': 600 }));
      });
      const at = seen(begun);
      line(at);
      at.forEach((p, k) => { if (p) drawPlace(group, p, String(k + 1), 12); });
      if (cross) drawPath(group, `M${cross[0] - 9},${cross[1]}h18m-9,-9v18`);
    },
    part: {
      key: 'marks',
      get: () => (list.length ? encodeURIComponent(JSON.stringify(list.map(({ kind: of, places, text: said }) => [of, places.map((p) => p.map((x) => Number(x.toPrecision(9)))), ...(said ? [said] : [])]))) : ''),
      set(said) {
        const read = (said ? JSON.parse(said) : []).slice(0, MOST).map(([of, places, words = '']) => ({ kind: of, places, text: wordsOf(words) }));
        const whole = ({ kind: of, places }) => KINDS.includes(of) && places.length === POINTS[of] && places.every((p) => p.length === 3 && p.every(Number.isFinite));
        if (!read.every(whole)) throw new Error('no marks');
        put(read);
      },
    },
  };
}
