// The panels of a narrow or low window: tabs along its bottom edge, each of which opens one panel as a sheet beside the picture.
const SMALL = matchMedia('(max-width: 700px), (max-height: 480px)');

// parts: {name: {root: the panel, show(open)}}; look and cut are of one panel. Measuring goes on in slices, what else is open closes.
export function sheet(parts) {
  const root = Object.assign(document.createElement('nav'), { id: 'tabs' }), { body } = document, names = Object.keys(parts);
  root.setAttribute('aria-label', 'panels');
  root.append(...names.map((name) => Object.assign(document.createElement('button'), { textContent: name })));
  const shown = (name) => !parts[name].root.hidden && !parts[name].root.classList.contains('folded');
  let before = {};

  function tell() {
    const { tab } = body.dataset;
    names.forEach((name, k) => root.children[k].setAttribute('aria-expanded', String(name === tab)));
    dispatchEvent(new Event('resize'));  // the picture has another size
  }
  const noted = () => { before = Object.fromEntries(names.map((name) => [name, shown(name)])); };

  function choose(tab) {
    body.dataset.tab = tab;
    for (const name of names) {
      const open = name === tab || parts[name].root === parts[tab]?.root;
      if (shown(name) !== open && (open || name !== 'measure' || tab !== 'slices')) parts[name].show(open);
    }
    noted();
    tell();
  }

  // opened or closed otherwise: by keys, buttons and links
  const observer = new MutationObserver(() => {
    const { tab } = body.dataset, opened = names.find((name) => shown(name) && !before[name]);
    if (!SMALL.matches) return noted();
    if (opened) return choose(opened);
    if (tab && !shown(tab)) {
      const { activeElement } = document;
      choose('');
      if (activeElement === body || !activeElement.checkVisibility()) root.children[names.indexOf(tab)].focus({ preventScroll: true });
    }
    return noted();
  });
  for (const name of names) observer.observe(parts[name].root, { attributeFilter: ['hidden', 'class'] });
  names.forEach((name, k) => root.children[k].addEventListener('click', () => choose(body.dataset.tab === name ? '' : name)));
  SMALL.addEventListener('change', () => {
    const tab = SMALL.matches ? names.findLast((name) => name !== 'cut' && shown(name)) : '';
    choose(tab ?? '');
    if (!SMALL.matches) parts.look?.show(true);
  });
  choose('');
  if (!SMALL.matches) parts.look?.show(true);
  return root;
}
