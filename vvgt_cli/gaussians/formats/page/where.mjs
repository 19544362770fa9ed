// Where one is: the drawing over the picture (letters, scale bar, legend, ruler), its buttons and keys.
import { rowsOf } from './about.mjs';
import { DIAGNOSIS, factsOf, isMedical, worldOf } from './facts.mjs';
import { drawLabels, drawLegend } from './legend.mjs';
import { firstAngles, stayFree } from './free.mjs';
import { handlesOf } from './handles.mjs';
import { helpRows, listed, listen } from './keys.mjs';
import { lensOf } from './lens.mjs';
import { messages } from './messages.mjs';
import { frameParts, linkOf, liveParts, restore, saidBy, viewParts } from './link.mjs';
import { marksOf } from './marks.mjs';
import { drawLetters, seenFrom, sides } from './orientation.mjs';
import { drawCross, drawPlace, pickerOf, placeText, valueText } from './ruler.mjs';
import { drawScale } from './scale.mjs';
import { save } from './saved.mjs';
import { sharing } from './share.mjs';
import { sheet } from './sheet.mjs';
import { pageOf, pictureOf, sizesOf } from './shot.mjs';
import { slicesOf } from './slices.mjs';
import { storyOf } from './story.mjs';
import { element, moveApart } from './svg.mjs';

const LEFT = 12;  // px
const AWAY = 2, UP = 1.3;  // m in a headset, to the middle of the body, whose longest edge is 2 m: away, and above the floor
const icon = (path) => `<svg viewBox="0 0 18 18" aria-hidden="true"><path d="${path}"/></svg>`;
const ICONS = {
  perspective: icon('M2 15L6 4h6l4 11Z'), orthographic: icon('M3.5 3.5h11v11h-11Z'), measure: icon('M2.5 12.5l10-10 3 3-10 10ZM6 9l1.5 1.5M9 6l1.5 1.5'),
  picture: icon('M2 6h3l1.5-2h5L13 6h3v9H2ZM9 7.5a2.5 2.5 0 1 0 .01 0'), link: icon('M7.5 10.5l3-3M8 5l2-2a3 3 0 0 1 5 4l-2.5 2M10 13l-2 2a3 3 0 0 1-5-4l2.5-2'),
  fit: icon('M3 6V3h3M12 3h3v3M15 12v3h-3M6 15H3v-3M6.5 6.5h5v5h-5Z'), reset: icon('M4 3v4h4M4.2 7A5.5 5.5 0 1 1 3.6 10.5'), help: icon('M6.3 6.3a2.8 2.8 0 1 1 3.9 2.5Q9 9.4 9 11M9 13.5v.5'),
  slices: icon('M2.5 2.5h13v13h-13ZM9 2.5v13M2.5 9h13'), share: icon('M9 11V2M6 5l3-3 3 3M5 8H3.5v7.5h11V8H13'), story: icon('M3 3h12v9H8l-3 3v-3H3ZM6 6h6M6 9h4'), full: icon('M3 7V3h4M11 3h4v4M15 11v4h-4M7 15H3v-4'), about: icon('M9 8v5M9 5v.5M9 1.5a7.5 7.5 0 1 0 .01 0'),
};

