"""Style sheet and script of the page, without fonts, libraries or requests."""

CSS = """
:root{color-scheme:light dark;--paper:#fbfbfa;--card:#fff;--ink:#1c1f23;--soft:#5d656f;--line:#e3e5e8;
--k0:#0072b2;--k1:#a8527e;--k2:#00845f;--k3:#c05a00;--k4:#7a6a00;--k5:#333}
@media(prefers-color-scheme:dark){:root{--paper:#14171a;--card:#1c2024;--ink:#e8eaec;--soft:#9aa3ad;--line:#2e343a;
--k0:#56b4e9;--k1:#d995ba;--k2:#2fc79b;--k3:#f0954a;--k4:#d3c04a;--k5:#ddd}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);
font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
main{max-width:1240px;margin:0 auto;padding:28px 20px 60px}
h1{font-size:1.7rem;line-height:1.2;margin:0 0 .2em;overflow-wrap:anywhere}
h2{font-size:1.1rem;margin:0 0 .6em}
p{margin:.3em 0}.soft{color:var(--soft)}small{color:var(--soft)}
section{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:18px;margin-top:18px;min-width:0}
.facts{display:grid;grid-template-columns:repeat(auto-fit,minmax(170px,1fr));gap:12px;margin-top:18px}
.facts div{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:12px 16px}
.facts b{display:block;font-size:1.35rem;line-height:1.3;font-variant-numeric:tabular-nums}
.grid2{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,440px),1fr));gap:18px}
.grid2 section{margin-top:0}.grid2{margin-top:18px}
svg{display:block;width:100%;height:auto}svg text{font-family:inherit!important}
.scroll{overflow-x:auto}table{border-collapse:collapse;width:100%;font-size:.875rem;font-variant-numeric:tabular-nums}
th,td{padding:6px 10px;text-align:right;border-bottom:1px solid var(--line);white-space:nowrap}
th{color:var(--soft);font-weight:600}th:first-child,td:first-child{text-align:left}
tr.best td:first-child{font-weight:700}
code{display:block;background:var(--paper);border:1px solid var(--line);border-radius:6px;padding:10px 12px;
font:13px/1.5 ui-monospace,Menlo,Consolas,monospace;overflow-wrap:anywhere;white-space:pre-wrap}
dl{display:grid;grid-template-columns:max-content 1fr;gap:3px 16px;margin:12px 0 0;font-size:.9rem}
dt{color:var(--soft)}dd{margin:0;overflow-wrap:anywhere}
.tools{display:flex;flex-wrap:wrap;gap:10px 18px;align-items:center;margin-bottom:12px;font-size:.9rem}
select{font:inherit;color:inherit;background:var(--paper);border:1px solid var(--line);border-radius:6px;
padding:5px 8px;max-width:100%}
.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,300px),1fr));gap:16px}
figure{margin:0;min-width:0}figcaption{font-size:.875rem;color:var(--soft);margin-top:6px}
.stage{position:relative;aspect-ratio:1;background:#000;border-radius:8px;overflow:hidden}
.stage img{position:absolute;inset:0;width:100%;height:100%;object-fit:contain}
.wipe .ours{clip-path:inset(0 0 0 var(--at,50%))}
.wipe::after{content:"";position:absolute;top:0;bottom:0;left:var(--at,50%);width:2px;margin-left:-1px;background:#fff;
mix-blend-mode:difference}
.wipe input{position:absolute;inset:0;width:100%;height:100%;margin:0;opacity:0;cursor:ew-resize}
.wipe:focus-within{outline:3px solid var(--k0);outline-offset:2px}
.tag{position:absolute;top:8px;padding:1px 8px;border-radius:9px;background:#0009;color:#fff;font-size:.75rem}
.tag.l{left:8px}.tag.r{right:8px}
.gap{isolation:isolate}.gap .ours{mix-blend-mode:difference}
input[type=range]{accent-color:var(--k0)}
@media(max-width:560px){main{padding:18px 12px 40px}section{padding:14px 12px}h1{font-size:1.35rem}
.facts{grid-template-columns:1fr}
.facts b{font-size:1.1rem}dl{grid-template-columns:1fr;gap:0}dd{margin-bottom:6px}}
"""

SCRIPT = """
(() => {
  const data = JSON.parse(document.getElementById("images").textContent);
  const [run, view, gain] = ["run", "view", "gain"].map(name => document.getElementById(name));
  const set = (name, source) => document.querySelectorAll("img." + name).forEach(image => { image.src = source; });
  const show = () => {
    const ours = data.runs[run.value];
    set("reference", data.reference[view.value]);
    set("ours", ours.images[view.value]);
    document.getElementById("score").textContent = ours.scores[view.value];
    document.getElementById("ours-name").textContent = ours.name;
  };
  const slide = event => event.target.parentElement.style.setProperty("--at", event.target.value + "%");
  const brighten = () => {
    document.querySelector(".gap").style.filter = "brightness(" + gain.value + ")";
    document.getElementById("gain-value").textContent = gain.value;
  };
  run.addEventListener("change", show);
  view.addEventListener("change", show);
  document.getElementById("wipe").addEventListener("input", slide);
  gain.addEventListener("input", brighten);
  show();
  brighten();
})();
"""
