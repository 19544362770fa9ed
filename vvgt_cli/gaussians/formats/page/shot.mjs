// The picture as a PNG: what the engine draws, and the drawing over it.
async function drawingOf(svg, scale) {
  const copy = svg.cloneNode(true), { width, height } = svg.getBoundingClientRect();
  for (const [key, value] of Object.entries({ xmlns: 'http://www.w3.org/2000/svg', width: width * scale, height: height * scale, viewBox: `0 0 ${width} ${height}` })) copy.setAttribute(key, value);
  const image = new Image();
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(new XMLSerializer().serializeToString(copy))}`;
  await image.decode();
  return image;
}

export async function pictureOf({ app }, svg) {
  const source = app.graphicsDevice.canvas, picture = document.createElement('canvas'), context = picture.getContext('2d');
  await new Promise((done) => {
    app.once('frameend', () => {  // later the engine's picture is gone
      [picture.width, picture.height] = [source.width, source.height];
      context.fillRect(0, 0, picture.width, picture.height);
      context.drawImage(source, 0, 0);
      done();
    });
    app.renderNextFrame = true;
  });
  context.drawImage(await drawingOf(svg, source.width / source.clientWidth), 0, 0, picture.width, picture.height);
  return new Promise((done) => picture.toBlob(done, 'image/png'));
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
