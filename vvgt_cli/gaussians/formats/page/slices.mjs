// Slices of the volume beside the picture: three planes that cross at a place, windowed, with the value under the pointer.
import { hide } from './keys.mjs';
import { placeText } from './ruler.mjs';
import { viewsOf } from './volume.mjs';

const STILL = 6, COLORS = ['#ff9d8a', '#9be08a', '#9ac4ff'];  // px that a click stays within; of the axes x, y and z
const CT = [['soft tissue', 400, 40], ['lung', 1500, -600], ['bone', 1800, 400], ['brain', 80, 40]];
const OVER = 0.5;  // how much of a label's colour is seen over values
const HTML = `<header><b>slices</b><select class="grid" aria-label="volume" title="volume"></select><select class="preset" aria-label="window" title="window"></select>
<label title="window: width of the range of greys">W <input class="window" type="number" step="any" min="0"></label><label title="level: middle of the range of greys">L <input class="level" type="number" step="any"></label><button class="face" aria-pressed="false" title="show the slice on the faces of the cut">on the cut</button><button class="close" aria-label="close the slices" title="close the slices">✕</button></header><div></div><output></output>`;
const FIGURE = '<canvas tabindex="0" role="application"></canvas><input type="range" min="1">';

// world(): of where.mjs; cuts: the picture has a cut; rows(layer): colours and opacities of its labels as they are shown, or null; moved(place): of the cross, picked(place): by a click
export function slicesOf(gridsOf, { world, cuts, rows, moved, picked }) {
  const root = Object.assign(document.createElement('section'), { id: 'slices', hidden: true, innerHTML: HTML });
  root.setAttribute('aria-label', 'slices');
  document.body.append(root);
  const find = (selector) => root.querySelector(selector), fields = [find('.window'), find('.level')], said = find('output');
  let grids = null, labels = [], views = [], base = null, at = [0, 0, 0], shades = null, window_ = [1, 0];

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

  function choose(grid) {
    const place = base?.toWorld(at);
    base = grid;
    views.forEach(({ figure }) => figure.remove());
    views = viewsOf(base, world()).map((view) => figureOf(view));
    at = place ? base.toIndex(place) : base.dims.map((n) => (n - 1) / 2);
    const valued = !base.labels;
    for (const element of [...fields.map((one) => one.parentNode), find('.preset')]) element.hidden = !valued;
    if (!valued) return go(at);
    const options = presets().map(([name], k) => new Option(name, k)), guess = Object.assign(document.createElement('optgroup'), { label: 'if in HU' });
    if (base.ct && !base.unit) {  // what the file does not state may be another scale: to choose, not to begin with
      guess.append(...options.splice(1));
      options.push(guess);
    }
    find('.preset').replaceChildren(...options, Object.assign(new Option('custom', -1), { hidden: true }));
    shade(...presets()[0].slice(1));
    go(at);
  }

  // where an index lies in a view's canvas, and back
  function frameOf({ canvas, along, up }) {
    const { clientWidth: wide, clientHeight: high } = canvas, [n, m] = [along, up].map(({ axis }) => base.dims[axis]), [a, b] = [along, up].map(({ axis }) => base.edges[axis]);
    const scale = Math.min(wide / (n * a), high / (m * b)), left = (wide - scale * n * a) / 2, top = (high - scale * m * b) / 2;
    const turned = (sign, k, count) => (sign < 0 ? count - 1 - k : k);
    return {
      left, top, wide: scale * n * a, high: scale * m * b,
      pixel: (index) => [left + scale * a * (turned(along.sign, index[along.axis], n) + 0.5), top + scale * b * (turned(-up.sign, index[up.axis], m) + 0.5)],
      index(x, y) {
        const found = [...at];
        found[along.axis] = turned(along.sign, (x - left) / (scale * a) - 0.5, n);
        found[up.axis] = turned(-up.sign, (y - top) / (scale * b) - 0.5, m);
        return found;
      },
    };
  }

  // the picture of a parallelogram, n by m pixels: values under colours of labels; from an index, a pixel across and a pixel down
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
    const [n, m] = [along, up].map(({ axis }) => base.dims[axis]), from = [0, 0, 0], right = [0, 0, 0], down = [0, 0, 0], made = new OffscreenCanvas(n, m);
    from[across] = Math.round(at[across]);
    [from[along.axis], right[along.axis]] = along.sign > 0 ? [0, 1] : [n - 1, -1];
    [from[up.axis], down[up.axis]] = up.sign > 0 ? [m - 1, -1] : [0, 1];
    made.getContext('2d').putImageData(walked(from, right, down, n, m), 0, 0);
    return made;
  }

  function drawView(view) {
    const { canvas, letters, along, up, across, slider, name } = view, ratio = devicePixelRatio, to = canvas.getContext('2d');
    slider.value = Math.round(at[across]) + 1;
    canvas.setAttribute('aria-label', `${name} slice ${slider.value} of ${base.dims[across]}: arrow keys step, drag for window and level, click to move the cross`);
    const { left, top, wide, high, pixel } = frameOf(view), [x, y] = pixel(at);
    [canvas.width, canvas.height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio];
    to.scale(ratio, ratio);
    to.drawImage(painted(view), left, top, wide, high);
    to.font = '600 12px system-ui, sans-serif';
    for (const [axis, path] of [[along.axis, [x, top, x, top + high]], [up.axis, [left, y, left + wide, y]]]) {
      to.strokeStyle = COLORS[axis];
      to.globalAlpha = 0.7;
      to.beginPath();
      to.moveTo(path[0], path[1]);
      to.lineTo(path[2], path[3]);
      to.stroke();
    }
    to.globalAlpha = 1;
    to.lineWidth = 3;
    const { clientWidth: w, clientHeight: h } = canvas;
    for (const [text, px, py] of [[letters.left, 8, h / 2], [letters.right, w - 8, h / 2], [letters.top, w / 2, 12], [letters.bottom, w / 2, h - 6]]) {
      to.textAlign = px < w / 4 ? 'left' : px > (3 * w) / 4 ? 'right' : 'center';
      to.strokeStyle = '#000';
      to.strokeText(text, px, py);
      to.fillStyle = '#ddd';
      to.fillText(text, px, py);
    }
  }
  const draw = () => { if (base && !root.hidden) views.forEach(drawView); };

  // {world, value, in, layer, names} at an index of the base, or null outside: as ruler.mjs has it
  function found(index) {
    const place = base.toWorld(index.map(Math.round)), code = base.at(index);
    if (code < 0) return null;
    const value = base.labels ? NaN : base.value(code), named = labels.map((grid) => [grid, grid.labels[grid.at(grid.from(base)(index)) - 1]]).filter(([, label]) => label);
    return { world: place, value: Number.isNaN(value) ? null : value, in: base.unit ?? '', mean: base.mean, layer: base.layer, names: named.map(([, { name }]) => name) };
  }
  const text = (one) => (one ? `${placeText(one, world())}${one.names.map((name) => `, ${name}`).join('')}` : '');

  function go(index) {
    at = index.map((x, k) => Math.min(Math.max(x, 0), base.dims[k] - 1));
    said.textContent = text(found(at));
    draw();
    moved();
  }
  const step = (axis, by) => go(at.map((x, k) => (k === axis ? Math.round(x) + by : x)));

  function figureOf(view) {
    const figure = Object.assign(document.createElement('figure'), { innerHTML: FIGURE }), [canvas, slider] = figure.children, made = { ...view, figure, canvas, slider };
    slider.max = base.dims[view.across];
    slider.setAttribute('aria-label', `${view.name} slice`);
    slider.addEventListener('input', () => step(view.across, Number(slider.value) - 1 - Math.round(at[view.across])));
    let down = null;
    canvas.addEventListener('pointerdown', (event) => {
      if (event.button || !event.isPrimary) return;
      canvas.setPointerCapture(event.pointerId);
      down = { x: event.offsetX, y: event.offsetY, from: window_, moved: false };
    });
    canvas.addEventListener('pointermove', ({ offsetX: x, offsetY: y }) => {
      if (down && !base.labels && (down.moved || Math.hypot(x - down.x, y - down.y) >= STILL)) {
        down.moved = true;
        const most = Math.max(canvas.clientWidth, 1), [window, level] = down.from;
        return shade(window * Math.max(1 + (4 * (x - down.x)) / most, 0), level + (2 * window * (down.y - y)) / most);
      }
      if (!down) said.textContent = text(found(frameOf(made).index(x, y)));
    });
    canvas.addEventListener('pointerleave', () => { if (!down) said.textContent = text(found(at)); });
    canvas.addEventListener('pointerup', ({ offsetX: x, offsetY: y }) => {
      if (down && !down.moved) {
        go(frameOf(made).index(x, y));
        picked(found(at));
      }
      down = null;
    });
    canvas.addEventListener('pointercancel', () => { down = null; });
    canvas.addEventListener('wheel', (event) => { event.preventDefault(); step(view.across, event.deltaY < 0 ? 1 : -1); }, { passive: false });
    canvas.addEventListener('keydown', (event) => {
      const by = { ArrowUp: 1, ArrowRight: 1, ArrowDown: -1, ArrowLeft: -1, PageUp: 10, PageDown: -10 }[event.key];
      if (!by) return;
      event.preventDefault();
      step(view.across, by);
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
    draw();
    moved();
    dispatchEvent(new Event('resize'));
  }
  find('.preset').addEventListener('change', ({ target }) => shade(...presets()[Number(target.value)].slice(1)));
  fields.forEach((field) => field.addEventListener('change', () => shade(...fields.map(({ valueAsNumber: x }, k) => (Number.isFinite(x) ? x : window_[k])))));
  const face = find('.face'), onFace = (now) => { face.setAttribute('aria-pressed', String(now)); moved(); };
  face.hidden = !cuts;
  face.addEventListener('click', () => onFace(face.getAttribute('aria-pressed') !== 'true'));
  find('.close').addEventListener('click', () => toggle(false));
  root.addEventListener('keydown', (event) => {
    if (event.key !== 'Escape' || event.defaultPrevented) return;
    event.preventDefault();  // or what is measured would end, too
    toggle(false);
  });

  let looks = [];
  return {
    root, toggle, text, found: (place) => found(base.toIndex(place)),
    get open() { return Boolean(base) && !root.hidden; },
    // {layer, low, high}: values on the cut, null: none
    get face() { return base && !root.hidden && face.getAttribute('aria-pressed') === 'true' ? { layer: base.layer, low: window_[1] - window_[0] / 2, high: window_[1] + window_[0] / 2 } : null; },
    get state() { return { window: window_[0], level: window_[1], at: base.toWorld(at), views, frameOf, base }; },
    // the ends of the lines that cross, in the world
    lines: () => [0, 1, 2].map((k) => [-0.5, base.dims[k] - 0.5].map((x) => base.toWorld(at.map((y, j) => (j === k ? x : y))))),
    to(place) { if (base && !root.hidden) go(base.toIndex(place)); },
    // labels that have another look
    follow(now) {
      if (now.length === looks.length && now.every((one, k) => one === looks[k])) return;
      looks = [...now];
      draw();
      moved();
    },
    part: {
      key: 'slices',
      get: () => (base && !root.hidden ? [...(base.labels ? [0, 0] : window_), ...base.toWorld(at), face.getAttribute('aria-pressed') === 'true' ? 1 : 0].map((x) => Number(x.toPrecision(6))).join(',') : ''),
      async set(text) {
        const numbers = text.split(',').map(Number);
        await toggle(Boolean(text));
        if (!text || numbers.length !== 6 || !numbers.every(Number.isFinite)) return;
        if (!base.labels) shade(numbers[0], numbers[1]);
        onFace(numbers[5] === 1);
        go(base.toIndex(numbers.slice(2, 5)));
      },
    },
  };
}
