// Slices of the volume beside the picture: three planes that cross at a place, windowed, with the value under the pointer.
import { shown } from './facts.mjs';
import { gesturesOf } from './gestures.mjs';
import { hide } from './keys.mjs';
import { COLORS } from './orientation.mjs';
import { placeText } from './ruler.mjs';
import { round } from './scale.mjs';
import { tiltOf, uprightOf, viewsOf } from './volume.mjs';

const NEARER = 1.25, MOST = 40, STEP = 24;  // times and px of a key; the largest zoom
const CT = [['soft tissue', 400, 40], ['lung', 1500, -600], ['bone', 1800, 400], ['brain', 80, 40]];
const OVER = 0.5;  // how much of a label's colour is seen over values
const HTML = `<header><b>slices</b><select class="grid" aria-label="volume" title="volume"></select><select class="preset" aria-label="window" title="window"></select><select class="axes" aria-label="axes of the slices" title="axes of the slices"></select>
<label title="window: width of the range of greys">W <input class="window" type="number" step="any" min="0"></label><label title="level: middle of the range of greys">L <input class="level" type="number" step="any"></label><button class="face" aria-pressed="false" title="show the slice on the faces of the cut">on the cut</button><button class="close" aria-label="close the slices" title="close the slices">✕</button></header><div></div><output></output>`;
const FIGURE = `<canvas tabindex="0" role="application"></canvas><div><input type="range" min="1">${[['out', '−', 'zoom out'], ['in', '+', 'zoom in'], ['large', '⤢', 'enlarge']].map(([name, sign, title]) => `<button class="${name}" title="${title}">${sign}</button>`).join('')}</div>`;
const FONT = 'system-ui, sans-serif', LETTERS = '700 13px ui-monospace, Menlo, Consolas, "DejaVu Sans Mono", monospace';  // of letters, whose I has serifs

function write(to, text, x, y, color, align = 'left') {
  to.textAlign = align;
  to.lineJoin = 'round';
  to.lineWidth = 3;
  to.strokeStyle = '#000b';
  to.strokeText(text, x, y);
  to.fillStyle = color;
  to.fillText(text, x, y);
}

