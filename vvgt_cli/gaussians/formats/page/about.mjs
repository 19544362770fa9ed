// What is shown: a list of names and values, of what the file says of itself.
import { DIAGNOSIS, isMedical, shown } from './facts.mjs';
import { edgesOf, tiltOf } from './volume.mjs';

export function rowsOf(name, { facts, world, count, look, values }) {
  const number = (n) => n.toLocaleString('en'), length = (n) => `${shown(n)}${world.unit && ` ${world.unit}`}`;
  const affine = facts.affine?.split(/\s+/).map(Number), tilt = affine?.every(Number.isFinite) ? tiltOf({ affine, edges: edgesOf(affine) }) : 0;
  const kinds = new Set(look?.layers.map(({ labels }) => (labels.length ? 'labels' : 'function')));
  return [
    ['name', name],
    ['contains', ['Gaussians', ...(values ? ['values of the volume'] : []), ...(kinds.has('labels') ? ['names of labels'] : []), ...(facts.quality ? ['a checksum of the volume'] : [])].join(', ')],
    ['use', isMedical(world, values) && DIAGNOSIS],
    ['look', look ? `${[...kinds, 'light'].join(' and ')} can be changed` : 'fixed'],
    ['function', look ? look.layers.map(({ name }) => name).filter(Boolean).join('; ') : facts.function],
    ['opacity per', facts['unit-distance'] && `${length(facts['unit-distance'])} (${facts.label})`],
    ['light', look ? null : facts.light?.replace(/^(\S+) (\S+) (\S+) (\S+) (.*)/, '$5; ambient $1, diffuse $2, gloss $3')],
    ['quality', facts.quality],
    ['Gaussians', count && number(count)],
    ['made for', facts.size && `screens of ${facts.size} px; drawing rule: ${facts.rule}`],
    ['axes', `${world.anatomical ? `${facts.space}, in mm` : `the file's own${world.unit && `, in ${world.unit}`}`}${tilt ? `; the volume lies oblique, ${tilt}°` : ''}`],
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
