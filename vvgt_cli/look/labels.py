"""`LabelTable`: names, colours and opacities of a label map's labels; `label_files` reads its files.

A name is cleaned by `clean_name`, and leaves in headers (`Label.comment`), legends (`labels_legend`), pages
(`Label.page_entry`) and names of files (`Label.stem`). `parents_of` names the groups of a label.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.look.function import Named
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.volume.components import listed
from vvgt_cli.volume.types import triple

PALETTES = ("tab10", "tab20b", "tab20c", "Set2", "Dark2", "Set3")  # matplotlib's qualitative ones: 78 colours
AUTO, NO_LABELS = "auto", "none"  # values of --labels: distinct colours, or a scalar field
MAX_NAME, MAX_STEM = 200, 80  # characters of a label's name: in headers, and in names of files
MAX_LEGEND = 24  # labels of a legend
SOLID = 1.0  # opacity of a label whose table says none
PARTS = ("category", "type", "type_modifier", "region", "region_modifier")
GROUPING = ("category", "region", "type")  # parts that are groups, from the outermost
_COLUMNS = ("Category", "Type", "TypeModifier", "Region", "RegionModifier")  # of a .csv of 3D Slicer, in PARTS' order
_CODE = ("CodingScheme", "CodeValue", "CodeMeaning")
_SIDES = {"l": "Left", "r": "Right"}
_TISSUES = {"ctx": "cortex", "wm": "white matter"}
_SURFACE = re.compile(r"(ctx|wm)[-_](l|r)h[-_]")
_SIDE = re.compile(r"(Left|Right)-")


@dataclass(frozen=True)
class Label:
    """A label.

    Attributes:
        number: the voxels' value.
        name: of the structure.
        color: RGB in [0, 1].
        opacity: in [0, 1] per unit distance.
        parents: names of the groups that it is in, from the outermost.
        codes: what its table says of it by coded terms (`vvgt_cli.look.labels`).
        hidden_opacity: opacity that it would have if its table did not switch it off, 0 if it does not.
        automatic: its colour was chosen by its number, not stated.
    """

    number: int
    name: str
    color: tuple[float, float, float]
    opacity: float = SOLID
    parents: tuple[str, ...] = ()
    codes: tuple[tuple[str, str, str], ...] = ()
    hidden_opacity: float = 0.0
    automatic: bool = field(default=False, compare=False, repr=False)

    @property
    def shown_opacity(self) -> float:
        """Opacity if the label is switched on."""
        return self.opacity or self.hidden_opacity

    def facts(self) -> dict[str, Any]:
        """Return the entries of the label in an index and in files with nodes."""
        facts: dict[str, Any] = {"label": self.number, "color": self.color, "opacity": self.shown_opacity}
        if self.parents:
            facts["parents"] = self.parents
        if self.codes:
            facts["terminology"] = {part: f"{code} {meaning}" for part, code, meaning in self.codes}
        return facts if self.opacity else facts | {"visible": False}

    @property
    def key(self) -> tuple[int, str]:
        """Number and name; the labels of several files are the same if both are."""
        return self.number, self.name

    @property
    def stem(self) -> str:
        """Number, which is unique, and name in plain characters, for a file name."""
        return f"{self.number}-{re.sub(r'[^0-9A-Za-z]+', '-', self.name)[:MAX_STEM].strip('-')}".strip("-")

    def page_entry(self) -> dict[str, Any]:
        """Return the entry of the label in a page."""
        return {"number": self.number, "name": self.name, "rgb": list(self.color), "opacity": self.opacity}

    def comment(self) -> str:
        """Return number, colour, opacity and name as text for a header, in ASCII; `parse` reads it."""
        color = " ".join(f"{channel:.4g}" for channel in self.color)
        return f"{self.number} {color} {self.opacity:.6g} {json.dumps(self.name)}"

    @classmethod
    def parse(cls, text: str) -> Label:
        """Parse the text that `comment` writes, or raise ValueError."""
        number, *optics, name = text.split(None, 5)
        red, green, blue, opacity = (float(x) for x in optics)
        if not all(0 <= x <= 1 for x in (red, green, blue, opacity)) or not isinstance(name := json.loads(name), str):
            raise ValueError(text)
        return cls(int(number), name, (red, green, blue), opacity)


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
            pairs = pairwise(sorted(self.labels, key=lambda label: label.number))
            twice = next((f"{a.number} twice ({a.name}, {b.name})" for a, b in pairs if a.number == b.number), "order")
            raise DataError(f"{self.name}: label {twice}; expected each label once")

    @cached_property
    def _numbers(self) -> np.ndarray:
        return np.array([label.number for label in self.labels], np.float64)

    @cached_property
    def _optics(self) -> np.ndarray:
        """Return (n, 4) float64 red, green, blue and opacity."""
        return np.array([(*label.color, label.opacity) for label in self.labels], np.float64)

    def _rows(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the row of each of x (n,), and whether it has one."""
        rows = np.minimum(np.searchsorted(self._numbers, np.where(np.isnan(x), np.inf, x)), len(self.labels) - 1)
        return rows, self._numbers[rows] == x

    def opacity(self, x: np.ndarray) -> np.ndarray:
        """Return the opacity in [0, 1] per unit distance of labels x (n,); 0 without an entry."""
        rows, there = self._rows(x)
        return np.where(there, self._optics[rows, 3], 0.0)

    def color(self, x: np.ndarray) -> np.ndarray:
        """Return RGB (n, 3) in [0, 1] of labels x (n,)."""
        return self._optics[self._rows(x)[0], :3]

    def node_range(self) -> tuple[float, float]:
        """Return the smallest and largest label."""
        return float(self._numbers[0]), float(self._numbers[-1])

    def support(self, lo: float, hi: float) -> list[tuple[float, float]]:
        """Return the visible labels in [lo, hi], as intervals."""
        return [(float(e.number),) * 2 for e in self.labels if e.opacity > 0 and lo <= e.number <= hi]

    @property
    def structures(self) -> tuple[Label, ...]:
        """All labels but a transparent 0, which is background."""
        return tuple(label for label in self.labels if label.number != 0 or label.opacity > 0)

    def restricted_to(self, numbers: Sequence[int], where: str) -> LabelTable:
        """Return the entries of a volume's labels, ascending ``numbers``; label 0 needs none.

        Raises:
            DataError: labels without an entry, or none of the table's labels.
        """
        known = {label.number: label for label in self.labels}
        missing = [n for n in numbers if n != 0 and n not in known]
        shown = listed(missing, ", ") if missing else "only 0"
        if not any(n in known for n in numbers if n != 0):
            has = listed(list(known), ", ")
            raise DataError(f"{where}: none of its labels ({shown}) is in {self.name}, which has {has}")
        if missing:
            has = listed([f"{label.number} ({label.name})" for label in self.labels], ", ")
            raise DataError(
                f"{where}: {len(missing)} labels have no entry in {self.name}: {shown}; it has {has}; add them "
                "(opacity 0 hides one)"
            )
        return replace(self, labels=tuple(known[n] for n in numbers if n in known))

    def warn_hidden(self, numbers: Collection[float], where: str, split: bool = False) -> None:
        """Warn about labels of the volume, ``numbers``, that the table hides (0 aside).

        With ``split``, labels that are only switched off are not hidden.
        """
        opacity = {e: e.shown_opacity if split else e.opacity for e in self.labels if e.number in numbers and e.number}
        if hidden := [f"{e.number} ({e.name})" for e in opacity if not opacity[e]]:
            text = f"{where}: {self.name} hides {len(hidden)} of its labels (opacity 0): {listed(hidden, ', ')}"
            warnings.warn(text, stacklevel=2)

    def only(self, number: int) -> LabelTable:
        """Return the table with one label, switched on, and the others transparent."""
        kept = tuple(replace(e, opacity=e.shown_opacity if e.number == number else 0.0) for e in self.labels)
        return replace(self, name=f"{self.name}, label {number}", labels=kept)


