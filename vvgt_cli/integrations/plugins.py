"""The adapters for other programs: what each does and how it is enabled, as its own file says."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).parent
PLUGINS = {  # file of each, in this folder; its docstring has the lines "Tried:" and "Enable:"
    "pyvista": "pyvista.py",
    "paraview": "paraview_plugin.py",
    "catalyst": "catalyst.py",
    "slicer": "slicer/GaussianSplats.py",
    "napari": "napari.py",
    "jupyter": "jupyter.py",
    "xarray": "xarray.py",
    "blender": "blender/gaussian_splats/__init__.py",
}


@dataclass(frozen=True)
class Plugin:
    """An adapter.

    Attributes:
        name: for `vvgt plugin NAME`.
        path: its file.
        does: what it does, in a line.
        tried: the program's version that it was tried with.
        enable: lines that enable it there.
    """

    name: str
    path: Path
    does: str
    tried: str
    enable: tuple[str, ...]


def plugin(name: str) -> Plugin:
    """Return an adapter, by the docstring of its file (its program may be missing); raise KeyError if there is none."""
    path = FOLDER / PLUGINS[name]
    lines = (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "").splitlines()
    tried = next(line.removeprefix("Tried:").strip() for line in lines if line.startswith("Tried:"))
    places = {"file": path, "folder": path.parent, "above": path.parents[1]}
    enable = [line.strip().format(**places) for line in lines[lines.index("Enable:") + 1 :]]
    return Plugin(name, path, lines[0], tried, tuple(filter(None, enable)))
