"""A module of 3D Slicer with a button: volume as it is rendered, segmentation and camera to a page or file.

Slicer's own Python runs this file; what it hands over is taken by `mrml.py`, and the conversion is the `vvgt` command.

Tried: 3D Slicer 5.13 (the scene: slicer-core of PyPI; not the panel, which needs its windows)
Enable:
    Edit > Application Settings > Modules > Additional module paths: add {folder}, and restart.
    If vvgt is not in PATH, set the environment variable VVGT to its path before Slicer starts.
"""

from __future__ import annotations

import tempfile
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import ctk
import qt
import slicer
from slicer.ScriptedLoadableModule import (
    ScriptedLoadableModule,
    ScriptedLoadableModuleLogic,
    ScriptedLoadableModuleWidget,
)

_spec: Any = spec_from_file_location("vvgt_mrml", Path(__file__).resolve().parents[1] / "mrml.py")
mrml = module_from_spec(_spec)
_spec.loader.exec_module(mrml)


class GaussianSplats(ScriptedLoadableModule):
    """The module, as Slicer lists it."""

    def __init__(self, parent: Any) -> None:
        """Describe the module."""
        super().__init__(parent)
        parent.title, parent.categories, parent.contributors = "Gaussian Splats", ["Rendering"], ["vvgt"]
        parent.helpText = "Converts the volume as its volume rendering shows it, and segments, to 3D Gaussian splats."


class GaussianSplatsWidget(ScriptedLoadableModuleWidget):
    """The panel: two nodes, a file, and a button."""

    def setup(self) -> None:
        """Build the panel."""
        super().setup()
        form = qt.QFormLayout()
        self.layout.addLayout(form)
        self.volume = self._nodes("vtkMRMLScalarVolumeNode")
        self.segmentation = self._nodes("vtkMRMLSegmentationNode")
        self.steps = qt.QCheckBox("all time steps of its sequence")
        self.output = ctk.ctkPathLineEdit()
        self.output.filters = ctk.ctkPathLineEdit.Files | ctk.ctkPathLineEdit.Writable
        self.output.nameFilters = ["Page (*.html)", "Gaussian splats (*.ply *.spz *.sog *.glb *.usdc *.usdz)"]
        self.more = qt.QLineEdit()
        self.more.placeholderText = "further options, such as --max-gaussians 50000 --up none"
        for label, widget in (("Volume", self.volume), ("", self.steps), ("Segmentation", self.segmentation),
                              ("File", self.output), ("Options", self.more)):  # fmt: skip
            form.addRow(label, widget)
        button = qt.QPushButton("Convert to Gaussian splats and open")
        button.connect("clicked(bool)", self.onConvert)
        form.addRow(button)
        self.layout.addStretch(1)

    def _nodes(self, kind: str) -> Any:
        box = slicer.qMRMLNodeComboBox()
        box.nodeTypes, box.noneEnabled = [kind], True
        box.addEnabled = box.removeEnabled = box.renameEnabled = False
        box.setMRMLScene(slicer.mrmlScene)
        return box

    def onConvert(self, _: bool = False) -> None:
        """Convert what is chosen, and open the result."""
        with slicer.util.tryWithErrorDisplay("Gaussian splats", waitCursor=True):
            nodes = self.volume.currentNode(), self.segmentation.currentNode()
            path = self.output.currentPath or str(Path(slicer.app.temporaryPath) / "splats.html")
            self.logic = GaussianSplatsLogic()
            notes = self.logic.convert(*nodes, path, self.steps.checked, self.more.text.split(), self.say)
            if notes:
                slicer.util.warningDisplay(f"Not taken: {', '.join(notes)}.", "Gaussian splats")
            qt.QDesktopServices.openUrl(qt.QUrl.fromLocalFile(path))

    def say(self, line: str) -> None:
        """Show a line of the command's in the status bar."""
        slicer.util.showStatusMessage(line)
        slicer.app.processEvents()


class GaussianSplatsLogic(ScriptedLoadableModuleLogic):
    """The conversion, also for scripts: ``GaussianSplatsLogic().convert(volume, None, "page.html")``."""

    def convert(
        self, volume: Any, segmentation: Any, output: str, steps: bool = False, options: Any = (), say: Any = print
    ) -> Any:
        """Convert nodes to a file, and return what could not be taken.

        Raises:
            RuntimeError: neither node is given, one cannot be placed, or `vvgt` fails: its message.
        """
        if volume is None and segmentation is None:
            raise RuntimeError("no node; choose a volume, a segmentation, or both")
        manager = slicer.app.layoutManager()
        window = manager.threeDWidget(0).threeDView().renderWindow() if manager and manager.threeDViewCount else None
        renderer = window and window.GetRenderers().GetFirstRenderer()
        with tempfile.TemporaryDirectory() as folder:
            words, notes = mrml.words(Path(folder), volume, segmentation, renderer, steps)
            mrml.neighbour("command").run(["convert", *words, "-o", output, "--overwrite", *options], say)
        return notes
