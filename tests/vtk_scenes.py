"""A smooth lump off the centre of a small oblique volume, and pictures and places to compare with a program's own."""

from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.gaussians.header import FileFacts

SIZE, FIELD = 300, 30.0  # pixels along an edge of pictures, degrees
DIMS, SPACING, ORIGIN = (48, 44, 40), (0.5, 0.55, 0.6), (30.0, -12.0, 7.0)
DIRECTION = ((0.36, 0.48, -0.8), (-0.8, 0.6, 0.0), (0.48, 0.64, 0.6))
INDEX = (29.0, 18.0, 22.0)  # of the lump's middle
LUMP = tuple((np.array(ORIGIN) + np.array(DIRECTION) @ (np.array(SPACING) * INDEX)).tolist())  # in the world


def lump_values(width: float = 4.0) -> np.ndarray:
    """Values (nz, ny, nx) float32 in [0, 1]: a ball of ``width`` mm, symmetrical about `INDEX`."""
    k, j, i = np.mgrid[: DIMS[2], : DIMS[1], : DIMS[0]]
    away = sum(((at - n) * s) ** 2 for at, n, s in zip((i, j, k), INDEX, SPACING, strict=True))
    values: np.ndarray = np.exp(-away / width**2).astype(np.float32)
    return values


def lump(width: float = 4.0) -> Any:
    """The volume as vtkImageData, its array "lump"."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData

    made = vtkImageData()
    made.SetDimensions(*DIMS)
    made.SetSpacing(*SPACING)
    made.SetOrigin(*ORIGIN)
    made.SetDirectionMatrix(*(v for row in DIRECTION for v in row))
    array = numpy_to_vtk(lump_values(width).ravel(), deep=True)
    array.SetName("lump")
    made.GetPointData().SetScalars(array)
    return made


def camera_at(eye: Any, target: Any, up: Any, field: float, facts: FileFacts, size: int) -> Camera:
    """The camera in the unit frame of a file."""
    eye, target, up = (np.asarray(v, np.float64) for v in (eye, target, up))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    assert facts.scale is not None
    focal = size / 2 / np.tan(np.radians(field) / 2)
    place = -rotation @ ((eye - np.array(facts.centre)) * facts.scale)
    return Camera(rotation, place, focal, focal, size / 2, size / 2, size, size)


def seen_by(renderer: Any, facts: FileFacts, size: int) -> Camera:
    """The camera of a vtkRenderer, in the unit frame."""
    camera = renderer.GetActiveCamera()
    view = (camera.GetPosition(), camera.GetFocalPoint(), camera.GetViewUp(), camera.GetViewAngle())
    return camera_at(*view, facts, size)


def psnr(ours: np.ndarray, theirs: np.ndarray) -> float:
    """PSNR of RGB, floats beside 8 bits."""
    return float(-10 * np.log10(np.mean((np.clip(ours[..., :3], 0, 1) - theirs[..., :3] / 255) ** 2)))


def places(path: Path, index: Any = INDEX) -> tuple[np.ndarray, np.ndarray]:
    """World places (3,) of a voxel by the affine in a file, and of the middle of the file's Gaussians."""
    gaussians, facts = open_gaussians(str(path))
    mass = np.exp(gaussians.log_scales.sum(axis=1, dtype=np.float64)) / (1 + np.exp(-gaussians.opacity_logits))
    assert facts.scale is not None
    assert facts.affine is not None
    middle: np.ndarray = mass @ gaussians.means / mass.sum() / facts.scale + np.array(facts.centre)
    return np.reshape(facts.affine, (3, 4)) @ (*index, 1.0), middle
