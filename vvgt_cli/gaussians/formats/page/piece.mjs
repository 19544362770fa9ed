// "Keep this piece": of a volume of values, what is connected to the voxel that is clicked; the rest is not drawn.
const AT_ONCE = 1 << 17, AROUND = 2, MARGIN = 2, PART = 0.5;  // voxels between two pauses; in which one that shows is sought, and that are kept around; of the extinction where one clicks: what connects

// a mask (255: kept) of a grid {codes, dims} from voxel `first` on, through codes that `seen` has; and `MARGIN` voxels around that it has not. `pause()` resolves to whether to go on; null: it is not to
export async function connected({ codes, dims: [nx, ny, nz] }, first, seen, pause) {
  const mask = new Uint8Array(codes.length), queue = new Int32Array(codes.length), sheet = nx * ny;
  let end = 1, at = 0, last = 0;
  [queue[0], mask[first]] = [first, 255];
  for (let round = 0; round <= MARGIN; round++) {
    const want = round ? 0 : 1;
    for (at = round > 1 ? last : 0, last = end; at < (round ? last : end); at++) {
      if (at % AT_ONCE === AT_ONCE - 1 && !await pause()) return null;
      const i = queue[at], x = i % nx, y = Math.floor(i / nx) % ny, z = Math.floor(i / sheet);
      const put = (j) => { if (!mask[j] && seen[codes[j]] === want) [mask[j], queue[end++]] = [255, j]; };
      if (x > 0) put(i - 1);
      if (x < nx - 1) put(i + 1);
      if (y > 0) put(i - nx);
      if (y < ny - 1) put(i + nx);
      if (z > 0) put(i - sheet);
      if (z < nz - 1) put(i + sheet);
    }
  }
  return mask;
}

// the voxel near an index that a function of codes is greatest at
export function nearest({ codes, dims }, index, of) {
  let best = -1, most = 0;
  const [xs, ys, zs] = index.map((x, c) => Array.from({ length: 2 * AROUND + 1 }, (_, k) => Math.round(x) + k - AROUND).filter((k) => k >= 0 && k < dims[c]));
  for (const z of zs) for (const y of ys) for (const x of xs) {
    const i = x + dims[0] * (y + dims[1] * z), here = of(codes[i]);
    if (here > most) [best, most] = [i, here];
  }
  return [best, most];
}

// The row of the panel; `history` as light.mjs has it. take(place), while `wants`: what is clicked
export function piece(look, history) {
  const root = document.createElement('div');
  root.innerHTML = '<button class="keep" aria-pressed="false" title="then click a part of the picture: what it is not connected to is hidden">keep a piece</button><button class="whole" hidden>show all</button><span role="status"></span>';
  const [keep, whole, status] = root.children;
  let now = null, wants = false, asked = 0;  // now: {at: index of the voxel, least: extinction}
  const say = (text) => { status.textContent = text; };

  function want(is) {
    wants = is;
    keep.setAttribute('aria-pressed', String(is));
    say(is ? 'click what stays' : '');
  }
  async function set(then) {
    const mine = ++asked;
    now = then;
    whole.hidden = !then;
    history.changed(true);
    if (!then) { say(''); return look.keep(null); }
    say('searching …');
    await look.keep(then, () => mine === asked);
    if (mine === asked) say('');
    return undefined;
  }
  keep.addEventListener('click', () => want(!wants));
  whole.addEventListener('click', () => { history.keep(); want(false); set(null); keep.focus(); });
  const part = {
    key: 'piece', state: () => now, set,
    text: () => (now ? [...now.at, Number(now.least.toPrecision(6))].join(',') : ''),
    read(text) {
      const [x, y, z, least] = text.split(',').map(Number);
      if (text && ![x, y, z, least].every((one) => one >= 0)) throw new Error('not a piece');
      return text ? { at: [x, y, z], least } : null;
    },
  };
  history.add(part);
  return {
    root, part,
    get wants() { return wants; },
    take(place) {
      const seed = place && look.seedAt(place.place);
      if (!seed) return say('nothing there: click what stays');
      want(false);
      history.keep();
      return set({ at: seed.at, least: PART * seed.tau });
    },
  };
}
