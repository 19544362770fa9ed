// The picture as a PNG: what the engine draws, and the drawing over it.
async function drawingOf(svg, scale) {
  const copy = svg.cloneNode(true), { width, height } = svg.getBoundingClientRect();
  for (const [key, value] of Object.entries({ xmlns: 'http://www.w3.org/2000/svg', width: width * scale, height: height * scale, viewBox: `0 0 ${width} ${height}` })) copy.setAttribute(key, value);
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

// a PNG of `size`, [wide, high]; one frame is drawn so large, and the viewer gives the canvas its own size in the next one
export async function pictureOf({ app }, svg, size) {
  const { graphicsDevice: { canvas: source, gl } } = app, picture = document.createElement('canvas'), context = picture.getContext('2d');
  const [wide, high] = size ?? [source.width, source.height];
  const enlarge = () => { if (source.width !== wide || source.height !== high) [source.width, source.height] = [wide, high]; };  // after the viewer's
  const tooLarge = () => new Error(`this browser cannot draw ${wide} × ${high} px: choose a smaller picture`);
  app.once('framerender', enlarge);
  await new Promise((done, fail) => {
    app.once('frameend', () => {  // later the engine's picture is gone
      app.renderNextFrame = true;
      if (gl.drawingBufferWidth !== wide || gl.drawingBufferHeight !== high) return fail(tooLarge());
      [picture.width, picture.height] = [wide, high];
      context.fillRect(0, 0, wide, high);
      context.drawImage(source, 0, 0);
      return done();
    });
    app.renderNextFrame = true;
  });
  context.drawImage(await drawingOf(svg, wide / source.clientWidth), 0, 0, wide, high);
  const blob = await new Promise((done) => picture.toBlob(done, 'image/png'));
  if (!blob) throw tooLarge();
  return blob;
}

// this page as its file was, but that it begins with `link`
export function pageOf(source, link) {
  const said = source.getElementById('said'), scene = source.getElementById('scene');
  said.textContent = said.dataset.without ?? said.textContent;
  scene.textContent = JSON.stringify({ ...JSON.parse(scene.textContent), link }).replaceAll('<', '\\u003c');  // so that no name can end the script
  return new Blob([`<!doctype html>\n${source.documentElement.outerHTML}\n`], { type: 'text/html' });
}

export function save(blob, name) {
  const link = document.createElement('a');
  [link.href, link.download] = [URL.createObjectURL(blob), name];
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
