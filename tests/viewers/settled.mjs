// Cameras and patience for the pages. Splats are sorted in a worker, late under software rendering.
const pause = (ms) => new Promise((done) => setTimeout(done, ms));

/**
 * A picture (data URL) that has stopped changing: `place(shift)` puts the camera `shift` along its right from where it
 * belongs, `shot()` resolves to a picture, `sorted()` says whether no sort is known to be on its way.
 */
export async function settled(place, shot, sorted) {
  const end = Date.now() + 600000;
  place(0.05);  // a nudge: an order that is there already is made anew
  await shot();
  place(0);
  await shot();
  let last = '', same = 0;
  while (same < 3) {
    if (Date.now() > end) throw new Error('pictures still change after ten minutes');
    const begin = Date.now();
    const now = await shot();
    same = sorted() && now === last ? same + 1 : 0;
    last = now;
    await pause(Math.max(400, Date.now() - begin));  // on a busy machine the worker is late by as much as a picture
  }
  return last;
}

/**
 * Position and right, up, back (the axes of an OpenGL camera) of a world-to-camera pose (OpenCV axes), `shift` to the right;
 * without a pose, at z = 3, y up.
 */
export function axes(pose, shift) {
  if (!pose) return { position: [shift, 0, 3], right: [1, 0, 0], up: [0, 1, 0], back: [0, 0, 1] };
  const { rotation: r, translation: t } = pose;
  const position = [0, 1, 2].map((i) => shift * r[0][i] - (r[0][i] * t[0] + r[1][i] * t[1] + r[2][i] * t[2]));
  return { position, right: r[0], up: r[1].map((x) => -x), back: r[2].map((x) => -x) };
}
