"""Several clouds in one file of glTF or USD: a node each, in groups, below one that places them in the world."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vvgt_cli.gaussians.formats.splats import Splats
from vvgt_cli.volume.components import listed

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
    taken, found = {ROOT, *(node.name for node in nodes)}, dict[tuple[str, ...], str]()
    for path in (node.parents[:depth] for node in nodes for depth in range(1, len(node.parents) + 1)):
        if path in found:
            continue
        name = path[-1]
        while name in taken:
            name += " group"
        found[path] = name
        taken.add(name)
    return found


def common_comments(nodes: Sequence[Node]) -> tuple[str, ...]:
    """Return the comments that the files of all nodes would have."""
    return tuple(line for line in nodes[0].splats.comments if all(line in node.splats.comments for node in nodes))


def report_off(name: str, off: Sequence[str]) -> None:
    """Warn that a file has nodes of Gaussians that are switched off, by their names."""
    if off:
        shown = listed(off, ", ", 5)
        warnings.warn(f"{name}: {len(off)} of its nodes are switched off, and read all the same: {shown}", stacklevel=2)
