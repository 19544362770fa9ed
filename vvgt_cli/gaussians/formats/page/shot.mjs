// The picture as a PNG: what the engine draws, and the drawing over it.
import { label } from './svg.mjs';

async function drawingOf(svg, scale, under) {
  const copy = svg.cloneNode(true), { width, height } = svg.getBoundingClientRect();
  for (const [key, value] of Object.entries({ xmlns: 'http://www.w3.org/2000/svg', width: width * scale, height: height * scale, viewBox: `0 0 ${width} ${height}` })) copy.setAttribute(key, value);
  if (under) copy.append(label(under, width / 2, height - 5, { 'font-size': 11, 'text-anchor': 'middle', opacity: 0.8 }));
  const image = new Image();
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(new XMLSerializer().serializeToString(copy))}`;
  await image.decode();
  return image;
}

// [wide, high] of the pictures that this browser can draw: the window's, twice and four times as large
export function sizesOf({ graphicsDevice: { gl, canvas } }) {
  const most = Math.min(gl.getParameter(gl.MAX_TEXTURE_SIZE), gl.getParameter(gl.MAX_RENDERBUFFER_SIZE), ...gl.getParameter(gl.MAX_VIEWPORT_DIMS));
  return [1, 2, 4].map((times) => [times * canvas.width, times * canvas.height]).filter((size, k) => !k || Math.max(...size) <= most);
}

// one after the other, as each changes the canvas
let last = Promise.resolve();
const alone = (task) => (last = last.catch(() => {}).then(task));
const sized = (canvas, [wide, high]) => { if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high]; };

// a canvas with what the engine draws at a `size`, [wide, high]; the viewer gives its own canvas the window's size in the next frame
async function drawn(app, size) {
  const { canvas: source, gl } = app.graphicsDevice, picture = document.createElement('canvas'), context = picture.getContext('2d');
  app.once('framerender', () => sized(source, size));  // after the viewer's
  await new Promise((done, fail) => {
    app.once('frameend', () => {  // later the engine's picture is gone
      app.renderNextFrame = true;
      if (gl.drawingBufferWidth !== size[0] || gl.drawingBufferHeight !== size[1]) return fail(tooLarge(size));
      sized(picture, size);
      context.fillRect(0, 0, ...size);
      context.drawImage(source, 0, 0);
      return done();
    });
    app.renderNextFrame = true;
  });
  return picture;
}
const tooLarge = (size) => new Error(`this browser cannot draw ${size.join(' × ')} px: choose a smaller picture`);

// a PNG of `size`, by default the window's, of the volume itself where that is shown, with a line `under` it
export const pictureOf = ({ app }, svg, size, look, under = '') => alone(async () => {
  const { canvas } = app.graphicsDevice, all = size ?? [canvas.width, canvas.height], picture = await (look?.shows ? look.picture(all) : drawn(app, all));
  picture.getContext('2d').drawImage(await drawingOf(svg, all[0] / canvas.clientWidth, under), 0, 0, ...all);
  const blob = await new Promise((done) => picture.toBlob(done, 'image/png'));
  if (!blob) throw tooLarge(all);
  return blob;
});

// this page as its file was, but that it begins with `link`
export function pageOf(source, link) {
  const said = source.getElementById('said'), scene = source.getElementById('scene');
  said.textContent = said.dataset.without ?? said.textContent;
  scene.textContent = JSON.stringify({ ...JSON.parse(scene.textContent), link }).replaceAll('<', '\\u003c');  // so that no name can end the script
  return new Blob([`<!doctype html>\n${source.documentElement.outerHTML}\n`], { type: 'text/html' });
}
