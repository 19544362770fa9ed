// What is shown: a list of names and values, of what the file says of itself.
import { shown } from './facts.mjs';

export function rowsOf(name, { facts, world, count, live }) {
  const number = (n) => n.toLocaleString('en'), length = (n) => `${shown(n)}${world.unit && ` ${world.unit}`}`;
  const kinds = new Set(live?.layers.map(({ labels }) => (labels.length ? 'labels' : 'function')));
  return [
    ['file', name],
    ['look', live ? `live: ${[...kinds, 'light'].join(' and ')} can be changed` : 'baked'],
    ['function', live ? live.layers.map(({ name }) => name).filter(Boolean).join('; ') : facts.function],
    ['opacity per', facts['unit-distance'] && `${length(facts['unit-distance'])} (${facts.label})`],
    ['light', live ? null : facts.light],
    ['error', facts.error],
    ['Gaussians', number(count)],
    ['made for', facts.size && `${facts.size} px, drawn by ${facts.rule}`],
    ['axes', world.anatomical ? `${facts.space}, in mm` : `of the file${world.unit && `, in ${world.unit}`}`],
    ['written', facts.version && `${facts.date ? `${facts.date}, ` : ''}by vvgt ${facts.version}`],
  ].filter(([, value]) => value);
}

export function fill(list, rows) {
  list.replaceChildren(...rows.flatMap(([key, value]) => {
    const [term, text] = [document.createElement('dt'), document.createElement('dd')];
    [term.textContent, text.textContent] = [key, value];
    return [term, text];
  }));
}
