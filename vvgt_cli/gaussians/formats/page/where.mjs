// Where one is: the drawing over the picture (letters, scale bar, legend, ruler), its buttons and keys.
import { fill, rowsOf } from './about.mjs';
import { factsOf, shown, worldOf } from './facts.mjs';
import { stayFree } from './free.mjs';
import { drawLabels, drawLegend } from './legend.mjs';
import { handlesOf } from './handles.mjs';
import { lensOf } from './lens.mjs';
import { frameParts, linkOf, liveParts, restore, viewParts } from './link.mjs';
import { drawLetters, seenFrom, sides } from './orientation.mjs';
import { drawRuler, placeText, rulerOf } from './ruler.mjs';
import { drawScale } from './scale.mjs';
import { pictureOf, save } from './shot.mjs';
import { element } from './svg.mjs';

const LEFT = 12;  // px
const icon = (path) => `<svg viewBox="0 0 18 18" aria-hidden="true"><path d="${path}"/></svg>`;
const ICONS = {
  perspective: icon('M2 15L6 4h6l4 11Z'), orthographic: icon('M3.5 3.5h11v11h-11Z'), measure: icon('M2.5 12.5l10-10 3 3-10 10ZM6 9l1.5 1.5M9 6l1.5 1.5'),
  picture: icon('M2 6h3l1.5-2h5L13 6h3v9H2ZM9 7.5a2.5 2.5 0 1 0 .01 0'), link: icon('M7.5 10.5l3-3M8 5l2-2a3 3 0 0 1 5 4l-2.5 2M10 13l-2 2a3 3 0 0 1-5-4l2.5-2'),
  full: icon('M3 7V3h4M11 3h4v4M15 11v4h-4M7 15H3v-4'), about: icon('M9 8v5M9 5v.5M9 1.5a7.5 7.5 0 1 0 .01 0'),
};