// world(): of where.mjs; cuts: the picture has a cut; rows(layer): colours and opacities of its labels as they are shown, or null; measures(): clicks are points of marks; moved(place): of the cross, picked(place): by a click
export function slicesOf(gridsOf, { world, cuts, rows, measures, moved, picked }) {
  const root = Object.assign(document.createElement('section'), { id: 'slices', hidden: true, innerHTML: HTML });
  root.setAttribute('aria-label', 'slices');
  document.body.append(root);
  const find = (selector) => root.querySelector(selector), fields = [find('.window'), find('.level')], said = find('output');
  let grids = null, labels = [], views = [], base = null, at = [0, 0, 0], shades = null, window_ = [1, 0];
  let way = null, into = (index) => index;  // the grid along whose axes slices lie: the base or one along the body's axes; its indices as the base's
  let zoom = 1, middle = null, large = '', wanted = null, marks = [], marked = '';  // middle: index of the way in the middle of what is seen; large: name of the view that is alone; wanted: a place to open at

  const presets = () => {
    const all = ['all values', base.window, base.level], ct = base.ct ? CT : [];
    return base.unit ? [...ct, all] : [all, ...ct];
  };
  function shade(window, level) {
    window_ = [Math.max(window, base.step), level];
    const [low, span] = [level - window_[0] / 2, window_[0]];
    shades = Uint32Array.from({ length: 1 << base.bits }, (_, code) => {
      const grey = Math.round(255 * Math.min(Math.max((base.value(code) - low) / span, 0), 1));
      return Number.isNaN(grey) ? 0 : 0xff000000 | (grey * 0x10101);
    });
    window_.forEach((x, k) => { fields[k].value = Number(x.toPrecision(4)); });
    find('.preset').value = String(presets().findIndex(([, w, l]) => w === window && l === level));
    draw();
    moved();
  }

  const tilt = () => tiltOf(base), body = () => way !== base;
  // along the base's axes or upright ones, at the same place
  function lay(grid, upright) {
    const places = base && [at, middle].map(way.toWorld);
    base = grid;
    way = upright ? uprightOf(base) : base;
    into = upright ? base.from(way) : (index) => index;
    views.forEach(({ figure }) => figure.remove());
    views = viewsOf(way, world()).map((view) => figureOf(view));
    [at, middle] = places ? places.map(way.toIndex) : [1, 2].map(() => way.dims.map((n) => (n - 1) / 2));
    const axes = find('.axes');
    axes.hidden = !tilt();
    axes.replaceChildren(...[`volume, oblique ${tilt()}°`, world().anatomical ? 'body' : 'world'].map((name) => new Option(name)));
    axes.selectedIndex = upright ? 1 : 0;
    enlarge(large);
    toZoom(zoom);
    go(at);
  }

  function choose(grid) {
    shades = null;  // until its window is known
    lay(grid, Boolean(way) && body() && tiltOf(grid) > 0);
    const valued = !base.labels;
    for (const element of [...fields.map((one) => one.parentNode), find('.preset')]) element.hidden = !valued;
    if (!valued) return;
    const options = presets().map(([name], k) => new Option(name, k)), guess = Object.assign(document.createElement('optgroup'), { label: 'if in HU' });
    if (base.ct && !base.unit) {  // what the file does not state may be another scale: to choose, not to begin with
      guess.append(...options.splice(1));
      options.push(guess);
    }
    find('.preset').replaceChildren(...options, Object.assign(new Option('custom', -1), { hidden: true }));
    shade(...presets()[0].slice(1));
  }

  // where an index lies in a view's canvas, and back; scale: px of a length of the world
  function frameOf({ canvas, along, up }) {
    const { clientWidth: wide, clientHeight: high } = canvas, [n, m] = [along, up].map(({ axis }) => way.dims[axis]), [a, b] = [along, up].map(({ axis }) => way.edges[axis]);
    const turned = (sign, k, count) => (sign < 0 ? count - 1 - k : k);
    const scale = zoom * Math.min(wide / (n * a), high / (m * b)), left = wide / 2 - scale * a * (turned(along.sign, middle[along.axis], n) + 0.5), top = high / 2 - scale * b * (turned(-up.sign, middle[up.axis], m) + 0.5);
    return {
      scale, left, top, wide: scale * n * a, high: scale * m * b,
      pixel: (index) => [left + scale * a * (turned(along.sign, index[along.axis], n) + 0.5), top + scale * b * (turned(-up.sign, index[up.axis], m) + 0.5)],
      index(x, y) {
        const cell = [...at];
        cell[along.axis] = turned(along.sign, (x - left) / (scale * a) - 0.5, n);
        cell[up.axis] = turned(-up.sign, (y - top) / (scale * b) - 0.5, m);
        return cell;
      },
    };
  }

  // so many times as large as what fits, without a margin that could be filled
  function toZoom(times) {
    zoom = Math.min(Math.max(times, 1), MOST);
    middle = middle.map((x, k) => { const half = (way.dims[k] - 1) / 2, room = (way.dims[k] / 2) * (1 - 1 / zoom); return Math.min(Math.max(x, half - room), half + room); });
    draw();
    moved();
  }
  // about a pixel of a view, which shows what it showed, or another one
  function zoomAt(view, times, x, y, from = [x, y]) {
    const old = frameOf(view).index(...from);
    zoom = Math.min(Math.max(zoom * times, 1), MOST);
    const now = frameOf(view).index(x, y);
    middle = middle.map((m, k) => m + old[k] - now[k]);
    toZoom(zoom);
  }
  function pan(view, x, y) {
    const frame = frameOf(view), [from, to] = [frame.index(0, 0), frame.index(x, y)];
    middle = middle.map((m, k) => m + from[k] - to[k]);
    toZoom(zoom);
  }
  // one view alone in all of the room, '': all three
  function enlarge(name) {
    large = name;
    root.classList.toggle('large', Boolean(name));
    document.body.classList.toggle('enlarged', Boolean(name) && !root.hidden);
    for (const { figure, name: own } of views) {
      const [less, more, button] = figure.querySelectorAll('button');
      figure.hidden = Boolean(name) && own !== name;
      less.hidden = more.hidden = own !== name;
      button.setAttribute('aria-pressed', String(own === name));
    }
    dispatchEvent(new Event('resize'));
    moved();
  }

  // the picture of a parallelogram, n by m pixels: values under colours of labels; from an index of the base, a pixel across and a pixel down
  function walked(from, across, down, n, m) {
    const picture = new ImageData(n, m), pixels = new Uint32Array(picture.data.buffer), { data } = picture, share = base.labels ? 1 : OVER;
    const over = labels.map((grid) => ({ grid, own: grid.from(base), colors: rows(grid.layer) ?? grid.labels }));
    for (let j = 0, p = 0; j < m; j++) for (let i = 0; i < n; i++, p++) {
      const x = from[0] + i * across[0] + j * down[0], y = from[1] + i * across[1] + j * down[1], z = from[2] + i * across[2] + j * down[2];
      if (!base.labels) pixels[p] = shades[base.near(x, y, z)] ?? 0;
      for (const { grid, own, colors } of over) {
        const seen = colors[grid.at(own([x, y, z])) - 1];
        if (!seen?.opacity) continue;
        for (let c = 0; c < 3; c++) data[4 * p + c] = (1 - share) * data[4 * p + c] + 255 * share * seen.rgb[c];
        data[4 * p + 3] = 255;
      }
    }
    return picture;
  }

  function painted({ along, up, across }) {
    const [n, m] = [along, up].map(({ axis }) => way.dims[axis]), from = [0, 0, 0], right = [0, 0, 0], down = [0, 0, 0], made = new OffscreenCanvas(n, m);
    from[across] = Math.round(at[across]);
    [from[along.axis], right[along.axis]] = along.sign > 0 ? [0, 1] : [n - 1, -1];
    [from[up.axis], down[up.axis]] = up.sign > 0 ? [m - 1, -1] : [0, 1];
    const first = into(from), [i, j] = [right, down].map((step) => into(from.map((x, k) => x + step[k])).map((x, k) => x - first[k]));
    made.getContext('2d').putImageData(walked(first, i, j, n, m), 0, 0);
    return made;
  }

  // rulers, angles and notes in the plane that is seen
  function drawMarks(to, { along, up, across }, { pixel }) {
    for (const { kind, places, told } of marks) {
      const ends = places.map(way.toIndex).map((index) => (Math.abs(index[across] - Math.round(at[across])) <= 0.5 + 1e-6 ? pixel(index) : null)), all = ends.every(Boolean);
      to.beginPath();
      if (all) ends.forEach((p, k) => to[k ? 'lineTo' : 'moveTo'](...p));
      for (const [x, y] of ends.filter(Boolean)) {
        to.moveTo(x + 4, y);
        to.arc(x, y, 4, 0, 2 * Math.PI);
      }
      for (const [width, color] of [[4, '#0009'], [1.5, '#fc3']]) {
        [to.lineWidth, to.strokeStyle] = [width, color];
        to.stroke();
      }
      if (!all || !told) continue;
      const [x, y] = kind === 'ruler' ? [0, 1].map((c) => (ends[0][c] + ends[1][c]) / 2) : ends[kind === 'angle' ? 1 : 0];
      write(to, told, x, y - 8, '#fc3', 'center');
    }
  }

  function drawScale(to, view, { scale }) {
    const { canvas: { clientWidth: w, clientHeight: h } } = view, length = round(Math.min(w / 3, 120) / scale), across = length * scale;
    view.scale = { length, across };
    to.beginPath();
    to.moveTo(8, h - 13);
    to.lineTo(8, h - 7);
    to.moveTo(8, h - 10);
    to.lineTo(8 + across, h - 10);
    to.moveTo(8 + across, h - 13);
    to.lineTo(8 + across, h - 7);
    for (const [width, color] of [[4, '#0009'], [1.5, '#fff']]) {
      [to.lineWidth, to.strokeStyle] = [width, color];
      to.stroke();
    }
    write(to, `${shown(length)}${world().unit && ` ${world().unit}`}`, 8, h - 17, '#fff');
  }

  function drawView(view) {
    const { canvas, letters, along, up, across, slider, name } = view, ratio = devicePixelRatio, to = canvas.getContext('2d'), { clientWidth: w, clientHeight: h } = canvas;
    if (!w || !h) return;
    const said = tilt() && !body() ? `oblique ${tilt()}°` : '';
    slider.value = Math.round(at[across]) + 1;
    canvas.setAttribute('aria-label', `${name} slice ${slider.value} of ${way.dims[across]}${said && `, ${said}`}: arrow keys step, with Shift move; plus and minus zoom; Enter enlarges; drag for window and level, click to move the cross`);
    const frame = frameOf(view), { left, top, wide, high, pixel } = frame, [x, y] = pixel(at);
    [canvas.width, canvas.height] = [w * ratio, h * ratio];
    to.scale(ratio, ratio);
    to.drawImage(painted(view), left, top, wide, high);
    to.globalAlpha = 0.7;
    for (const [axis, path] of [[up.world, [x, top, x, top + high]], [along.world, [left, y, left + wide, y]]]) {  // along each, as the letters in the picture
      to.strokeStyle = COLORS[axis];
      to.beginPath();
      to.moveTo(path[0], path[1]);
      to.lineTo(path[2], path[3]);
      to.stroke();
    }
    to.globalAlpha = 1;
    to.font = LETTERS;
    for (const [text, px, py, { world: axis }, align] of [[letters.left, 6, h / 2 + 4, along, 'left'], [letters.right, w - 6, h / 2 + 4, along, 'right'], [letters.top, w / 2, 14, up, 'center'], [letters.bottom, w / 2, h - 6, up, 'center']]) write(to, text, px, py, COLORS[axis], align);
    to.font = `600 12px ${FONT}`;
    [name, said].forEach((text, k) => write(to, text, 6, 14 + 14 * k, '#ddd'));
    drawScale(to, view, frame);
    drawMarks(to, view, frame);
  }
  const draw = () => { if (base && !root.hidden && (shades || base.labels)) views.forEach(drawView); };

  // {world, value: of the nearest voxel, in, layer, names} at an index of the way, or null outside: as ruler.mjs has it
  function found(index) {
    const inside = into(index), code = base.at(inside);
    if (code < 0) return null;
    const value = base.labels ? NaN : base.value(code), named = labels.map((grid) => [grid, grid.labels[grid.at(grid.from(base)(inside)) - 1]]).filter(([, label]) => label);
    return { world: way.toWorld(index), value: Number.isNaN(value) ? null : value, in: base.unit ?? '', mean: base.mean, layer: base.layer, names: named.map(([, { name }]) => name) };
  }
  const text = (one) => (one ? `${placeText(one, world())}${one.names.map((name) => `, ${name}`).join('')}` : '');

  function go(index) {
    at = index.map((x, k) => Math.min(Math.max(x, 0), way.dims[k] - 1));
    said.textContent = text(found(at));
    draw();
    moved();
  }
  const step = (axis, by) => go(at.map((x, k) => (k === axis ? Math.round(x) + by : x)));

  function figureOf(view) {
    const figure = Object.assign(document.createElement('figure'), { innerHTML: FIGURE }), canvas = figure.firstChild, slider = figure.querySelector('input'), made = { ...view, figure, canvas, slider };
    const { name, across, along, up } = view, buttons = figure.querySelectorAll('button'), swap = () => { enlarge(large ? '' : name); canvas.focus({ preventScroll: true }); };
    slider.max = way.dims[across];
    slider.setAttribute('aria-label', `${name} slice`);
    slider.addEventListener('input', () => step(across, Number(slider.value) - 1 - Math.round(at[across])));
    const nearer = (times) => zoomAt(made, times, canvas.clientWidth / 2, canvas.clientHeight / 2);
    for (const [k, press] of [() => nearer(1 / NEARER), () => nearer(NEARER), swap].entries()) {
      buttons[k].setAttribute('aria-label', `${buttons[k].title} the ${name} slice`);
      buttons[k].addEventListener('click', press);
    }
    // in the plane that is drawn
    const index = (x, y) => { const all = frameOf(made).index(x, y); all[across] = Math.round(at[across]); return all; };
    let begun = window_;
    gesturesOf(canvas, {
      click(x, y) { go(index(x, y)); picked(found(at)); },
      twice() { if (!measures()) swap(); },
      drag(x, y, begins) {
        if (base.labels) {  // nothing to window
          const [a, b] = begins ? [0, 0] : begun;
          begun = [x, y];
          return pan(made, x - a, y - b);
        }
        if (begins) begun = window_;
        const most = Math.max(canvas.clientWidth, 1), [window, level] = begun;
        shade(window * Math.max(1 + (4 * x) / most, 0), level - (2 * window * y) / most);
      },
      move: (x, y) => pan(made, x, y), zoom: (...how) => zoomAt(made, ...how), step: (by) => step(across, by),
      hover(x, y) { said.textContent = text(found(index(x, y))); },
      left() { said.textContent = text(found(at)); },
    });
    canvas.addEventListener('keydown', (event) => {
      const { key, shiftKey: shift } = event, by = { ArrowUp: 1, ArrowRight: 1, ArrowDown: -1, ArrowLeft: -1, PageUp: 10, PageDown: -10 }[key], arrow = { ArrowUp: [0, STEP], ArrowRight: [-STEP, 0], ArrowDown: [0, -STEP], ArrowLeft: [STEP, 0] }[key], times = { '+': NEARER, '=': NEARER, '-': 1 / NEARER, _: 1 / NEARER, 0: 1 / zoom }[key];
      if (event.ctrlKey || event.altKey || event.metaKey || !(by || times || key === 'Enter')) return;
      event.preventDefault();
      if (key === 'Enter') swap();
      else if (times) nearer(times);
      else if (shift && arrow) pan(made, ...arrow);
      else step(across, by);
    });
    new ResizeObserver(draw).observe(canvas);
    root.children[1].append(figure);
    return made;
  }

  async function open() {
    if (grids) return;
    said.textContent = 'loading';
    grids = await gridsOf();
    labels = grids.filter((grid) => grid.labels);
    const valued = grids.filter((grid) => !grid.labels), bases = valued.length ? valued : labels.slice(0, 1), list = find('.grid');
    list.replaceChildren(...bases.map(({ title }, k) => new Option(title || `layer ${k}`)));
    list.hidden = bases.length < 2;
    list.addEventListener('change', () => choose(bases[list.selectedIndex]));
    choose(bases[0]);
  }
  async function toggle(shown = root.hidden) {
    if (shown) root.hidden = false;
    else hide(root, document.querySelector('#tools .slices'));
    document.body.classList.toggle('sliced', shown);
    if (shown) await open().catch(({ message }) => { said.textContent = `The slices cannot be shown: ${message}.`; });
    if (shown && base && wanted) go(way.toIndex(wanted));
    wanted = null;
    draw();
    enlarge(large);
  }
  find('.preset').addEventListener('change', ({ target }) => shade(...presets()[Number(target.value)].slice(1)));
  fields.forEach((field) => field.addEventListener('change', () => shade(...fields.map(({ valueAsNumber: x }, k) => (Number.isFinite(x) ? x : window_[k])))));
  const face = find('.face'), onFace = (now) => { face.setAttribute('aria-pressed', String(now)); moved(); };
  face.hidden = !cuts;
  face.addEventListener('click', () => onFace(face.getAttribute('aria-pressed') !== 'true'));
  find('.axes').addEventListener('change', ({ target }) => lay(base, target.selectedIndex === 1));
  find('.close').addEventListener('click', () => toggle(false));
  root.addEventListener('keydown', (event) => {
    if (event.key !== 'Escape' || event.defaultPrevented) return;
    event.preventDefault();  // or what is measured would end, too
    if (large) enlarge('');
    else toggle(false);
  });

  let looks = [];
  return {
    root, toggle, text, found: (place) => found(way.toIndex(place)),
    get open() { return Boolean(base) && !root.hidden; },
    // {layer, low, high}: values on the cut, null: none
    get face() { return base && !root.hidden && face.getAttribute('aria-pressed') === 'true' ? { layer: base.layer, low: window_[1] - window_[0] / 2, high: window_[1] + window_[0] / 2 } : null; },
    get state() { return { window: window_[0], level: window_[1], at: way.toWorld(at), views, frameOf, base, way, zoom, large, tilt: tilt() }; },
    // the ends of the lines that cross, in the world
    lines: () => [0, 1, 2].map((k) => [-0.5, way.dims[k] - 0.5].map((x) => way.toWorld(at.map((y, j) => (j === k ? x : y))))),
    // where the cross is, from now on or once they are opened
    to(place) {
      if (!base || root.hidden) { wanted = place; return; }
      go(way.toIndex(place));
      if (zoom > 1) { middle = [...at]; toZoom(zoom); }
    },
    // rulers, angles and notes: marks.drawn
    mark(now) {
      const text = JSON.stringify(now);
      if (text === marked) return;
      [marks, marked] = [now, text];
      draw();
    },
    // labels that have another look
    follow(now) {
      if (now.length === looks.length && now.every((one, k) => one === looks[k])) return;
      looks = [...now];
      draw();
      moved();
    },
    part: {
      key: 'slices',  // window, level, place of the cross, on the cut; axes of the body, name of the view that is alone, zoom, middle
      get() {
        if (!base || root.hidden) return '';
        const seen = [body() ? 1 : 0, 1 + views.findIndex(({ name }) => name === large), zoom, ...(zoom > 1 ? way.toWorld(middle) : [])];
        return [...(base.labels ? [0, 0] : window_), ...way.toWorld(at), face.getAttribute('aria-pressed') === 'true' ? 1 : 0, ...(seen.join() === '0,0,1' ? [] : seen)].map((x) => Number(x.toPrecision(9))).join(',');
      },
      async set(text) {
        const numbers = text.split(',').map(Number), [upright = 0, alone = 0, times = 1, ...about] = numbers.slice(6);
        await toggle(Boolean(text));
        if (!text || !base || ![6, 9, 12].includes(numbers.length) || !numbers.every(Number.isFinite)) return;
        if (!base.labels) shade(numbers[0], numbers[1]);
        onFace(numbers[5] === 1);
        lay(base, upright === 1);
        enlarge(views[alone - 1]?.name ?? '');
        if (about.length) middle = way.toIndex(about);
        toZoom(times);
        go(way.toIndex(numbers.slice(2, 5)));
      },
    },
  };
}