def check_labels(looks: Sequence[Named]) -> None:
    """Raise DataError for looks that hide everything; one of several layers may hide all its labels."""
    if all(isinstance(look, LabelTable) and not any(e.opacity > 0 for e in look.labels) for look in looks):
        raise DataError(f"{looks[0].name}: none of its labels is visible; expected opacity above 0: try --labels auto")


def distinct(numbers: Sequence[int]) -> LabelTable:
    """Return solid labels (``numbers`` ascending, 0 transparent) in colours by their number."""
    named = [(n, default_name(n), palette_color(n), SOLID if n else 0.0) for n in numbers]
    return LabelTable("distinct colours", tuple(Label(*one, automatic=True) for one in named))


@cache
def palette() -> list[tuple[float, float, float]]:
    """Return the 78 colours, RGB in [0, 1], of labels whose table gives none."""
    from matplotlib import colormaps

    return [triple(map(float, rgb[:3])) for name in PALETTES for rgb in colormaps[name](range(colormaps[name].N))]


def palette_color(number: int) -> tuple[float, float, float]:
    """Return the colour of a label whose table gives none; they repeat after 78 numbers."""
    return palette()[(number - 1) % len(palette())]


def default_name(number: int) -> str:
    """Return the name of a label whose table gives none."""
    return f"label {number}"


