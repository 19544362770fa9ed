"""Several clouds of one run in memory: the frames of a series, one volume under several looks, the labels of a map."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.carried import Carry, carries
from vvgt_cli.conversion.convert import opened, run_conversion
from vvgt_cli.conversion.frames import common, interrupted, steps_of, with_blocks
from vvgt_cli.conversion.functions import beside
from vvgt_cli.conversion.gaussian_files import is_page
from vvgt_cli.conversion.index import (
    FIELD,
    FRAMES,
    FUNCTIONS,
    LABELS,
    entry,
    index_of,
    index_output,
    is_pattern,
    psnr_of,
    write_index,
)  # fmt: skip
from vvgt_cli.conversion.labels import shared_out, split
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.conversion.result import Conversion, Result
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.formats import SUFFIXES, format_of
from vvgt_cli.gaussians.outputs import Output, check_outputs
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run

if TYPE_CHECKING:
    from vvgt_cli.look.function import TransferFunction


@dataclass(repr=False)
class Cloud(Result):
    """One of several, without its volume.

    Attributes:
        name: among the others.
        stem: in a file's name: a frame's number, a function's name, a label's number and name.
        facts: as an index has them.
        directions: normals (K, 3) of a `.ply`, unit frame; None for zeros.
    """

    name: str
    stem: str
    facts: dict[str, Any]
    directions: np.ndarray | None

    def normals(self) -> np.ndarray | None:
        """See `Result.normals`."""
        return self.directions


@dataclass(frozen=True, repr=False, eq=False)
class Clouds(Mapping[str, Result]):
    """Results by name, in order.

    Attributes:
        kind: "frames", "functions" or "labels".
        volume: its name.
        clouds: the results.
        facts: as an index has them.
    """

    kind: str
    volume: str
    clouds: Sequence[Cloud]
    facts: dict[str, Any] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Result:
        for cloud in self.clouds:
            if cloud.name == name:
                return cloud
        raise KeyError(f"{name}: expected one of {', '.join(self)}")

    def __iter__(self) -> Iterator[str]:
        return iter(cloud.name for cloud in self.clouds)

    def __len__(self) -> int:
        return len(self.clouds)

    def __repr__(self) -> str:
        return f"<{len(self)} {self.kind} of {self.volume}: {', '.join(self)}>"

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = True, **how: Any) -> int:
        """Write a page of all, or a file of each and their index.

        Args:
            path: a page (``.html``); or a name with a place for each one's (``{}``, of frames ``{:04d}``, too), which
                without one comes behind it: ``x_{}.ply`` of ``x.ply``. The index is then ``x_index.json``.
            overwrite: replace files that exist.
            **how: frame, up, sh_degree and comments of the files, as of `Result.save`.

        Returns:
            Bytes written, without the index.

        Raises:
            UsageError: a file that exists, two of one name, a value that is none of these; before anything is written.
            DataError: a library that the format needs is not installed.
        """
        name = os.fspath(path)
        if is_page(name) and not is_pattern(name):
            return self._page(name, overwrite, how)
        if not is_pattern(name):
            known = format_of(name)
            suffix = known.suffix if known else Path(name).suffix
            name = f"{name[: len(name) - len(suffix)]}_{{}}{suffix}"
        files = [self._named(name, cloud) for cloud in self.clouds]
        index = index_output(name)
        check_outputs([*(Output("save", file, SUFFIXES, splats=True) for file in files), index], [], overwrite)
        rows, total = [], 0
        for cloud, file in zip(self.clouds, files, strict=True):
            size = cloud.save(file, overwrite=overwrite, **how)
            row = entry(cloud.name, len(cloud.gaussians), size, psnr_of(cloud.report), **cloud.facts)
            rows.append({**row, "file": beside(file, Path(index.path).parent)})
            total += size
        write_index(index.path, index_of(self.kind, self.volume, rows, **self.facts), overwrite)
        return total

    def recolor(self, look: str | TransferFunction | None = None, **how: Any) -> Clouds:
        """All of them under one other function, of clouds that carry values: `Result.recolor` of each.

        Args:
            look: file, colour map's name, or a function; None: that which they have.
            **how: range, unit_distance, labels and light, as of `Result.recolor`.

        Raises:
            DataError, UsageError: as `Result.recolor`.
        """
        found = []
        for cloud in self.clouds:
            other = cloud.recolor(look, **how)
            found.append(replace(cloud, gaussians=other.gaussians, report=other.report, ply=other.ply, directions=None))
        return replace(self, clouds=found)

    def _named(self, pattern: str, cloud: Cloud) -> str:
        """The file of a cloud."""
        places = FIELD.findall(pattern)
        if len(places) != 1 or (places[0] != "{}" and self.kind != FRAMES):
            what = "the frame's number, as out_{:04d}.ply" if self.kind == FRAMES else "the name, as out_{}.ply"
            raise UsageError(f"{pattern}: expected one place for {what}")
        told = places[0].format(int(cloud.stem) if self.kind == FRAMES else cloud.stem)
        return pattern.replace(places[0], told)

    def _page(self, path: str, overwrite: bool, how: dict[str, Any]) -> int:
        """All in one file."""
        if how:
            raise UsageError(f"{path}: a page shows the unit frame as it is; leave out {', '.join(how)}")
        with atomic_write(path, overwrite) as temporary:
            return temporary.write_bytes(self._html(path))

    def _html(self, name: str) -> bytes:
        """The page of all."""
        from vvgt_cli.gaussians.formats.page_live import page_of_several

        return page_of_several([(cloud.name, cloud.gaussians, cloud.ply) for cloud in self.clouds], name)

    def _repr_html_(self) -> str | None:
        """What notebooks show; see `Result`."""
        from vvgt_cli.gaussians.formats.page_file import framed

        try:
            return framed(self._html(self.volume), self.volume)
        except DataError:
            return None


def frames_in_memory(request: ConvertRequest, console: Console) -> Clouds:
    """The frames of a series (`vvgt_cli.conversion.series`), without files.

    Raises:
        DataError, UsageError: as `convert_series`.
    """
    steps = steps_of(request.source)
    request = with_blocks(request, steps, console)
    series = common(Run(console, ConversionReport("convert")), request, steps)
    clouds, carry = [], carries(request)
    for k, step in enumerate(steps):
        if series.dark[k]:
            console.say(f"{step.name}: nothing of it is visible; it is left out")
            continue
        one = replace(request, source=series.source_of(step))
        clouds.append(_cloud(one, console, step.name, str(k), {"frame": k, **step.facts()}, carry=carry))
    return Clouds(FRAMES, Path(request.source.path).name, clouds)


def looks_in_memory(requests: Mapping[str, ConvertRequest], volume: str, console: Console) -> Clouds:
    """One volume under several looks.

    Args:
        requests: by name.
        volume: its name.
        console: for messages.

    Raises:
        DataError, UsageError: as `convert`.
    """
    clouds = []
    for name, request in requests.items():
        stem = re.sub(r"[^0-9A-Za-z.]+", "-", name).strip("-.") or "function"
        clouds.append(_cloud(request, console, name, stem, {"function": name}))
    return Clouds(FUNCTIONS, volume, clouds)


def labels_in_memory(request: ConvertRequest, console: Console) -> Clouds:
    """The labels of a map (`vvgt_cli.conversion.labels`), without files.

    Raises:
        DataError, UsageError: as `convert_labels`.
    """
    run = Run(console, ConversionReport("convert"))
    whole = split(run, request)
    names = [part.label.name for part in whole.parts]
    clouds = []
    for part, gaussians in shared_out(run, whole):
        name = part.label.name if names.count(part.label.name) == 1 else part.stem
        clouds.append(_cloud(part.request, console, name, part.stem, part.facts(), gaussians))
    return Clouds(LABELS, whole.volume, clouds, {"table": whole.table})


def _cloud(
    request: ConvertRequest, console: Console, name: str, stem: str, facts: dict[str, Any],
    made: Gaussians | None = None, carry: Carry | None = None,
) -> Cloud:  # fmt: skip
    """A conversion of which the volume is let go of."""
    run = Run(console, ConversionReport("convert"))
    with opened(run, request) as volume:
        found: Conversion = run_conversion(run, request, volume, made, carry)
        normals = found.normals()
    run.finish()
    if interrupted(found.report):
        raise KeyboardInterrupt
    facts = facts | (carry.facts() if carry else {})
    return Cloud(found.gaussians, found.report, found.ply, name, stem, facts, normals)
