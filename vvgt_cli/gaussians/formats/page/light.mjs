// The light of a live page: none, at the eye, or from a direction that is dragged on a ball; and how much of it there is.
const R = 26, STEP = 0.1, FIRST = [-0.5, 0.5];  // FIRST: from the upper left as it is seen, until it is aimed
const SLIDERS = [['ambient', 1], ['diffuse', 1], ['specular', 1]], NAMES = { ambient: 'ambient', diffuse: 'diffuse', specular: 'gloss' };
const HTML = `<summary>light</summary><div class="light"><svg viewBox="-30 -30 60 60" tabindex="0" role="application" aria-label="direction of the light; drag, or use the arrow keys">
<defs><radialGradient id="light-ball" r="0.9"><stop offset="0" stop-color="#fff"/><stop offset="1" stop-color="#222"/></radialGradient></defs>
<circle r="${R}" fill="url(#light-ball)"/><circle class="dot" r="4" fill="#fc3" stroke="#000"/></svg>
<div><select aria-label="light" title="light"><option value="none">no light</option><option value="headlight">headlight</option><option value="direction">from a direction</option></select>
${SLIDERS.map(([name, most]) => `<label><span>${NAMES[name]}</span><input type="range" min="0" max="${most}" step="0.01" data-name="${name}"></label>`).join('')}</div></div>`;

// The section of the panel; `history` has keep() before a change, changed() after it, and add({key, state, set}) for what undo and links go back to.
export function light(look, { app }, begin, history) {
  const root = document.createElement('details');
  root.innerHTML = HTML;
  const find = (selector) => root.querySelector(selector), ball = find('svg'), kind = find('select');
  const camera = app.root.findComponent('camera').entity;
  let now = begin, drawn = '';

  const sides = () => [camera.right, camera.up, camera.forward].map(({ x, y, z }) => [x, y, z]);
  const dot = (a, b) => a.reduce((sum, x, k) => sum + x * b[k], 0);

  // where the light is on the ball; lit from behind is lit from before
  function place() {
    const [right, up, forward] = sides(), sign = dot(now.from, forward) > 0 ? -1 : 1;
    return now.kind === 'direction' ? [sign * dot(now.from, right), sign * dot(now.from, up)] : [0, 0];
  }

  function draw() {
    const [x, y] = place(), is = `${now.kind} ${x.toFixed(3)} ${y.toFixed(3)}`;
    if (is === drawn) return;
    drawn = is;
    for (const [name, value] of [['cx', x * R], ['cy', -y * R]]) find('.dot').setAttribute(name, value.toFixed(2));
    for (const [name, value] of [['cx', 0.5 + x / 2], ['cy', 0.5 - y / 2], ['fx', 0.5 + x / 2], ['fy', 0.5 - y / 2]]) find('radialGradient').setAttribute(name, value.toFixed(3));
    root.classList.toggle('unlit', now.kind === 'none');
  }

  function show() {
    kind.value = now.kind;
    for (const slider of root.querySelectorAll('input')) {
      slider.value = now[slider.dataset.name];
      slider.disabled = now.kind === 'none';
    }
    draw();
    look.light(now);
    history.changed(false);
  }

  function aim(x, y) {
    const far = Math.max(Math.hypot(x, y), 1), [right, up, forward] = sides();
    [x, y] = [x / far, y / far];
    const z = Math.sqrt(Math.max(1 - x * x - y * y, 0));
    now = { ...now, kind: 'direction', from: right.map((r, k) => x * r + y * up[k] - z * forward[k]) };
    show();
  }

  let dragged = false;
  const to = (event) => {
    const box = ball.getBoundingClientRect(), unit = (R * box.width) / 60;
    aim((event.clientX - box.left - box.width / 2) / unit, -(event.clientY - box.top - box.height / 2) / unit);
  };
  ball.addEventListener('pointerdown', (event) => {
    if (event.button) return;
    event.preventDefault();
    ball.focus({ focusVisible: false });
    ball.setPointerCapture(event.pointerId);
    history.keep();
    dragged = true;
    to(event);
  });
  ball.addEventListener('pointermove', (event) => { if (dragged) to(event); });
  for (const name of ['pointerup', 'pointercancel']) ball.addEventListener(name, () => { dragged = false; });
  ball.addEventListener('keydown', (event) => {
    const by = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] }[event.key];
    if (!by) return;
    event.preventDefault();
    history.keep();
    const [x, y] = place();
    aim(x + by[0], y + by[1]);
  });
  kind.addEventListener('change', () => {
    history.keep();
    now = { ...now, kind: kind.value };
    if (now.kind === 'direction' && begin.kind !== 'direction' && now.from.every((x, k) => Math.abs(x - begin.from[k]) < 1e-4)) aim(...FIRST);
    else show();
  });
  for (const slider of root.querySelectorAll('input')) {
    let moving = false;
    slider.addEventListener('input', () => {
      if (!moving) history.keep();
      moving = true;
      now = { ...now, [slider.dataset.name]: Number(slider.value) };
      show();
    });
    slider.addEventListener('change', () => { moving = false; });
  }
  app.on('update', draw);
  history.add({ key: 'light', state: () => now, set: (then) => { now = then; show(); } });
  show();
  return root;
}
