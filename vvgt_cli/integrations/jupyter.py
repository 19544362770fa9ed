"""A widget for Jupyter: the page of a result in a cell, with its function, cut, camera, light and labels as traits.

Tried: JupyterLab 4.6, anywidget 0.11
Enable:
    pip install anywidget
    from vvgt_cli.integrations.jupyter import SplatWidget
    widget = SplatWidget(vvgt.convert(volume)); widget
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import anywidget
import traitlets

from vvgt_cli.gaussians.formats.page_file import iframe

# the page's messages (docs/page.md, "In a site"): what it says becomes the traits, and what Python sets is sent to it
SCRIPT = """
const keys = ['camera', 'cut', 'light', 'function', 'labels'];
export default { render({ model, el }) {
  el.innerHTML = model.get('page');
  const frame = el.querySelector('iframe'), told = {};
  const layer = () => model.get('layer'), facts = (key) => ({ vvgt: 'set', [key]: model.get(key), layer: layer() });
  const send = (key) => frame.contentWindow.postMessage(facts(key), '*');
  const take = (key, value) => { told[key] = JSON.stringify(value); model.set(key, value); };
  const hear = ({ source, data }) => {
    if (source !== frame.contentWindow || !data?.vvgt) return;
    const { vvgt, camera, cut, light, layers, ...rest } = data;
    if (vvgt === 'loaded') {
      keys.filter((key) => model.get(key) !== null).forEach(send);
      model.set('loaded', true);
    }
    if (vvgt === 'loaded' || vvgt === 'changed') {
      const now = { camera, cut, light, ...layers?.[layer()] };
      const free = (key) => now[key] !== undefined && (vvgt === 'changed' || model.get(key) === null);
      for (const key of keys.filter(free)) take(key, now[key]);
    } else if (vvgt === 'picked') model.set('picked', rest);
    else if (vvgt === 'error') model.set('error', rest.message);
    model.save_changes();
  };
  addEventListener('message', hear);
  for (const key of keys) {
    model.on(`change:${key}`, () => { if (JSON.stringify(model.get(key)) !== told[key]) send(key); });
  }
  return () => removeEventListener('message', hear);
} };
"""


class SplatWidget(anywidget.AnyWidget):
    """The page of a result; its traits follow the page, and the page follows them.

    Attributes:
        camera: a name, such as "left", or target, pitch, yaw, distance and orthographic.
        cut: {"kind": "none", "plane" or "box", ...}.
        light: {"kind": "none", "headlight" or "direction", "from", "ambient", "diffuse", "specular"}.
        function: as a JSON file of a function: {"points": [{"x", "opacity", "rgb"}, ...]}.
        labels: of a label map: [{"number", "opacity", "color"}, ...].
        layer: number of the layer that ``function`` and ``labels`` are of.
        picked: place, unit and value where the page was clicked last.
        error: what the page said last of a value that it refused.
        loaded: whether the page is shown.
    """

    _esm = SCRIPT
    page = traitlets.Unicode().tag(sync=True)
    camera = traitlets.Any(None).tag(sync=True)
    cut = traitlets.Any(None).tag(sync=True)
    light = traitlets.Any(None).tag(sync=True)
    function = traitlets.Any(None).tag(sync=True)
    labels = traitlets.Any(None).tag(sync=True)
    layer = traitlets.Int(0).tag(sync=True)
    picked = traitlets.Any(None).tag(sync=True)
    error = traitlets.Unicode("").tag(sync=True)
    loaded = traitlets.Bool(False).tag(sync=True)

    def __init__(self, result: Any, **traits: Any) -> None:
        """Show a result of `vvgt_cli.convert`, or its clouds, with the traits that are given."""
        with TemporaryDirectory() as folder:
            path = Path(folder) / "result.html"
            result.save(path)
            page = iframe(path.read_bytes(), "Gaussian splats")
        super().__init__(page=page, **traits)
