// What is shown: a list of names and values, of what the file says of itself.
import { shown } from './facts.mjs';

export function rowsOf(name, { facts, world, count, live, converted, slices }) {
  const number = (n) => n.toLocaleString('en'), length = (n) => `${shown(n)}${world.unit && ` ${world.unit}`}`;
  const kinds = new Set(live?.layers.map(({ labels }) => (labels.length ? 'labels' : 'function')));
  return [
    ['name', name],
    ['contains', [`Gaussians${kinds.has('function') ? ', the data values under them and their histogram' : ''}`, ...(kinds.has('labels') ? ['names of labels'] : []), ...(slices ? ['slices of the volume'] : []), ...(facts.quality ? ['a checksum of the volume'] : [])].join(', ')],
    ['look', live ? `${[...kinds, 'light'].join(' and ')} can be changed` : 'fixed'],
    ['function', live ? live.layers.map(({ name }) => name).filter(Boolean).join('; ') : facts.function],
    ['opacity per', facts['unit-distance'] && `${length(facts['unit-distance'])} (${facts.label})`],
    ['light', live ? null : facts.light?.replace(/^(\S+) (\S+) (\S+) (\S+) (.*)/, '$5; ambient $1, diffuse $2, gloss $3')],
    ['quality', facts.quality],
    ['Gaussians', count && (converted ? `${number(converted.count)}, and ${number(count)} for other looks` : number(count))],
    ['made for', facts.size && `screens of ${facts.size} px; drawing rule: ${facts.rule}`],
    ['axes', world.anatomical ? `${facts.space}, in mm` : `the file's own${world.unit && `, in ${world.unit}`}`],
    ['drawn with', 'SuperSplat viewer and PlayCanvas engine (MIT)'],
    ['written by', facts.version && `vvgt ${facts.version}`],
  ].filter(([, value]) => value);
}

export function fill(list, rows) {
  list.replaceChildren(...rows.flatMap(([key, value]) => {
    const [term, text] = [document.createElement('dt'), document.createElement('dd')];
    [term.textContent, text.textContent] = [key, value];
    return [term, text];
  }));
}

// A line over the picture that can be closed: {root, say(text), close}
export function notice() {
  const root = Object.assign(document.createElement('aside'), { id: 'notice', hidden: true, innerHTML: '<p></p><button aria-label="close the notice" title="close (Esc)">✕</button>' });
  root.setAttribute('aria-label', 'quality');
  let closed = false;
  const say = (text) => {
    root.firstChild.textContent = text;
    root.hidden = closed || !text;
  }, close = () => { closed = true; say(''); };
  root.lastChild.addEventListener('click', close);
  return { root, say, close };
}