def clean_name(where: str, number: int, text: str) -> str:
    """Return the name of a label, from the text in its table: valid Unicode, or `default_name` if empty.

    Warn if it is cut to `MAX_NAME` characters.
    """
    if len(text) > MAX_NAME:
        warnings.warn(f"{where}: name of {len(text)} characters, cut to {MAX_NAME}: {text[:40]!r}...", stacklevel=2)
    return text[:MAX_NAME].encode("utf-8", "replace").decode("utf-8") or default_name(number)


def labels_legend(labels: Sequence[Label], most: int) -> str:
    """Return one line of JSON: names and colours of the first labels that are shown, and how many are.

    It has at most ``most`` characters and `MAX_LEGEND` labels.
    """
    shown = [label for label in labels if label.opacity > 0]
    rows = [[label.name, hex_color(label.color)] for label in shown[:MAX_LEGEND]]
    while len(text := json.dumps({"labels": rows, "of": len(shown)})) > most:
        rows.pop()
    return text


def hex_color(rgb: Sequence[float]) -> str:
    """Return a colour in [0, 1] as ``rrggbb``."""
    return "".join(f"{round(255 * min(max(float(c), 0.0), 1.0)):02x}" for c in rgb)


Codes = tuple[tuple[str, str, str], ...]  # (part, "scheme:value", meaning) of each part that is there


def codes_of(terms: Sequence[Sequence[str]]) -> Codes:
    """Return the codes of (scheme, value, meaning), one for each of `PARTS` or none; omit those without meaning."""
    stated = zip(PARTS, terms, strict=False)
    return tuple((part, f"{scheme}:{value}", meaning) for part, (scheme, value, meaning) in stated if meaning.strip())


def codes_of_row(cells: Mapping[str, str]) -> Codes:
    """Return the codes in a row of a `.csv` of 3D Slicer; the names of its columns are in lower case."""
    return codes_of([[cells.get(f"{column}_{field}".lower(), "") for field in _CODE] for column in _COLUMNS])


def parents_of(name: str, codes: Codes) -> tuple[str, ...]:
    """Return the groups of a label, from the outermost: by its codes, else by a name of FreeSurfer's."""
    meanings = {part: meaning for part, _, meaning in codes}
    groups: list[str] = []
    for part in GROUPING:
        group = meanings.get(part, "")
        if group and group.casefold() not in (name.casefold(), *(groups[-1:] and [groups[-1].casefold()])):
            groups.append(group)
    if codes:
        return tuple(groups)
    if surface := _SURFACE.match(name):
        side = _SIDES[surface[2]]
        return side, f"{side} {_TISSUES[surface[1]]}"
    side_of = _SIDE.match(name)
    return (side_of[1],) if side_of else ()
