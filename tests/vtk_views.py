"""Views that VTK draws, in a process of its own: VTK may crash where OpenGL is incomplete."""

from pathlib import Path

import numpy as np
import pytest

from tests.processes import python
from vvgt_cli.dvr import vtk as vtk_renderer
from vvgt_cli.errors import DataError


def drawn_by_vtk(code: str, folder: Path) -> np.lib.npyio.NpzFile:
    """What ``code`` saves at ``sys.argv[1]``; the test is skipped where there is no off-screen OpenGL."""
    try:
        vtk_renderer.require_opengl()
    except DataError as error:
        pytest.skip(str(error))
    path = folder / "views.npz"
    python("-c", code, path)
    return np.load(path)
