// Letters of the file's axes, which turn with the view, and views along them.
import { dot } from './lens.mjs';
import { element, label } from './svg.mjs';

export const COLORS = ['#ff9d8a', '#9be08a', '#9ac4ff'];  // of the axes of the world
const RADIUS = 30;
const HIDDEN = 0.45;  // projected length below which the end that looks away is covered by the other

export function drawLetters(group, { lens, world, left, high }) {
  const { right, up, forward } = lens.basis(), middle = [left + RADIUS + 12, high - 28 - RADIUS], ends = [];
  world.axes.forEach((axis, k) => {
    for (const sign of [-1, 1]) {
      const [x, y, far] = [right, up, forward].map((of) => sign * dot(of, axis));
      ends.push({ letter: world.letters[k][sign < 0 ? 0 : 1], x, y, far, color: COLORS[k], seen: far < 0 || Math.hypot(x, y) > HIDDEN });
    }
  });
  group.append(element('rect', { x: left, y: high - 100, width: 84, height: 84, fill: 'none' }));  // as large from every side
  ends.sort((a, b) => b.far - a.far);
  const seen = ends.filter((end) => end.seen), short = 0.6 * RADIUS, opacity = ({ far }) => (0.75 - 0.25 * far).toFixed(2);
  group.append(...seen.map((end) => element('line', { x1: middle[0], y1: middle[1], x2: middle[0] + short * end.x, y2: middle[1] - short * end.y, stroke: end.color, 'stroke-width': 2, opacity: opacity(end) })));
  group.append(...seen.map((end) => label(end.letter, middle[0] + RADIUS * end.x, middle[1] - RADIUS * end.y + 5, { fill: end.color, opacity: opacity(end), 'text-anchor': 'middle', 'font-weight': 700, 'font-size': 14 })));
  return seen.map(({ letter, x, y }) => ({ letter, x, y }));
}

// Front, left and top, and the letter of the side that each is seen from: [name, axis, sign]
export function sides({ letters, anatomical }) {
  const towards = (letter, otherwise) => {
    const k = letters.findIndex((pair) => pair.includes(letter));
    return anatomical ? [k, letters[k][0] === letter ? -1 : 1] : otherwise;
  };
  return [['front', ...towards('A', [1, -1])], ['left', ...towards('L', [0, -1])], ['top', ...towards('S', [2, 1])]];
}

// The angles of the view from one end of an axis
export function seenFrom(lens, world, axis, sign) {
  const from = world.axes[axis].map((x) => sign * x);
  const [, front, facing] = sides(world)[0], ahead = world.axes[front].map((x) => (world.anatomical ? facing : -facing) * x);
  return lens.toward(from, axis === front ? world.axes[2] : ahead);
}
