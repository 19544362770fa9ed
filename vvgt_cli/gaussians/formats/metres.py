"""Placement of Gaussians in scenes of glTF and USD, in metres with +y up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.frames import up_matrix
from vvgt_cli.gaussians.header import facts_in
from vvgt_cli.volume.space import metres

SMALLEST = 1e-9  # metres per unit: molecules, in angstroms, would be too small for any viewer
HALF_TURN = np.diag([-1.0, -1.0, 1.0])  # about z: from the up of 3DGS viewers, -y, to +y


@dataclass(frozen=True)
class Placed:
    """A half turn about z, a uniform scale and a translation: ``scene = scale * HALF_TURN @ data + translation``.

    Attributes:
        scale: metres per unit of the data; 1 if the world's unit or the file's place in it is unknown.
        translation: (3,) metres; 0 in that case.
        world: (4, 4) matrix from the scene's metres to the volume's world (mm in an anatomical space); None if unknown.
        space: anatomical space of the world, "RAS", "LPS" or "none".
        unit: unit of the world, "mm", "um", ...
    """

    scale: float
    translation: np.ndarray
    world: np.ndarray | None = None
    space: str = "none"
    unit: str = ""

    def matrix(self) -> np.ndarray:
        """Return the matrix (4, 4) float64 from data to scene, which applies to column vectors."""
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = self.scale * HALF_TURN, self.translation
        return result


def placed(comments: tuple[str, ...], name: str) -> Placed:
    """Return the placement that a file's comments state; raise DataError if they are not valid."""
    facts = facts_in(list(comments), name)
    space = facts.get("space") or "none"
    unit = "mm" if space != "none" else facts.get("length_unit") or ""
    metre = metres(unit)
    if metre is None or metre < SMALLEST or "scale" not in facts:
        return Placed(1.0, np.zeros(3))
    turn = HALF_TURN @ up_matrix(facts["up"])
    world = np.eye(4)
    world[:3, :3] = turn.T / metre
    if facts["frame"] == "world":
        return Placed(metre, np.zeros(3), world, space, unit)
    centre = metre * turn @ np.array(facts["centre"])
    return Placed(metre / facts["scale"], centre, world, space, unit)


def offset_in(root: np.ndarray, place: np.ndarray, comments: tuple[str, ...], name: str) -> np.ndarray:
    """Return how far a node is moved (3,) in the frame of the data, below a ``root`` that is where vvgt puts it.

    ``root`` and ``place`` are (4, 4) matrices from data to scene. Raise DataError as `same_place`, or for a turn or
    scale.
    """
    for one in (root, np.column_stack([place[:, :3], root[:, 3]])):
        same_place(one, comments, name)
    if np.array_equal(root, place):
        return np.zeros(3)
    found: np.ndarray = (np.linalg.inv(root) @ place)[:3, 3]
    return found


def same_place(matrix: np.ndarray, comments: tuple[str, ...], name: str) -> None:
    """Raise DataError unless ``matrix`` (4, 4), data to scene, is where vvgt puts a file, or the half turn alone."""
    expected = placed(comments, name).matrix(), Placed(1.0, np.zeros(3)).matrix()
    if not any(np.allclose(matrix, one, rtol=1e-5, atol=1e-6 * np.abs(one[:3]).max()) for one in expected):
        raise DataError(
            f"{name}: its Gaussians were moved by another program; expected the placement that vvgt writes (rotated by "
            "180 degrees about z, in metres where their unit is known)"
        )
