// Files that are saved; in a frame, which may forbid downloads without a word, they are offered in other ways, too.
import { listed } from './keys.mjs';
import { copied } from './link.mjs';

let offered = null;

function offer(blob, name, url) {
  if (!offered) document.body.append((offered = listed('saved', 'Saved?')).root);
  const { root } = offered, line = Object.assign(document.createElement('p'), { textContent: `${name}: if nothing was saved, this frame forbids downloads.` });
  line.setAttribute('role', 'status');
  const button = (text, press) => {
    const made = Object.assign(document.createElement('button'), { textContent: text });
    made.addEventListener('click', () => Promise.resolve().then(press).then((done) => { line.textContent = done; }, () => { line.textContent = `this frame forbids to ${text}, too`; }));
    return made;
  };
  const open = () => {
    if (!window.open(url)) throw new Error('no new window');
    return 'opened';
  };
  const copy = async () => {
    if (blob.type === 'image/png') await navigator.clipboard.write([new ClipboardItem({ [blob.type]: blob })]);
    else if (!copied(await blob.text())) throw new Error('no clipboard');
    return 'copied';
  };
  const picture = blob.type === 'image/png' ? [Object.assign(new Image(), { src: url, alt: name, title: 'copy by a right click or a long press' })] : [];
  root.lastChild.replaceChildren(line, button('copy', copy), button('open', open), Object.assign(button('close', () => ''), { onclick: offered.close }), ...picture);
  if (root.hidden) offered.toggle();
}

export function save(blob, name) {
  const link = document.createElement('a');
  [link.href, link.download] = [URL.createObjectURL(blob), name];
  link.click();
  if (parent !== window) return offer(blob, name, link.href);
  return setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
