"""Gaussians of a cut on disk, part by part, as they are and as levels of detail."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vvgt_cli.conversion.cut import Cut, TileGaussians
from vvgt_cli.conversion.level_selection import FIELDS, CutErrors
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.gaussians import Gaussians, concatenate


def save(
    store: BlockStore, kind: str, number: int, nodes: Sequence[TileGaussians], more: dict[str, np.ndarray]
) -> None:
    """Save nodes of one part."""
    arrays: dict[str, np.ndarray] = {
        "counts": np.array([[len(level) for level in node.levels] for node in nodes]),
        "spreads": np.array([node.spreads for node in nodes]),
    }
    if nodes[0].normals is not None:
        arrays["normals"] = np.concatenate([node.normals for node in nodes])
    for k in range(len(nodes[0].levels)):
        whole = concatenate([node.levels[k] for node in nodes]).arrays()
        arrays |= {f"{name}-{k}": array for name, array in whole.items()}
    store.save(kind, number, ".npz", **(more | arrays))


@dataclass(frozen=True)
class StoredGaussians:
    """The Gaussians of a cut, in the store.

    Attributes:
        store: store of the parts.
        kind: kind of the results.
        ends: end of each part's range of nodes.
    """

    store: BlockStore
    kind: str
    ends: tuple[int, ...]

    def level(self, k: int, begin: int, end: int) -> Iterator[Gaussians]:
        """Yield the Gaussians of level ``k`` of nodes ``begin`` to ``end``; raise DataError if a part is damaged."""
        for number in range(int(np.searchsorted(self.ends, begin, "right")), len(self.ends)):
            first = self.ends[number - 1] if number else 0
            if first >= end:
                return
            names = [one for one in self.store.names(self.kind, number) if one.endswith(f"-{k}")]
            part = self.store.load(self.kind, number, names=["counts", *names])
            whole, counts = Gaussians(**{name.rpartition("-")[0]: part[name] for name in names}), part["counts"][:, k]
            for row, (n, e) in enumerate(zip(counts, np.cumsum(counts), strict=True), first):
                if begin <= row < end:
                    yield whole.take(np.arange(e - n, e))

    def parts(self) -> Iterator[tuple[Gaussians, np.ndarray | None]]:
        """Yield the Gaussians of the first level and their normals, None without a light, part by part."""
        for number in range(len(self.ends)):
            part = self.store.load(self.kind, number)
            named = {name.removesuffix("-0"): array for name, array in part.items() if name.endswith("-0")}
            yield Gaussians(**named), part.get("normals")

    def field(self, name: str) -> np.ndarray:
        """Return an array of all parts: "counts" or "spreads" of nodes' levels, "opacity_logits-0" of Gaussians."""
        parts = [self.store.load(self.kind, number, names=[name])[name] for number in range(len(self.ends))]
        return np.concatenate(parts)

    def errors(self) -> CutErrors:
        """Return the errors of refined levels."""
        fields = {name: self.field(name) for name in FIELDS}
        return CutErrors(np.zeros(fields["counts"].shape[1]), **fields)


@dataclass(frozen=True)
class FinishedParts:
    """The Gaussians of a cut, on disk part by part.

    Attributes:
        cut: the cut.
        threshold: threshold of scores of its cells.
        stored: Gaussians of cells within tiles.
        over: Gaussians and normals of cells that stand for several tiles each; None if there are none.
        removed: how many Gaussians fewer than the budget there are because they would be faint.
    """

    cut: Cut
    threshold: float
    stored: StoredGaussians
    over: tuple[Gaussians, np.ndarray | None] | None
    removed: int = 0

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return int(self.stored.field("counts").sum()) + (0 if self.over is None else len(self.over[0]))

    def __iter__(self) -> Iterator[tuple[Gaussians, np.ndarray | None]]:
        """Yield Gaussians, box frame, and normals, None without a light, of each part."""
        yield from self.stored.parts()
        if self.over is not None:
            yield self.over

    def gathered(self) -> Gaussians:
        """Return all Gaussians, box frame."""
        return concatenate([gaussians for gaussians, _ in self])

    def why_fewer(self) -> str:
        """Return the reason, to end a message with, why there are fewer Gaussians than the budget, if so."""
        from vvgt_cli.closed_form.closed_form import NEARLY

        budget = self.cut.plan.budget
        if self.removed or len(self) >= NEARLY * budget:
            return ""
        return f", no more: {self.cut.pyramid.base} cells suffice for the screen and {budget} Gaussians"


@dataclass(frozen=True)
class Levels:
    """The levels of every tile, on disk part by part.

    Attributes:
        cut: the pyramid that they are cut from.
        stored: their Gaussians.
        errors: errors of the cuts that they were chosen from, or their own where they are refined.
        choices: (tiles, levels) columns of ``errors``.
        removed: how many Gaussians fewer than the budget the finest has because they would be faint.
    """

    cut: Cut
    stored: StoredGaussians
    errors: CutErrors
    choices: np.ndarray
    removed: int = 0
