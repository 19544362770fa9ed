// Whether what a page holds is whole.
const BYTES = { char: 1, uchar: 1, short: 2, ushort: 2, int: 4, uint: 4, float: 4, double: 8 };

export class Damaged extends Error {}

// of a .ply: as many bytes as its header says
export function wholePly(bytes) {
  const text = new TextDecoder('latin1').decode(bytes.subarray(0, 1 << 18)), end = text.indexOf('end_header\n');
  if (!text.startsWith('ply\n') || end < 0) return false;
  let size = end + 11, count = 0;
  for (const line of text.slice(0, end).split('\n')) {
    const [word, kind, number] = line.split(/\s+/);
    if (word === 'element') count = Number(number);
    else if (word === 'property') size += count * BYTES[kind];
  }
  return bytes.length === size;
}

// what `promise` gives, unless an asset or anything else fails before
export function unlessFailing(app, promise) {
  return new Promise((done, fail) => {
    const failed = () => { end(); fail(new Damaged('its Gaussians could not be read')); };
    const end = () => { app.assets.off('error', failed); removeEventListener('unhandledrejection', failed); };
    app.assets.on('error', failed);
    addEventListener('unhandledrejection', failed);
    promise.then((value) => { end(); done(value); }, fail);
  });
}
