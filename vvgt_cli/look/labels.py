"""`LabelTable`: names, colours and opacities of a label map's labels; `label_files` reads its files."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.look.function import Named
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.volume.types import triple

PALETTES = ("tab10", "tab20b", "tab20c", "Set2", "Dark2", "Set3")  # matplotlib's qualitative ones: 78 colours
LISTED = 8  # labels that a message names
LONGEST_NAME = 200  # characters of a label's name: files of Gaussians keep it in their headers
SOLID = 1.0  # opacity of a label whose table says none


@dataclass(frozen=True)
class Label:
    """A label.

    Attributes:
        number: the voxels' value.
        name: of the structure.
        color: RGB in [0, 1].
        opacity: in [0, 1] per unit distance.
        parents: names of the groups that it is in, from the outermost.
        codes: what its table says of it by coded terms (`vvgt_cli.look.terms`).
        hidden_opacity: opacity that it would have if its table did not switch it off, 0 if it does not.
    """

    number: int
    name: str
    color: tuple[float, float, float]
    opacity: float = SOLID
    parents: tuple[str, ...] = ()
    codes: tuple[tuple[str, str, str], ...] = ()
    hidden_opacity: float = 0.0

    @property
    def shown_opacity(self) -> float:
        """Opacity if the label is switched on."""
        return self.opacity or self.hidden_opacity

    def facts(self) -> dict[str, Any]:
        """Return the entries of the label in an index and in files with nodes."""
        found: dict[str, Any] = {"label": self.number, "color": self.color, "opacity": self.shown_opacity}
        if self.parents:
            found["parents"] = self.parents
        if self.codes:
            found["terminology"] = {part: f"{code} {meaning}" for part, code, meaning in self.codes}
        return found if self.opacity else found | {"visible": False}


@dataclass(frozen=True)
class LabelTable:
    """Look of labels: a function of integers, transparent elsewhere. Label 0 is transparent by default.

    Attributes:
        name: for reports.
        labels: ascending by number, each once.

    Raises:
        DataError: no labels, or a number twice.
    """

    name: str
    labels: tuple[Label, ...]
    lighting = Lighting(ambient=0.4, diffuse=0.6, specular=0.0)  # head-on a label has its own colour
    opacity_unit_distance = None
    opacity_unit_share = None

    def __post_init__(self) -> None:
        """Check that numbers ascend."""
        if not self.labels:
            raise DataError(f"{self.name}: no labels; expected one")
        numbers = [label.number for label in self.labels]
        if sorted(set(numbers)) != numbers:
            twice = next((a for a, b in pairwise(sorted(numbers)) if a == b), None)
            raise DataError(f"{self.name}: label {twice} twice; expected each label once")

    @cached_property
    def _numbers(self) -> np.ndarray:
        return np.array([label.number for label in self.labels], np.float64)

    @cached_property
    def _optics(self) -> np.ndarray:
        """Return (n, 4) float64 red, green, blue and opacity."""
        return np.array([(*label.color, label.opacity) for label in self.labels], np.float64)

    def _rows(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the row of each of x (n,), and whether it has one."""
        found = np.minimum(np.searchsorted(self._numbers, np.where(np.isnan(x), np.inf, x)), len(self.labels) - 1)
        return found, self._numbers[found] == x

    def opacity(self, x: np.ndarray) -> np.ndarray:
        """Return the opacity in [0, 1] per unit distance of labels x (n,); 0 without an entry."""
        rows, there = self._rows(x)
        return np.where(there, self._optics[rows, 3], 0.0)

    def color(self, x: np.ndarray) -> np.ndarray:
        """Return RGB (n, 3) in [0, 1] of labels x (n,)."""
        result: np.ndarray = self._optics[self._rows(x)[0], :3]
        return result

    def node_range(self) -> tuple[float, float]:
        """Return the smallest and largest label."""
        return float(self._numbers[0]), float(self._numbers[-1])

    def support(self, lo: float, hi: float) -> list[tuple[float, float]]:
        """Return the visible labels in [lo, hi], as intervals."""
        return [(float(e.number),) * 2 for e in self.labels if e.opacity > 0 and lo <= e.number <= hi]

    def of(self, numbers: Sequence[int], where: str) -> LabelTable:
        """Return the entries of a volume's labels, ascending ``numbers``; label 0 needs none.

        Raises:
            DataError: labels without an entry, or none of the table's labels.
        """
        known = {label.number: label for label in self.labels}
        missing = [n for n in numbers if n != 0 and n not in known]
        shown = ", ".join(map(str, missing[:LISTED])) + (", ..." if len(missing) > LISTED else "")
        if not any(n in known for n in numbers if n != 0):
            has = ", ".join(str(n) for n in list(known)[:LISTED]) + (", ..." if len(known) > LISTED else "")
            raise DataError(f"{where}: none of its labels ({shown or 'only 0'}) is in {self.name}, which has {has}")
        if missing:
            raise DataError(
                f"{where}: {len(missing)} labels have no entry in {self.name}: {shown}; add them (opacity 0 hides one)"
            )
        return replace(self, labels=tuple(known[n] for n in numbers if n in known))

    def warned(self, numbers: Collection[float], where: str, split: bool = False) -> LabelTable:
        """Return the table; warn about labels of the volume, ``numbers``, that it hides (0 aside).

        With ``split``, labels that are only switched off are not hidden.
        """
        opacity = {e: e.shown_opacity if split else e.opacity for e in self.labels if e.number in numbers and e.number}
        if hidden := [f"{e.number} ({e.name})" for e in opacity if not opacity[e]]:
            shown = ", ".join(hidden[:LISTED]) + (", ..." if len(hidden) > LISTED else "")
            warnings.warn(f"{where}: {self.name} hides {len(hidden)} of its labels (opacity 0): {shown}", stacklevel=2)
        return self

    def only(self, number: int) -> LabelTable:
        """Return the table with one label, switched on, and the others transparent."""
        kept = tuple(replace(e, opacity=e.shown_opacity if e.number == number else 0.0) for e in self.labels)
        return replace(self, name=f"{self.name}, label {number}", labels=kept)


def check_labels(looks: Sequence[Named]) -> None:
    """Raise DataError for looks that hide everything; one of several layers may hide all its labels."""
    if all(isinstance(look, LabelTable) and not any(e.opacity > 0 for e in look.labels) for look in looks):
        raise DataError(f"{looks[0].name}: none of its labels is visible; expected opacity above 0: try --labels auto")


def distinct(numbers: Sequence[int]) -> LabelTable:
    """Return solid labels (``numbers`` ascending, 0 transparent) in colours by their number, which repeat above 78."""
    from matplotlib import colormaps

    colors = [triple(map(float, rgb[:3])) for name in PALETTES for rgb in colormaps[name](range(colormaps[name].N))]
    labels = [Label(n, f"label {n}", colors[(n - 1) % len(colors)], SOLID if n else 0.0) for n in numbers]
    return LabelTable("distinct colours", tuple(labels))
