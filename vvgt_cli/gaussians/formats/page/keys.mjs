// Keys of the page, and the panel that lists them with what mouse and fingers do.
import { fill } from './about.mjs';

const TURN = 5, STEP = 24, NEARER = 1.1;  // degrees, pixels and times of a key
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const FIELDS = 'input, select, textarea', OWN = `${FIELDS}, #live, #slices, .listed, .handle`;  // what has keys, or arrows, of its own

// rows of the help: [keys, what]; `buttons` are {title, key}
export function helpRows(buttons, { live, values, picks, sliced }) {
  return [
    ['drag', 'turn'], ['right drag, two fingers', 'move'], ['wheel, pinch', 'zoom'],
    ...(picks ? [['click', `show the position${live ? ' and the value or label' : ''} there`], ['Enter', 'click in the middle of the view'], ['double click', 'turn about that point from now on']] : []),
    ['arrow keys', 'turn; with Shift: move'], ['+ −', 'zoom'],
    ...buttons.filter(({ key }) => key).map(({ title, key }) => [key.toUpperCase(), title]),
    ['Page Up and Down, swipe', 'previous and next step of a story'],
    ...(live?.next ? [['K', 'switch between colours, MIP and X-ray']] : []),
    ...(live ? [['Ctrl+Z, Ctrl+Y', 'undo, redo']] : []),
    ...(sliced ? [['in a slice', 'drag across for the window, up or down for the level; click to move the cross; wheel or arrow keys to step']] : []),
    ...(values ? [['function', 'drag a node or use the arrow keys; double click adds a node, Delete removes it. Drag beside the nodes to shift (across) or widen (up) the function; Page Up and Down shift it, with Shift widen it']] : []),
    ['Esc', 'close panels, clear the clicked point'],
  ];
}

// hides a section; the focus that is in it goes back
export function hide(root, back) {
  const inside = root.contains(document.activeElement);
  root.hidden = true;
  if (!inside) return;
  document.activeElement.blur();  // at once, for the next key
  back?.focus();
}

// {root, toggle()} of a panel of rows, or without them of what the caller puts there; of all of them one is open at a time
const panels = [];
export function listed(id, name, rows) {
  const root = Object.assign(document.createElement('section'), { id, className: 'listed', hidden: true, tabIndex: 0, innerHTML: `<h2></h2><${rows ? 'dl' : 'div'}></${rows ? 'dl' : 'div'}>` });
  root.firstChild.textContent = name;
  root.setAttribute('aria-label', name);
  let button = null, back = null;
  const show = (open) => {
    if (open) {
      back = document.activeElement;
      root.hidden = false;
      root.focus();
    } else hide(root, back);
    button?.setAttribute('aria-expanded', String(open));
  };
  const panel = {
    root, rows: (now) => fill(root.lastChild, now), close: () => show(false),
    of(element) { button = element; show(false); },
    toggle() {
      const open = root.hidden;
      panels.forEach((other) => other.close());
      show(open);
    },
  };
  panels.push(panel);
  if (rows) panel.rows(rows);
  return panel;
}

// act: {key: of an event}; moving(): after the camera has been moved
export function listen(lens, act, escape, moving) {
  const { canvas } = lens;
  addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented) return;
    const at = (selector) => event.target.closest?.(selector), arrow = !at(OWN) && ARROWS[event.key];
    if (event.key === 'Escape') { panels.forEach((panel) => panel.close()); escape(); }
    if (at(FIELDS)) return;
    const nearer = { '+': 1 / NEARER, '=': 1 / NEARER, '-': NEARER, '_': NEARER }[event.key];
    if (arrow && event.shiftKey) lens.move(...arrow.map((x) => STEP * x));
    else if (arrow) lens.orbit(...arrow.map((x) => TURN * x));
    else if (nearer) lens.orbit(0, 0, nearer);
    else return act[event.key.toLowerCase()]?.(event);
    event.preventDefault();
    moving();
  });
  canvas.addEventListener('pointerdown', () => canvas.focus({ focusVisible: false, preventScroll: true }));
}
