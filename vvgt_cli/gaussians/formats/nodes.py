"""Clouds in scenes of glTF and USD, in metres with +y up: a node each, in groups, below one that places them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.splats import Splats
from vvgt_cli.gaussians.frames import up_matrix
from vvgt_cli.gaussians.header import facts_in
from vvgt_cli.volume.components import listed
from vvgt_cli.volume.space import metres

ROOT = "Splats"  # name of the node that places the others


@dataclass(frozen=True)
class Node:
    """A cloud and its place in the tree.

    Attributes:
        name: name of the node.
        splats: its Gaussians; those of all nodes are in one frame.
        parents: names of the groups that it is in, from the outermost.
        facts: what is known of it (numbers, texts, lists and mappings of them), by names with units.
        visible: whether programs show it at first.
    """

    name: str
    splats: Splats
    parents: tuple[str, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)
    visible: bool = True

    def centred(self) -> tuple[np.ndarray, Splats]:
        """Return the mean (3,) float64 of its Gaussians' centres, and the Gaussians about it.

        Engines that sort nodes, not the Gaussians of all, do so by the nodes' origins.
        """
        centre = self.splats.means.mean(axis=0, dtype=np.float64)
        return centre, self.splats.moved(-centre)


def group_names(nodes: Sequence[Node]) -> dict[tuple[str, ...], str]:
    """Return a name for each group, by its path and in order: parents first, no two and none that a node has."""
    taken, named = {ROOT, *(node.name for node in nodes)}, dict[tuple[str, ...], str]()
    for path in (node.parents[:depth] for node in nodes for depth in range(1, len(node.parents) + 1)):
        if path in named:
            continue
        name = path[-1]
        while name in taken:
            name += " group"
        named[path] = name
        taken.add(name)
    return named


def common_comments(nodes: Sequence[Node]) -> tuple[str, ...]:
    """Return the comments that the files of all nodes would have."""
    return tuple(line for line in nodes[0].splats.comments if all(line in node.splats.comments for node in nodes))


def report_off(name: str, off: Sequence[str]) -> None:
    """Warn that a file has nodes of Gaussians that are switched off, by their names."""
    if off:
        shown = listed(off, ", ", 5)
        warnings.warn(f"{name}: {len(off)} of its nodes are switched off, and read all the same: {shown}", stacklevel=2)


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
    return (np.linalg.inv(root) @ place)[:3, 3]


def same_place(matrix: np.ndarray, comments: tuple[str, ...], name: str) -> None:
    """Raise DataError unless ``matrix`` (4, 4), data to scene, is where vvgt puts a file, or the half turn alone."""
    expected = placed(comments, name).matrix(), Placed(1.0, np.zeros(3)).matrix()
    if not any(np.allclose(matrix, one, rtol=1e-5, atol=1e-6 * np.abs(one[:3]).max()) for one in expected):
        raise DataError(
            f"{name}: its Gaussians were moved by another program; expected the placement that vvgt writes (+y up, in "
            "metres where their unit is known)"
        )
