// The first view: from the file's direction, so near that all that is seen fits into the part of the window that nothing lies over, in its middle.
import { dot, plus } from './lens.mjs';

const FITS = 0.9;  // share of that part that is filled
const FARTHEST = 3;  // times that the eye may stand back for it; where the rest is smaller yet, the whole window
const ALIKE = 1.1;  // times the least distance: of those parts the one nearest the middle of the window
const OVER = '#live, #named, #series, #tools, #where .over';

// {position, target, fov} of a part of some pixels; the viewer's field of view is along the longer side of the window
export function firstView({ camera: { position, target, fov }, outermost = [] }, wide = innerWidth, high = innerHeight) {
  const longer = Math.max(innerWidth, innerHeight, 1), away = plus(position, target, -1), far = Math.hypot(...away);
  if (!outermost.length) return { position: plus(target, away, longer / Math.max(Math.min(wide, high), 1)), target, fov };
  const d = away.map((x) => x / far), level = Math.hypot(d[0], d[2]), right = [d[2] / level, 0, -d[0] / level];
  const up = [d[1] * right[2], d[2] * right[0] - d[0] * right[2], -d[1] * right[0]], t = (FITS * Math.tan((fov * Math.PI) / 360)) / longer;
  const middle = [0, 1, 2].map((k) => (Math.min(...outermost.map((p) => p[k])) + Math.max(...outermost.map((p) => p[k]))) / 2);
  const back = Math.max(...outermost.map((p) => plus(p, middle, -1)).map((q) => dot(q, d) + Math.max(Math.abs(dot(q, right)) / (t * Math.max(wide, 1)), Math.abs(dot(q, up)) / (t * Math.max(high, 1)))));
  return { position: plus(middle, d, back), target: middle, fov };
}

const distance = ({ position, target }) => Math.hypot(...plus(position, target, -1));

// {x, y: its middle, far: how far the eye stands back} of that part
function freePart(scene) {
  const over = [...document.querySelectorAll(OVER)].map((element) => element.getBoundingClientRect())
    .map((r) => ({ left: Math.max(r.left, 0), right: Math.min(r.right, innerWidth), top: Math.max(r.top, 0), bottom: Math.min(r.bottom, innerHeight) }))
    .filter(({ left, right, top, bottom }) => left < right && top < bottom);
  const [x, y] = [innerWidth / 2, innerHeight / 2], far = (wide, high) => distance(firstView(scene, wide, high)), most = FARTHEST * far(innerWidth, innerHeight), found = [];
  const edges = (side, end) => [end, ...over.map((r) => r[side])];
  for (const left of edges('right', 0)) for (const right of edges('left', innerWidth)) for (const top of edges('bottom', 0)) for (const bottom of edges('top', innerHeight)) {
    if (left >= right || top >= bottom || over.some((r) => r.left < right && r.right > left && r.top < bottom && r.bottom > top)) continue;
    found.push({ x: (left + right) / 2, y: (top + bottom) / 2, far: far(right - left, bottom - top) });
  }
  const least = Math.min(...found.map((part) => part.far)), aside = (part) => Math.hypot(part.x - x, part.y - y);
  if (!(least < most)) return { x, y, far: most / FARTHEST };
  return found.filter((part) => part.far <= ALIKE * least).sort((a, b) => aside(a) - aside(b) || a.far - b.far)[0];
}

// Keeps the middle of the view in the middle of that part when the panel is folded and the window changes; until somebody moves the view, all fits. draw(): letters and legend where they belong in the window as it is.
export function stayFree(lens, scene, draw) {
  let begun = null;
  const numbers = ({ target, pitch, yaw, distance: away }) => [...target, pitch, yaw, away];
  const moved = () => begun && numbers(lens.pose()).some((x, k) => Math.abs(x - begun[k]) > 1e-3);
  const place = () => {
    draw();
    const { x, y, far } = freePart(scene);
    if (!moved()) {
      lens.set({ ...lens.pose(), target: firstView(scene).target, distance: far });
      lens.begin();
      begun = numbers(lens.pose());
    }
    lens.middle = [x, y];
  };
  document.querySelector('#live .fold')?.addEventListener('click', place);
  addEventListener('resize', place);
  place();
}
