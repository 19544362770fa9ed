"""Run under an X server: napari with its window, a volume in 3D, and File > Save Selected Layers clicked.

PYTHON napari_scene.py FOLDER; leaves a.splats.ply, napari's picture and facts.json for test_integrations_napari.py.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import napari
import npe2
import numpy as np
from napari.utils.colormaps import Colormap
from napari.utils.notifications import notification_manager
from qtpy.QtCore import Qt, QTimer
from qtpy.QtWidgets import QApplication, QFileDialog, QLineEdit

FOLDER = Path(sys.argv[1])
INDEX, ANGLE = (17, 22, 14), 30.0  # z, y, x; degrees
k, j, i = np.indices((36, 40, 34))
ball = sum(
    np.clip(1.4 - np.sqrt((k - z) ** 2 + (j - y) ** 2 + (i - x) ** 2) / width, 0, high)
    for z, y, x, width, high in ((*INDEX, 9, 1), (26, 33, 25, 4, 0.5), (8, 11, 26, 3, 0.7))  # no mirror image
)
colours = np.array([[0.1, 0.2, 0.9, 0], [0.9, 0.9, 0.1, 0.05], [1, 0.2, 0.1, 0.3]])

plugins = npe2.PluginManager.instance()
plugins.discover()
if "vvgt" not in plugins:  # in a clone that is not installed
    plugins.register(npe2.PluginManifest.from_file(Path(__file__).parents[1] / "vvgt_cli/integrations/napari.yaml"))
viewer = napari.Viewer(ndisplay=3)
layer = viewer.add_image(
    np.clip(ball, 0, 1).astype(np.float32), name="ball", colormap=Colormap(colours, name="own"), contrast_limits=(0, 1),
    rendering="translucent", scale=[0.5] * 3, rotate=(10, 20, 30), translate=(100, -20, 7), units=["um"] * 3,
)  # fmt: skip
at = np.array(layer.data_to_world(INDEX))
viewer.camera.set_view_direction((0.5, 0.6, -0.7), (0, -1, 0))
viewer.camera.center, viewer.camera.perspective = tuple(at), ANGLE
picture = viewer.screenshot(canvas_only=True, flash=False)
viewer.camera.zoom = min(picture.shape[:2]) / 24
picture = viewer.screenshot(canvas_only=True, flash=False)[..., :3]
high, wide = picture.shape[:2]
side = min(high, wide)
top, left = (high - side) // 2, (wide - side) // 2
np.save(FOLDER / "napari.npy", picture[top : top + side, left : left + side])
away = high / viewer.camera.zoom / 2 / np.tan(np.radians(ANGLE) / 2)
eye = at - away * np.array(viewer.camera.view_direction)
facts = {"eye": eye[::-1].tolist(), "at": at[::-1].tolist(), "up": viewer.camera.up_direction[::-1]}
facts["angle"] = 2 * np.degrees(np.arctan(np.tan(np.radians(ANGLE) / 2) * side / high))


def entered() -> None:
    """Choose the type in the dialog that is open, type the name, and press Save."""
    found = [w for w in QApplication.topLevelWidgets() if isinstance(w, QFileDialog) and w.isVisible()]
    if not found:
        QTimer.singleShot(200, entered)
        return
    (dialog,) = found
    dialog.selectNameFilter(next(text for text in dialog.nameFilters() if text.startswith("Gaussian splats")))
    dialog.findChild(QLineEdit).setText(str(FOLDER / "a.splats.ply"))
    dialog.accept()


QApplication.setAttribute(Qt.ApplicationAttribute.AA_DontUseNativeDialogs)
QTimer.singleShot(200, entered)
viewer.layers.selection = {layer}
menu = viewer.window.file_menu
next(action for action in menu.actions() if action.text().startswith("Save Selected Layers")).trigger()
facts["said"] = [record.message for record in notification_manager.records]
(FOLDER / "facts.json").write_text(json.dumps(facts))
viewer.close()
