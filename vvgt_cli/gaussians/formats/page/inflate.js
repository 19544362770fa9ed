// In a page that is one file, the viewer's program is packed; it becomes a script. What the file holds is kept for saving it again.
(async () => {
  const style = document.querySelector('style');  // within its document it would be cloned while empty, which a policy of hashes reports
  style.remove();
  window.vvgtSource = document.cloneNode(true);
  for (const one of [document, window.vvgtSource]) one.head.append(style.cloneNode(true));
  const text = atob(document.getElementById('program').textContent), packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('gzip'));
  const script = document.createElement('script');
  script.textContent = await new Response(stream).text();
  document.addEventListener('securitypolicyviolation', ({ effectiveDirective: what }) => {
    if (what.startsWith('script')) document.getElementById('said').textContent = 'The content security policy of the site blocks the 3D view: it has hashes of another version.';
  });
  document.getElementById('program').remove();
  document.body.append(script);
})().catch((error) => { document.getElementById('said').textContent = `This browser cannot show the 3D view: ${error}`; });
