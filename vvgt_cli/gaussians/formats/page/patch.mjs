// A frame of a series as what differs from another's bytes: runs, each with its place and length before it.
export function patched(bytes, patch) {
  const view = new DataView(patch.buffer, patch.byteOffset, patch.byteLength);
  for (let at = 0; at < patch.length;) {
    const place = view.getUint32(at, true), length = view.getUint32(at + 4, true);
    bytes.set(patch.subarray(at + 8, at + 8 + length), place);
    at += 8 + length;
  }
  return bytes;
}
