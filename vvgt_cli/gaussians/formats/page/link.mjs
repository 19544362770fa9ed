// A link that restores what is seen: #story=...&step=...&marks=...&slices=...&view=...&projection=...&frame=...&function=...&cut=...&light=...&labels=..., of a second layer function-1 or labels-1. Parts are {key, get, set} of text,
// which is '' for what the page begins with.
const number = (x, digits = 6) => String(Number(x.toFixed(digits)));

// the distance is that of a square picture: times(angles) as far in the window as it is, for as much to be seen beside the panels
export function viewParts(lens, times) {
  return [
    { key: 'projection', get: () => (lens.flat ? 'orthographic' : ''), set: (text) => { lens.flat = text === 'orthographic'; } },
    {
      key: 'view',
      get: () => {
        const { target, pitch, yaw, distance } = lens.pose();
        return [...target, pitch, yaw, distance / times({ pitch, yaw })].map((x) => number(x)).join(',');
      },
      set: (text) => {
        const [x, y, z, pitch, yaw, distance] = text.split(',').map(Number);
        if ([x, y, z, pitch, yaw, distance].every(Number.isFinite) && distance > 0) lens.set({ target: [x, y, z], pitch, yaw, distance: distance * times({ pitch, yaw }) });
      },
    },
  ];
}

export function frameParts(show) {
  const list = () => document.querySelector('#series select');
  return [{ key: 'frame', get: () => (list().selectedIndex > 0 ? String(list().selectedIndex) : ''), set: (text) => { if (list().options[Number(text)]) return show(Number(text)); } }];
}

// light, labels: what the panel goes back to by undo, as JSON; of labels the rows that are as in the file are left out
function stateOf({ key, state, set, text: own, read }) {
  if (own) return { key, get: own, set: (text) => set(read(text)) };
  const begun = state(), written = (now) => JSON.stringify(now, (name, value) => (typeof value === 'number' ? Number(value.toFixed(4)) : value));
  const short = ({ rows, solo }) => ({ rows: rows.map((row, k) => [k, row]).filter(([k, row]) => written(row) !== written(begun.rows[k])), solo });
  const long = ({ rows, solo }) => ({ rows: begun.rows.map((row, k) => ({ ...row, ...(rows.find(([j]) => j === k)?.[1] ?? {}) })), solo });
  return {
    key,
    get: () => (written(state()) === written(begun) ? '' : encodeURIComponent(written(begun.rows ? short(state()) : state()))),
    set: (text) => {
      const then = text ? JSON.parse(text) : null;
      set(!then ? begun : begun.rows ? long(then) : { ...begun, ...then });
    },
  };
}

export const liveParts = (live) => live.parts.map(stateOf);

export const saidBy = (parts) => parts.map(({ key, get }) => [key, get()]).filter(([, text]) => text).map(([key, text]) => `${key}=${text}`).join('&');
export const linkOf = (parts) => `${location.href.split('#')[0]}#${saidBy(parts)}`;

// whether a text is in the clipboard now; the clipboard's own interface is refused to most frames
export function copied(text) {
  const area = Object.assign(document.createElement('textarea'), { value: text }), back = document.activeElement;
  document.body.append(area);
  area.focus({ preventScroll: true });
  area.select();
  const done = document.execCommand('copy');
  area.remove();
  back?.focus({ preventScroll: true });
  return done;
}

// the texts of a link's parts by their keys
export const partsOf = (link) => new Map(link.split('&').map((part) => [part.split('=')[0], decodeURIComponent(part.slice(part.indexOf('=') + 1))]));

export async function put(parts, said) {
  for (const { key, get, set } of parts) {
    const text = said.get(key) ?? '';
    if (text !== decodeURIComponent(get())) await Promise.resolve(text).then(set).catch(() => {});  // a damaged part is left as it is
  }
}

// what the address says, else what a saved page begins with; returns whether there is any
export async function restore(parts, begins = '') {
  let said;
  try {
    const hash = location.hash.slice(1), plain = hash.includes('=') ? hash : decodeURIComponent(hash);  // some programs encode a link whole
    said = partsOf(/(^|&)view=/.test(plain) ? plain : begins);
  } catch { return false; }  // not a link of ours
  if (said.has('view')) await put(parts, said);
  return said.has('view');
}
