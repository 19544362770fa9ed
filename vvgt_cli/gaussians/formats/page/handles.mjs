// Handles of the cut over the picture: the faces of a box, or a plane, moved and turned by mouse, touch and arrow keys.
import { dot, plus } from './lens.mjs';
import { element } from './svg.mjs';

const THIN = 0.02, STEP = 0.01, TURN = 5 * (Math.PI / 180);  // thinnest box; a key's step, of the box and in radians
const STEEP = 0.06;  // squared sine of the angle between a line and the ray below which up and down move along it
const STEM = 70;  // px that the direction of a plane is at most long
const EDGES = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];
const WHOLE = [0, 1, 0, 1, 0, 1];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const length = Math.hypot(...a) || 1; return a.map((x) => x / length); };

// where a plane meets a parallelepiped of eight corners: the corners of a polygon, and two directions in the plane
export function sectionOf(ends, { normal, place }) {
  const points = EDGES.flatMap(([i, j]) => {
    const [a, b] = [ends[i], ends[j]].map((p) => dot(normal, p) - place);
    return (a < 0) === (b < 0) ? [] : [plus(ends[i], plus(ends[j], ends[i], -1), a / (a - b))];
  });
  const side = unit(cross(normal, Math.abs(normal[0]) < 0.7 ? [1, 0, 0] : [0, 1, 0])), other = cross(normal, side);
  const centre = points.reduce((sum, p) => plus(sum, p, 1 / points.length), [0, 0, 0]), angle = (p) => Math.atan2(dot(plus(p, centre, -1), other), dot(plus(p, centre, -1), side));
  return { points: points.sort((p, q) => angle(p) - angle(q)), side, other };
}

