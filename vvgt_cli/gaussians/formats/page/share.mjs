// Sharing: the picture and a link in the clipboard, the system's sheet, the code of a frame. Where a thing is not allowed, a line says what works.
import { listed } from './keys.mjs';
import { copied } from './link.mjs';

const FRAME = 'sandbox="allow-scripts allow-downloads" allow="fullscreen; clipboard-write; web-share; xr-spatial-tracking" style="width: 100%; height: 540px; border: 0"';
const escaped = (text) => text.replace(/[&"<]/g, (c) => ({ '&': '&amp;', '"': '&quot;', '<': '&lt;' })[c]);

// link(): to what is seen; picture(): promise of a PNG; name(): of its file; say(text): a line. {root, of, toggle: as of a panel, link(): copies it}
export function sharing({ link, picture, name, say }) {
  const panel = listed('share', 'Share'), box = panel.root.lastChild, framed = parent !== window, about = location.protocol === 'about:';
  let timer = 0;
  const tell = (text) => {
    say(text);
    clearTimeout(timer);
    timer = setTimeout(say, 6000);
  };
  const copy = (text, what, otherwise) => tell(copied(text) ? `${what} copied` : otherwise);

  async function copyPicture() {
    try {
      await navigator.clipboard.write([new ClipboardItem({ 'image/png': picture() })]);
      tell('picture copied');
    } catch { tell(`this ${framed ? 'frame' : 'browser'} is not allowed to copy pictures: save one (p) instead`); }
  }
  function copyLink() {
    if (about) return tell('this frame has no address: save the page, and link to that');
    try { history.replaceState(null, '', link()); } catch { /* a frame without an address of its own */ }
    copy(link(), 'link to this view', framed ? 'this frame is not allowed to copy a link' : 'the address bar now links to this view');
  }
  function copyFrame() {
    if (about) return tell('this frame has no address: save the page, and put that into a frame');
    const file = location.protocol === 'file:', src = file ? link().replace(/^[^#]*\//, '') : link();
    copy(`<iframe src="${escaped(src)}" title="${escaped(document.title)}" ${FRAME}></iframe>`, file ? 'code of a frame, for a site that has this file beside its page,' : 'code of a frame', `this ${framed ? 'frame' : 'browser'} is not allowed to copy: ${framed ? 'open the page in a tab of its own' : 'copy the link (l), for the src of a frame'}`);
  }
  // what the system's sheet takes of the picture and the address
  async function share() {
    const data = /^https?:/.test(location.protocol) ? { title: document.title, url: link() } : { title: document.title };
    try {
      const files = [new File([await picture()], `${name()}.png`, { type: 'image/png' })];
      await navigator.share(navigator.canShare?.({ ...data, files }) ? { ...data, files } : data);
    } catch (error) { if (error.name !== 'AbortError') tell(`sharing is not allowed here: ${about ? 'save the picture (p)' : 'copy the link (l) or save the picture (p)'}`); }
  }
  for (const [key, title, press] of [['picture', 'copy the picture', copyPicture], ['address', 'copy the link', copyLink], ['frame', 'copy the code of a frame', copyFrame], ['sheet', 'share …', share]]) {
    const made = Object.assign(document.createElement('button'), { className: key, textContent: title });
    made.addEventListener('click', press);
    box.append(made);
  }
  document.body.append(panel.root);
  const toggle = () => {
    box.lastChild.hidden = !navigator.share;
    panel.toggle();
  };
  return { ...panel, toggle, link: copyLink };
}
