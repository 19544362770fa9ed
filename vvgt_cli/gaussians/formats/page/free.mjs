// Views that fit: so near that all that is seen fits into the part of the window that nothing lies over, in its middle.
import { dot, plus } from './lens.mjs';

const DEGREES = Math.PI / 180;
const FITS = 0.9;  // share of that part that is filled
const FARTHEST = 3;  // times that the eye may stand back for it; where the rest is smaller yet, the whole window
const ALIKE = 1.1;  // times the least distance: of those parts the one nearest the middle of the window
const TURN = 6;  // degrees a second
const OVER = '#live, #live > header, #named, #series, #tools, #where .over';

// the angles of the first view, degrees, as lens.pose() has them
export function firstAngles({ camera: { position, target } }) {
  const [x, y, z] = plus(position, target, -1);
  return { pitch: -Math.asin(y / Math.hypot(x, y, z)) / DEGREES, yaw: Math.atan2(x, z) / DEGREES };
}

// {target, distance} of a view into a part of some pixels; the viewer's field of view is along the longer side of the picture
export function fitting({ camera: { position, target, fov }, outermost = [] }, { pitch, yaw }, wide, high, longer = Math.max(wide, high, 1)) {
  if (!outermost.length) return { target, distance: (Math.hypot(...plus(position, target, -1)) * longer) / Math.max(Math.min(wide, high), 1) };
  const [p, q] = [pitch * DEGREES, yaw * DEGREES], right = [Math.cos(q), 0, -Math.sin(q)], d = [Math.sin(q) * Math.cos(p), -Math.sin(p), Math.cos(q) * Math.cos(p)];
  const up = [Math.sin(q) * Math.sin(p), Math.cos(p), Math.cos(q) * Math.sin(p)], t = (FITS * Math.tan((fov * DEGREES) / 2)) / longer;
  const middle = [0, 1, 2].map((k) => (Math.min(...outermost.map((at) => at[k])) + Math.max(...outermost.map((at) => at[k]))) / 2);
  const back = outermost.map((at) => plus(at, middle, -1)).map((at) => dot(at, d) + Math.max(Math.abs(dot(at, right)) / (t * Math.max(wide, 1)), Math.abs(dot(at, up)) / (t * Math.max(high, 1))));
  return { target: middle, distance: Math.max(...back) };
}

// {x, y: its middle, wide, high, target, distance} of that part, and the `least` distance of any
function freePart({ clientWidth: width, clientHeight: height }, scene, angles) {
  const over = [...document.querySelectorAll(OVER)].map((element) => element.getBoundingClientRect())
    .map((r) => ({ left: Math.max(r.left, 0), right: Math.min(r.right, width), top: Math.max(r.top, 0), bottom: Math.min(r.bottom, height) }))
    .filter(({ left, right, top, bottom }) => left < right && top < bottom);
  const whole = { x: width / 2, y: height / 2, wide: width, high: height, ...fitting(scene, angles, width, height) }, parts = [];
  const edges = (side, end) => [end, ...over.map((r) => r[side])];
  for (const left of edges('right', 0)) for (const right of edges('left', width)) for (const top of edges('bottom', 0)) for (const bottom of edges('top', height)) {
    if (left >= right || top >= bottom || over.some((r) => r.left < right && r.right > left && r.top < bottom && r.bottom > top)) continue;
    parts.push({ x: (left + right) / 2, y: (top + bottom) / 2, wide: right - left, high: bottom - top, ...fitting(scene, angles, right - left, bottom - top, Math.max(width, height, 1)) });
  }
  const least = Math.min(...parts.map((part) => part.distance)), aside = (part) => Math.hypot(part.x - whole.x, part.y - whole.y);
  if (!(least < FARTHEST * whole.distance)) return { ...whole, least: whole.distance };
  return { ...parts.filter((part) => part.distance <= ALIKE * least).sort((a, b) => aside(a) - aside(b) || a.distance - b.distance)[0], least };
}

// Keeps the middle of the view in the middle of that part when panels open and the window changes; until somebody moves the
// view, all fits. draw(): letters and legend where they belong in the window as it is.
// {fit(angles): to a view that fits; times(angles): how far the eye stands back for the window, in distances for a square picture alone; turn(app, still): turns slowly until somebody does something, but not while still() or out of sight}
export function stayFree(lens, scene, draw) {
  let fitted = null, turning = false;
  const { canvas } = lens, numbers = ({ target, pitch, yaw, distance }) => [...target, pitch, yaw, distance];
  const untouched = () => numbers(lens.pose()).every((x, k) => Math.abs(x - fitted[k]) < 1e-3);
  const fit = ({ pitch, yaw }) => {
    draw();
    const { x, y, wide, high, target, distance } = freePart(canvas, scene, { pitch, yaw }), longer = Math.max(canvas.clientWidth, canvas.clientHeight, 1);
    const around = turning ? Array.from({ length: 24 }, (_, k) => fitting(scene, { pitch, yaw: 15 * k }, wide, high, longer).distance) : [];
    lens.set({ pitch, yaw, target, distance: Math.max(distance, ...around) });
    lens.middle = [x, y];
    fitted = numbers(lens.pose());
  };
  const place = () => {
    if (untouched()) return fit(lens.pose());
    draw();
    const { x, y } = freePart(canvas, scene, lens.pose());
    lens.middle = [x, y];
  };
  document.querySelector('#live .fold')?.addEventListener('click', place);
  addEventListener('resize', place);
  fit(firstAngles(scene));
  return {
    fit, times: (angles) => freePart(canvas, scene, angles).least / fitting(scene, angles, 1, 1).distance,
    turn(app, still) {
      if (matchMedia('(prefers-reduced-motion: reduce)').matches || !untouched()) return;
      turning = true;
      let seen = true;
      new IntersectionObserver(([{ isIntersecting }]) => { seen = isIntersecting; }).observe(canvas);
      const stop = () => { turning = false; }, more = (seconds) => {
        turning &&= untouched();
        if (!turning) return app.off('update', more);
        if (!seen || still()) return;
        const { yaw, ...rest } = lens.pose();
        lens.set({ ...rest, yaw: ((yaw + TURN * seconds + 180) % 360) - 180 });
        fitted = numbers(lens.pose());
        app.renderNextFrame = true;
      };
      for (const event of ['pointerdown', 'wheel', 'keydown', 'focusin']) addEventListener(event, stop, { capture: true, once: true, passive: true });
      fit(lens.pose());
      app.on('update', more);
    },
  };
}