export function handlesOf(lens, cut) {
  const svg = element('svg', { id: 'cut' }), outline = element('path', { fill: 'none', stroke: '#fc3', 'stroke-width': 1, 'stroke-opacity': 0.7 });
  const stem = element('path', { fill: 'none', stroke: '#fc3', 'stroke-width': 1.5 });
  svg.append(outline, stem);
  let letters = null, held = null;
  const at = (shares) => cut.axes.reduce((p, axis, k) => plus(p, axis, cut.low[k] + (cut.high[k] - cut.low[k]) * shares[k]), [0, 0, 0]);
  const corners = (box) => Array.from({ length: 8 }, (_, i) => at([0, 1, 2].map((k) => box[2 * k + ((i >> k) & 1)])));
  const middle = () => at([0.5, 0.5, 0.5]), size = () => Math.min(Math.hypot(...cut.high.map((x, k) => x - cut.low[k])) / 4, STEM * lens.perPixel());
  const sign = () => (cut.state().flipped ? -1 : 1);
  const foot = () => {  // of the plane, below or above the middle
    const [{ normal, place }] = cut.planes();
    return plus(middle(), normal, place - dot(normal, middle()));
  };
  const tip = () => plus(foot(), cut.planes()[0].normal, size());

  // along a line from p in the direction u, what is nearest to what a pixel sees; from where the line looks at the eye: up is away
  function along({ p, u, steep, from }, x, y) {
    if (steep) return ((from - y) * lens.perPixel()) / dot(u, lens.basis().forward);
    const { origin, direction } = lens.ray(x, y), d = unit(direction), w = plus(p, origin, -1), b = dot(u, d);
    return (b * dot(d, w) - dot(u, w)) / Math.max(1 - b * b, 1e-6);
  }
  function line(p, u, x, y) {
    const [px, py] = lens.project(p) ?? [x, y], d = unit(lens.ray(px, py).direction), axis = { p, u, steep: 1 - dot(u, d) ** 2 < STEEP, from: y };
    return { ...axis, begun: along(axis, x, y) };
  }

  const face = (k, end) => {
    const span = cut.high[k] - cut.low[k] || 1, limit = (x) => {
      const { box } = cut.state();
      return end ? Math.min(Math.max(x, box[2 * k] + THIN), 1) : Math.max(Math.min(x, box[2 * k + 1] - THIN), 0);
    };
    const to = (x) => cut.change({ box: cut.state().box.map((old, j) => (j === 2 * k + end ? limit(x) : old)) });
    const place = () => { const { box } = cut.state(); return at([0, 1, 2].map((j) => (j === k ? box[2 * k + end] : (box[2 * j] + box[2 * j + 1]) / 2))); };
    return {
      kind: 'box', place, name: () => `face ${letters?.[k][end] ?? 'xyz'[k]}`, value: () => cut.state().box[2 * k + end],
      hold(x, y) { const of = line(place(), cut.axes[k], x, y), old = cut.state().box[2 * k + end]; return (px, py) => to(old + (along(of, px, py) - of.begun) / span); },
      key(right, up) { to(cut.state().box[2 * k + end] + STEP * (right + up)); },
    };
  };
  const move = {
    kind: 'plane', place: foot, name: () => 'the plane', value: () => cut.state().at,
    hold(x, y) {
      const { normal, at: old } = cut.state(), [from, to] = cut.range(normal), of = line(foot(), normal, x, y);
      return (px, py) => cut.change({ at: Math.min(Math.max(old + (along(of, px, py) - of.begun) / (to - from || 1), 0), 1) });
    },
    key(right, up) { cut.change({ at: Math.min(Math.max(cut.state().at + STEP * (right + up), 0), 1) }); },
  };
  // another direction, through the same foot
  function turn(outward) {
    const p = foot(), normal = unit(outward.map((x) => sign() * x)), [from, to] = cut.range(normal);
    cut.change({ normal, at: Math.min(Math.max((dot(normal, p) - from) / (to - from || 1), 0), 1) });
  }
  const tilt = {
    kind: 'plane', place: tip, name: () => 'direction of the plane', value: () => 0,
    hold() {
      const p = foot(), r = size(), side = dot(plus(tip(), p, -1), lens.basis().forward) > 0 ? 1 : -1;  // of the ball: behind or before
      return (px, py) => {
        const { origin, direction } = lens.ray(px, py), d = unit(direction), w = plus(origin, p, -1), b = dot(d, w), root = b * b - dot(w, w) + r * r;
        turn(plus(plus(w, d, -b), d, root > 0 ? side * Math.sqrt(root) : 0));
      };
    },
    key(right, up) {
      const { right: x, up: y } = lens.basis(), n = cut.planes()[0].normal;
      turn(plus(plus(n, x, TURN * right), y, TURN * up));
    },
  };

  const all = [...[0, 1, 2].flatMap((k) => [face(k, 0), face(k, 1)]), tilt, move].map((handle) => {
    const group = element('g', { class: handle === tilt ? 'handle tilt' : 'handle', tabindex: 0, role: 'slider', 'aria-valuemin': 0, 'aria-valuemax': 1 });
    group.append(element('circle', { r: 20, fill: 'transparent' }), element('circle', { r: 7, fill: '#fc3', stroke: '#000', 'stroke-width': 1.5 }));
    svg.append(group);
    const point = (event) => { const box = svg.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
    group.addEventListener('pointerdown', (event) => {
      if (event.button || !event.isPrimary) return;
      event.preventDefault();
      event.stopPropagation();
      group.setPointerCapture(event.pointerId);
      group.focus({ focusVisible: false });
      held = { to: handle.hold(...point(event)), handle, moved: false };
    });
    group.addEventListener('pointermove', (event) => {
      if (held?.handle !== handle) return;
      if (!held.moved) cut.keep();
      held.moved = true;
      held.to(...point(event));
    });
    for (const name of ['pointerup', 'pointercancel']) group.addEventListener(name, () => { held = null; });
    group.addEventListener('keydown', (event) => {
      const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      if (!by) return;
      event.preventDefault();
      event.stopPropagation();
      cut.keep();
      handle.key(...by.map((x) => x * (event.shiftKey ? 5 : 1)));
    });
    return { ...handle, group };
  });

  const path = (points, closed = false) => (points.every(Boolean) && points.length ? `M${points.map((p) => p.map((x) => x.toFixed(1)).join(',')).join('L')}${closed ? 'Z' : ''}` : '');

  return {
    svg,
    draw(world) {
      ({ letters } = world);
      const { kind, box } = cut.state();
      svg.style.display = kind === 'none' ? 'none' : '';
      for (const { kind: of, group, place, name, value } of all) {
        const p = of === kind ? lens.project(place()) : null;
        group.style.display = p ? '' : 'none';
        if (!p) continue;
        group.setAttribute('transform', `translate(${p[0].toFixed(1)},${p[1].toFixed(1)})`);
        group.setAttribute('aria-label', name());
        group.setAttribute('aria-valuenow', value().toFixed(3));
      }
      outline.setAttribute('d', kind === 'box' ? EDGES.map((edge) => path(edge.map((i) => lens.project(corners(box)[i])))).join('') : kind === 'plane' ? path(sectionOf(corners(WHOLE), cut.planes()[0]).points.map(lens.project), true) : '');
      stem.setAttribute('d', kind === 'plane' ? path([foot(), tip()].map(lens.project)) : '');
    },
  };
}
