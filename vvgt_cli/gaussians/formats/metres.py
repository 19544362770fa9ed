"""Where a scene in metres has the Gaussians of a file: glTF and USD, whose up is +y, and whose unit is the metre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.frames import up_matrix
from vvgt_cli.gaussians.header import facts_in
from vvgt_cli.volume.space import metres

SMALLEST = 1e-9  # metres: molecules, in angstroms, would be too small for any viewer
HALF_TURN = np.diag([-1.0, -1.0, 1.0])  # about z: from up as 3DGS viewers have it, -y, to +y


@dataclass(frozen=True)
class Placed:
    """A half turn about z, a uniform scale and a translation: ``scene = scale * HALF_TURN @ data + translation``.

    Attributes:
        scale, translation: metres; 1 and (3,) of 0 where the world's unit, or the file's place in it, is not known.
        world: (4, 4) that takes the scene's metres to the volume's world (mm where there is an anatomical space); None
            where that is not known.
        space, unit: of the world: "RAS", "LPS" or "none"; "mm", "um", ...
    """

    scale: float
    translation: np.ndarray
    world: np.ndarray | None = None
    space: str = "none"
    unit: str = ""

    def matrix(self) -> np.ndarray:
        """(4, 4) float64, data to scene, for columns of coordinates."""
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = self.scale * HALF_TURN, self.translation
        return result


def placed(comments: tuple[str, ...], name: str) -> Placed:
    """Where the comments of a file say that its Gaussians are.

    Raises:
        DataError: comments that are not ours.
    """
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


def same_place(found: np.ndarray, comments: tuple[str, ...], name: str) -> None:
    """See that a file of ours places its Gaussians as it was written, or by the half turn alone.

    Args:
        found: (4, 4), data to scene, as `Placed.matrix`.
        comments, name: of the file.

    Raises:
        DataError: it was moved by another program, and the comments do not say where it is any more.
    """
    expected = placed(comments, name).matrix(), Placed(1.0, np.zeros(3)).matrix()
    if not any(np.allclose(found, one, rtol=1e-5, atol=1e-6 * np.abs(one[:3]).max()) for one in expected):
        raise DataError(
            f"{name}: its Gaussians are placed otherwise than vvgt places them (turned by 180 degrees about z, in "
            "metres where their unit is known); expected a file as vvgt writes it"
        )
