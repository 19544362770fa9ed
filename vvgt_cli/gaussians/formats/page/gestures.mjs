// What one pointer, two fingers and the wheel do over a slice.
const STILL = 6, TWICE = 500;  // px that a click stays within; milliseconds between two of them

// click(x, y), twice(x, y); drag(x, y, begins): so far from where it began; move(x, y): by; zoom(times, x, y, from): so that what was at another pixel is there; step(by); hover(x, y), left()
export function gesturesOf(canvas, { click, twice, drag, move, zoom, step, hover, left }) {
  const held = new Map();
  let kind = '', from = [0, 0], last = { time: -TWICE, at: [0, 0] };
  const far = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]), still = (at) => far(at, from) < STILL;
  const middle = () => { const all = [...held.values()]; return [0, 1].map((c) => all.reduce((sum, at) => sum + at[c], 0) / all.length); };
  const apart = () => far(...held.values());

  canvas.addEventListener('pointerdown', (event) => {
    if (event.button > 2 || held.size > 1) return;
    canvas.setPointerCapture(event.pointerId);
    from = [event.offsetX, event.offsetY];
    held.set(event.pointerId, from);
    kind = held.size > 1 || event.button || event.shiftKey ? 'move' : 'press';
  });
  canvas.addEventListener('pointermove', ({ pointerId, offsetX: x, offsetY: y }) => {
    if (!held.size) return hover(x, y);
    if (!held.has(pointerId)) return;
    const two = held.size > 1, [old, wide] = [middle(), two && apart()];
    held.set(pointerId, [x, y]);
    const now = middle();
    if (two) return zoom(apart() / Math.max(wide, 1), ...now, old);
    if (kind === 'move') return move(now[0] - old[0], now[1] - old[1]);
    const begins = kind === 'press';
    if (begins && still([x, y])) return;
    kind = 'drag';
    drag(x - from[0], y - from[1], begins);
  });
  const end = ({ pointerId }) => { held.delete(pointerId); };  // the finger that is left moves on
  canvas.addEventListener('pointerup', (event) => {
    end(event);
    if (kind !== 'press') return;
    kind = '';
    const now = { time: event.timeStamp, at: from };
    click(...from);
    if (now.time - last.time < TWICE && far(now.at, last.at) < STILL) twice(...from);
    last = now;
  });
  canvas.addEventListener('pointercancel', end);
  canvas.addEventListener('pointerleave', () => { if (!held.size) left(); });
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    if (event.ctrlKey || event.metaKey) zoom(Math.exp(-event.deltaY / 300), event.offsetX, event.offsetY);  // of a touch pad: a pinch
    else step(event.deltaY < 0 ? 1 : -1);
  }, { passive: false });
}