export function where(viewer, scene, live, show, grids) {
  const lens = lensOf(viewer), { app } = viewer, svg = element('svg', { id: 'where', role: 'img' });
  const handles = live && handlesOf(lens, live.cut);
  document.querySelector('#view .sse-viewer').append(...(live ? [live.look.canvas] : []), svg, ...(handles ? [handles.svg] : []));
  const values = live?.layers.some(({ nodes }) => nodes), box = document.createElement('nav'), buttons = [];
  box.id = 'tools';
  box.setAttribute('aria-label', 'view');
  const about = listed('about', 'About this file', []), help = listed('help', 'Mouse, touch and keys', []), sizes = listed('sizes', 'Save the picture as PNG');
  const places = Object.assign(document.createElement('div'), { id: 'places', hidden: true });
  document.body.append(box, help.root, about.root, sizes.root, places);
  places.setAttribute('role', 'status');
  let data, world, facts, drawn = '', stamp = 0, told = '';
  const state = {};

  // what is streamed is not held as a whole: its comments alone
  const dataNow = () => app.assets.get(app.root.findByName('gsplat').gsplat.asset)?.resource?.gsplatData ?? data ?? { comments: scene.comments ?? [], numSplats: 0 };
  const frame = () => (show ? document.querySelector('#series select').selectedIndex : 0);
  const again = (text = '') => { told = text; stamp++; app.renderNextFrame = true; };
  const name = () => scene.frames[frame()].name.replace(/\.(ply|html)$/, '').replace(/[^\w.-]+/g, '-');
  const saved = window.vvgtSource ? () => save(pageOf(window.vvgtSource, saidBy(parts)), `${name()}.html`) : null, marks = marksOf(() => world, () => again(), saved);
  box.after(marks.root);
  let clicked = null;
  const pick = pickerOf(lens, () => world, dataNow, live?.look ?? null, (place) => {
    if (live?.kept?.wants) return live.kept.take(place);
    clicked = place;
    again(marks.open && !place ? 'nothing under the pointer' : '');
    if (!place) return;
    if (marks.open) marks.take(place);
    live?.select(place);
    slices?.to(place.world);
    report(place, { label: place.row === undefined ? undefined : live.layers[place.layer].layer.labels[place.row].number });
  });
  const report = (place, more) => site.say('picked', { text: placeText(place, world), place: place.world, unit: world.unit, value: place.value, in: place.in, layer: place.layer, ...more });
  const labelled = (layer) => live?.look.rows[layer];
  const slices = grids && slicesOf(grids, {
    world: () => world, cuts: Boolean(live), rows: labelled, measures: () => marks.open, moved: () => again(),
    picked(place) {
      if (place && marks.open) marks.take(place);
      if (place) report(place, { text: slices.text(place), value: place.value ?? place.names[0] ?? null });
    },
  });
  let faced = 'null';
  const seen = [marks.part, ...(slices ? [slices.part] : []), ...viewParts(lens, (angles) => free.times(angles)), ...(show ? frameParts(show) : []), ...(live ? liveParts(live) : [])];
  const story = storyOf({ lens, live, seen, apply: (what) => site.apply(what), slices, moving: again, begins: scene.story, page: saved }), parts = [...story.parts, ...seen];

  if (live) live.begins = () => saidBy(parts.filter(({ key }) => !/^(function|labels|light|drawn)/.test(key)));  // of a page that the server makes for the look

  function take(now) {  // another frame is another file
    data = now;
    facts = factsOf(now.comments);
    const { unit } = world ?? {};
    world = worldOf(facts, scene.enlarged);
    if (world.unit !== unit) marks.renew();
    sides(world).forEach(([, axis, sign], k) => {
      const { made, title } = buttons[k];
      made.textContent = world.letters[axis][sign < 0 ? 0 : 1];
      made.setAttribute('aria-label', `${made.textContent}: ${title}`);
    });
    live?.cut.name(world.letters);
    about.rows(rowsOf(scene.frames[frame()].name, { facts, world, count: now.numSplats, look: scene.look, values: scene.values }));
  }

  const button = (name, title, key, press) => {
    const made = document.createElement('button');
    Object.assign(made, { className: name, title: key ? `${title} (${key})` : title, innerHTML: ICONS[name] ?? '' });
    made.setAttribute('aria-label', title);
    made.addEventListener('click', press);
    box.append(made);
    buttons.push({ title, key, press, made });
    return made;
  };
  const spread = () => {  // how wide the buttons are, which panels stay beside
    const boxes = buttons.map(({ made }) => made.getBoundingClientRect()).filter(({ width }) => width);
    document.body.style.setProperty('--tools', `${Math.max(...boxes.map(({ right }) => right)) - Math.min(...boxes.map(({ left }) => left))}px`);
  };
  const look = (angles) => { fit(angles); again(); };
  let last = null;
  const view = (k, opposite) => {
    const [, axis, sign] = sides(world)[k], other = opposite ?? last === k;  // once more: from the other side
    last = other ? null : k;
    look(seenFrom(lens, world, axis, other ? -sign : sign));
  };
  for (const [k, [name, opposite, key]] of [['front', 'back', 'y'], ['left', 'right', 'x'], ['top', 'bottom', 'z']].entries()) {
    button(name, `view from the ${name}; again or with Shift: from the ${opposite}`, key, (event) => view(k, event.shiftKey || undefined));
  }
  button('fit', 'fit into the window', 'f', () => look(lens.pose()));
  button('reset', 'reset the view', 'r', () => { last = null; look(firstAngles(scene)); });
  const projection = button('perspective', 'switch between perspective and orthographic', 'o', () => { lens.flat = !lens.flat; again(); });
  const measure = (open) => {
    if (open !== marks.open) marks.toggle();
    lens.canvas.classList.toggle('measuring', marks.open);
    clicked = null;
    again();
  };
  const measuring = button('measure', 'rulers, angles and notes', 'm', () => measure(!marks.open));
  measuring.hidden = Boolean(scene.streamed);
  const slicing = slices && button('slices', 'slices of the volume', 's', () => slices.toggle());
  const drawing = (size) => pictureOf(viewer, svg, size, live?.look, isMedical(world, scene.values) ? DIAGNOSIS : '');
  const picture = (size) => drawing(size).then((blob) => save(blob, `${name()}.png`), ({ message }) => again(message));
  sizes.of(button('picture', 'save a picture (PNG)', 'p', () => {
    sizes.root.lastChild.replaceChildren(...sizesOf(app).map((size) => {
      const made = Object.assign(document.createElement('button'), { textContent: `${size.join(' × ')} px` });
      made.addEventListener('click', () => { sizes.close(); lens.canvas.focus({ preventScroll: true }); picture(size); });
      return made;
    }));
    sizes.toggle();
    sizes.root.querySelector('button').focus();
  }));
  const shared = sharing({ link: () => linkOf(parts), picture: () => drawing(), name, say: again });
  button('link', 'copy a link to this view', 'l', shared.link).hidden = location.protocol === 'about:';  // of a notebook's cell, which has no address
  shared.of(button('share', 'share the picture or the page', 'e', shared.toggle));
  story.write.of(button('story', 'write a story', 't', story.write.toggle));
  const whole = document.documentElement;
  if (document.fullscreenEnabled && whole.requestFullscreen) button('full', 'full screen', '', () => (document.fullscreenElement ? document.exitFullscreen() : whole.requestFullscreen()).catch(() => {}));
  for (const kind of ['VR', 'AR']) {
    const made = button('xr', kind === 'VR' ? 'virtual reality' : 'augmented reality', '', () => viewer.startXR(kind.toLowerCase()).catch(() => {})), offer = () => { made.hidden = !viewer.state[`canStart${kind}`]; spread(); };
    made.textContent = kind;
    viewer.events.on(`canStart${kind}:changed`, offer);
    offer();
  }
  // in a headset the body stands before the eyes, not on the floor
  app.xr?.on('start', () => {
    const { target, yaw } = lens.pose(), away = AWAY * (scene.enlarged ?? 1), turn = (yaw * Math.PI) / 180;
    lens.rig.setPosition(target[0] + away * Math.sin(turn), target[1] - UP, target[2] + away * Math.cos(turn));
    lens.rig.setEulerAngles(0, yaw, 0);
  });
  help.of(button('help', 'mouse, touch and keys', 'h', help.toggle));
  about.of(button('about', 'about this file', 'i', about.toggle));
  help.rows(helpRows(buttons.filter(({ made }) => !made.hidden), { live, values, picks: !scene.streamed, sliced: slices }));
  help.root.before(sheet({
    ...(live && Object.fromEntries(['look', 'cut'].map((name) => [name, { root: live.root, show: (open) => live.fold(!open) }]))),
    ...(slices && { slices: { root: slices.root, show: slices.toggle } }),
    ...(scene.streamed ? {} : { measure: { root: marks.root, show: measure } }),
    share: { root: shared.root, show: shared.toggle },
  }));
  lens.canvas.tabIndex = 0;
  lens.canvas.setAttribute('role', 'application');
  lens.canvas.setAttribute('aria-label', `${document.title}, in 3D: arrow keys turn, plus and minus zoom, h for help`);
  const act = Object.fromEntries(buttons.filter(({ key, made }) => key && !made.hidden).map(({ key, press }) => [key, press]));
  listen(lens, { ...act, ...(live?.next ? { k: live.next } : {}), pagedown: story.next, pageup: story.back, '?': help.toggle, enter: ({ target }) => target === lens.canvas && pick(...lens.middle) }, () => measure(false), again);
  const views = Object.fromEntries(['front', 'left', 'top'].flatMap((name, k) => [[name, () => view(k, false)], [['back', 'right', 'bottom'][k], () => view(k, true)]]));
  const site = messages({ live, lens, views: { ...views, fit: () => look(lens.pose()), reset: act.r }, axes: () => world.axes, moving: again }, app);
  lens.canvas.addEventListener('dblclick', () => {
    if (clicked && !marks.open) lens.set({ ...lens.pose(), target: clicked.place });
  });
  for (const event of ['focus', 'blur']) lens.canvas.addEventListener(event, () => { if (marks.open) again(told); });
  addEventListener('hashchange', () => restore(parts).then(() => again()));

  function legend(group, wide, high) {
    const baked = live ? null : facts.legend, boxes = buttons.map(({ made }) => made.getBoundingClientRect()), low = Math.max(...boxes.map((one) => one.bottom));
    const place = { right: (low > high - 182 ? Math.min(...boxes.map((one) => one.left || wide)) : wide) - 12, bottom: high - 24 };
    if (baked?.labels) return drawLabels(group, { ...baked, ...place, high });
    if (baked) return drawLegend(group, { nodes: baked.nodes, live: baked, ...place });
    const { layer, nodes } = live?.at() ?? {}, drawn = live?.drawn();
    if (drawn) return drawn === 1 ? drawLegend(group, { nodes: live.grey.ends().map((x, k) => ({ x, y: 1, rgb: [k, k, k] })), live: { ...layer, values: live.grey.ends() }, ...place }) : null;
    return nodes ? drawLegend(group, { nodes: nodes(), live: layer, ...place }) : null;
  }

  function drawFaces() {
    const now = live.cut.planes().length ? slices.face : null, said = JSON.stringify(now);
    if (said === faced) return;
    faced = said;
    const [lo, hi] = now ? live.look.layers[now.layer].values : [], of = (x) => (x - lo) / (hi - lo || 1);
    live.look.face(now && { layer: now.layer, from: of(now.low), to: of(now.high) });
  }

  function draw() {
    const wide = svg.clientWidth, high = svg.clientHeight, all = { lens, world, wide, high, left: LEFT };
    const [letters, rest, colors] = ['over', '', 'over'].map((name) => element('g', { class: name }));
    state.letters = drawLetters(letters, all);
    state.scale = drawScale(rest, { ...all, left: LEFT + 96 });
    state.legend = legend(colors, wide, high);
    marks.draw(rest, { ...all, cross: marks.open && lens.canvas.matches(':focus-visible') && lens.middle });
    const at = clicked && !marks.open && lens.project(clicked.place);
    if (at) drawPlace(rest, at, `${valueText(clicked)}${clicked.mean ? ` (${clicked.mean})` : ''}`);
    slices?.mark(marks.drawn);
    if (slices?.open) drawCross(rest, lens, slices.lines().map((line) => line.map(world.at)));
    svg.replaceChildren(letters, colors, rest);
    moveApart([...rest.querySelectorAll('text')], [...svg.querySelectorAll('.over text')]);
    handles?.draw(world);
    if (slices && live) drawFaces();
    const facing = [...state.letters].map(({ letter }) => letter).join(' ');
    svg.setAttribute('aria-label', `axes ${facing}${state.scale ? `; scale bar ${state.scale.text}` : ''}`);
    const lines = [...(clicked ? [placeText(clicked, world)] : []), ...(marks.open ? [marks.hint] : []), ...(told ? [told] : [])];
    [places.hidden, places.textContent] = [!lines.length, lines.join('\n')];
    projection.innerHTML = ICONS[lens.flat ? 'orthographic' : 'perspective'];
    measuring.setAttribute('aria-expanded', String(marks.open));
    slicing?.setAttribute('aria-expanded', String(slices.open));
  }

  app.on('update', () => {
    if (live) slices?.follow(live.look.rows);
    const now = dataNow();
    if (now !== data) { take(now); stamp++; }
    const pose = lens.pose(), said = JSON.stringify([pose, lens.flat, lens.middle, svg.clientWidth, svg.clientHeight, stamp, live?.at().nodes?.(), live?.at().layer.title, live?.drawn(), live?.grey?.ends(), live?.cut.state()]);
    if (said === drawn) return;
    drawn = said;
    draw();
  });
  take(dataNow());
  live?.look.begin(lens, () => world, live.covering);
  spread();
  addEventListener('resize', spread);
  const free = stayFree(lens, scene, draw), { fit } = free;
  Object.defineProperty(state, 'clicked', { get: () => clicked });
  Object.assign(state, { lens, marks, site, slices, story, restored: restore(parts, scene.link).then((restored) => restored || story.begin()), link: () => linkOf(parts), turn: () => free.turn(app, () => live?.look.shows), picture: drawing, get world() { return world; }, get facts() { return facts; } });
  return state;
}
