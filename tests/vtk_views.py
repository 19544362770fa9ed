"""Views that VTK draws, in a process of its own: VTK may crash where OpenGL is incomplete."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from vvgt_cli.dvr import vtk as vtk_renderer
from vvgt_cli.errors import DataError


def drawn_by_vtk(code: str, folder: Path) -> np.lib.npyio.NpzFile:
    """What ``code`` saves at ``sys.argv[1]``; the test is skipped where there is no off-screen OpenGL."""
    try:
        vtk_renderer.require_opengl()
    except DataError as error:
        pytest.skip(str(error))
    path = folder / "views.npz"
    folders = os.pathsep.join([*map(str, Path(__file__).parents[:2]), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-c", code, path], capture_output=True, text=True, env=os.environ | {"PYTHONPATH": folders}
    )
    assert done.returncode == 0, done.stderr
    return np.load(path)