export function where(viewer, scene, live, show) {
  const lens = lensOf(viewer), { app } = viewer, svg = element('svg', { id: 'where', role: 'img' });
  const handles = live && handlesOf(lens, live.cut);
  document.querySelector('#view .sse-sceneLayer').append(svg, ...(handles ? [handles.svg] : []));
  const box = document.createElement('div');
  box.id = 'tools';
  const about = Object.assign(document.createElement('section'), { id: 'about', hidden: true, innerHTML: '<dl></dl>' });
  const places = Object.assign(document.createElement('div'), { id: 'places', hidden: true });
  document.body.append(box, about, places);
  places.setAttribute('role', 'status');
  let data, world, facts, drawn = '', stamp = 0, told = '';
  const state = {};

  const dataNow = () => app.assets.get(app.root.findByName('gsplat').gsplat.asset)?.resource?.gsplatData ?? data;
  const frame = () => (show ? document.querySelector('#series select').selectedIndex : 0);
  const again = (text = '') => { told = text; stamp++; app.renderNextFrame = true; };
  const ruler = rulerOf(viewer, lens, () => world, dataNow, live?.look ?? null, again);
  const parts = [...viewParts(lens), ...(show ? frameParts(show) : []), ...(live ? liveParts(live) : [])];

  function take(now) {  // another frame is another file
    data = now;
    facts = factsOf(now.comments);
    world = worldOf(facts);
    if (ruler.measuring) ruler.measure(true);
    sides(world).forEach(([, axis, sign], k) => { views[k].textContent = world.letters[axis][sign < 0 ? 0 : 1]; });
    live?.cut.name(world.letters);
    fill(about.firstChild, rowsOf(scene.frames[frame()].name, { facts, world, count: now.numSplats, live: scene.live }));
  }

  const button = (name, title, press) => {
    const made = document.createElement('button');
    Object.assign(made, { className: name, title, innerHTML: ICONS[name] ?? '' });
    made.setAttribute('aria-label', title);
    made.addEventListener('click', press);
    box.append(made);
    return made;
  };
  let last = '';
  const view = (k, opposite) => {
    const [name, axis, sign] = sides(world)[k], other = opposite || last === name;  // once more: from the other side
    seenFrom(lens, world, axis, other ? -sign : sign);
    last = other ? '' : name;
    again();
  };
  const views = [['front', 'y'], ['left', 'x'], ['top', 'z']].map(([name, key], k) => button(name, `from the ${name}; again, or with Shift: from the other side (${key})`, (event) => view(k, event.shiftKey)));
  const projection = button('perspective', 'orthographic or perspective (o)', () => { lens.flat = !lens.flat; again(); });
  const measuring = button('measure', 'places and distances: click two points (m)', () => ruler.measure(!ruler.measuring));
  const picture = async () => save(await pictureOf(viewer, svg), `${scene.frames[frame()].name.replace(/\.(ply|html)$/, '')}.png`);
  button('picture', 'save the picture as PNG (p)', picture);
  const copy = async () => {
    const link = linkOf(parts);
    history.replaceState(null, '', link);
    const copied = await navigator.clipboard?.writeText(link).then(() => true, () => false);
    again(copied ? 'link to this view copied' : 'the address is a link to this view');
    setTimeout(again, 4000);
  };
  button('link', 'link to this view (l)', copy);
  const whole = document.documentElement;
  if (document.fullscreenEnabled && whole.requestFullscreen) button('full', 'full screen', () => (document.fullscreenElement ? document.exitFullscreen() : whole.requestFullscreen()).catch(() => {}));
  const open = button('about', 'what this is (i)', () => { about.hidden = !about.hidden; open.setAttribute('aria-expanded', String(!about.hidden)); });

  const keys = { y: [view, 0], x: [view, 1], z: [view, 2], o: [() => projection.click()], m: [() => measuring.click()], p: [picture], l: [copy], i: [() => open.click()] };
  window.addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.target.closest?.('input, select, textarea, #live')) return;
    if (event.key === 'Escape') { ruler.measure(false); about.hidden = true; }
    const [act, k] = keys[event.key.toLowerCase()] ?? [];
    act?.(k, event.shiftKey);
  });
  addEventListener('hashchange', () => restore(parts).then(again));

  function legend(group, wide, high) {
    const baked = live ? null : facts.legend, place = { right: wide - 12 - (high < 620 ? 44 : 0), bottom: high - 72 };
    if (baked?.labels) return drawLabels(group, { ...baked, ...place, high });
    if (baked) return drawLegend(group, { nodes: baked.nodes, live: baked, ...place });
    const { layer, nodes } = live?.at() ?? {};
    return nodes ? drawLegend(group, { nodes: nodes(), live: layer, ...place }) : null;
  }

  function draw() {
    const wide = svg.clientWidth, high = svg.clientHeight, all = { lens, world, wide, high, ruler, left: LEFT };
    const [letters, rest, colors] = ['over', '', 'over'].map((name) => element('g', { class: name }));
    state.letters = drawLetters(letters, all);
    state.scale = drawScale(rest, { ...all, left: LEFT + 96 });
    state.legend = legend(colors, wide, high);
    drawRuler(rest, all);
    svg.replaceChildren(letters, colors, rest);
    handles?.draw(world);
    const facing = [...state.letters].map(({ letter }) => letter).join(' ');
    svg.setAttribute('aria-label', `axes ${facing}${state.scale ? `; scale bar ${state.scale.text}` : ''}`);
    const lines = ruler.places.map((place, k) => `${k + 1}: ${placeText(place, world)}`);
    if (ruler.places.length > 1) lines.push(`distance ${shown(ruler.distance(), 4)}${world.unit && ` ${world.unit}`}`);
    else if (ruler.measuring && !lines.length) lines.push('click two points');
    if (told) lines.push(told);
    [places.hidden, places.textContent] = [!lines.length, lines.join('\n')];
    projection.innerHTML = ICONS[lens.flat ? 'orthographic' : 'perspective'];
    measuring.setAttribute('aria-pressed', String(ruler.measuring));
  }

  app.on('update', () => {
    const now = dataNow();
    if (now !== data) { take(now); stamp++; }
    const pose = lens.pose(), said = JSON.stringify([pose, lens.flat, lens.middle, svg.clientWidth, svg.clientHeight, stamp, live?.at().nodes?.(), live?.at().layer.title, live?.cut.state()]);
    if (said === drawn) return;
    drawn = said;
    draw();
  });
  take(dataNow());
  stayFree(lens, scene, draw);
  Object.assign(state, { lens, ruler, restored: restore(parts), link: () => linkOf(parts), picture: () => pictureOf(viewer, svg), get world() { return world; }, get facts() { return facts; } });
  return state;
}
