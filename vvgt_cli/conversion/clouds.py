"""Several clouds of one run in memory: frames of a series, one volume under several looks, or labels of a map."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.index import FRAMES, entry, index_output, is_pattern, put_name, shown_name, write_index
from vvgt_cli.conversion.result import Result
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import write_bytes
from vvgt_cli.gaussians.formats import SUFFIXES, format_of, is_page
from vvgt_cli.gaussians.formats.nodes import Node
from vvgt_cli.gaussians.formats.page_look import contents, page_of_several
from vvgt_cli.gaussians.formats.splats import splats_of
from vvgt_cli.gaussians.outputs import Output, check_outputs
from vvgt_cli.gaussians.story import Story, StoryLike, read_story
from vvgt_cli.score.record import Run

if TYPE_CHECKING:
    from vvgt_cli.gaussians.formats.page_values import Values
    from vvgt_cli.look.function import TransferFunction


SORTED = (
    "{}: programs that sort Gaussians node by node (three.js, Babylon.js: a .glb) show what a node encloses on top, "
    "or not at all"
)
NOT_IN_NODES = ("parents", "visible", "function")  # facts that the tree says itself, and the path of a file


@dataclass(repr=False)
class Cloud(Result):
    """One of several clouds, without its volume.

    Attributes:
        name: name among the others.
        stem: part of file names: a frame's number, a function's name, a label's number and name.
        facts: entries of the index.
        directions: normals (K, 3) for a `.ply`, unit frame; None for zeros.
        held: values of its volume, for a page of all clouds; None where they are left out.
    """

    name: str
    stem: str
    facts: dict[str, Any]
    directions: np.ndarray | None
    held: Values | None = None

    def shown_name(self) -> str:
        """Return the name in the list of a page."""
        return shown_name(self.name, self.facts)

    def normals(self) -> np.ndarray | None:
        """Implement `Result.normals`."""
        return self.directions


@dataclass(frozen=True, repr=False, eq=False)
class Clouds(Mapping[str, Result]):
    """Results by name, in order.

    Attributes:
        kind: "frames", "functions" or "labels".
        volume: name of the volume.
        clouds: the results.
        facts: entries of the index.
    """

    kind: str
    volume: str
    clouds: Sequence[Cloud]
    facts: dict[str, Any] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Result:
        """Return the result of a name."""
        for cloud in self.clouds:
            if cloud.name == name:
                return cloud
        raise KeyError(f"{name}: expected one of {', '.join(self)}")

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(cloud.name for cloud in self.clouds)

    def __len__(self) -> int:
        """Return the number of clouds."""
        return len(self.clouds)

    def __repr__(self) -> str:
        """Return kind, volume and names."""
        return f"<{len(self)} {self.kind} of {self.volume}: {', '.join(self)}>"

    def save(
        self, path: str | os.PathLike[str], *, story: StoryLike | None = None, overwrite: bool = True, **how: Any
    ) -> int:  # fmt: skip
        """Write one file of all clouds, or a file of each with an index.

        Args:
            path: a page (``.html``); unless they are frames, a file with a node of each (``.glb``, ``.usdc``,
                ``.usdz``); or a pattern with a place for the name (``{}``, for frames also ``{:04d}``, ``{step}``,
                ``{time}`` and ``{stem}``), where
                ``x.ply`` means ``x_{}.ply``. The index is ``x_index.json``.
            story: for pages to tell; see `Result.save`.
            overwrite: replace files that exist.
            **how: frame, up, sh_degree and comments of the files; see `Result.save`.

        Returns:
            Number of bytes written, without the index.

        Raises:
            UsageError: a file exists, two share a name, or a value is invalid; raised before anything is written.
            DataError: a library that the format needs is not installed.
        """
        name = os.fspath(path)
        if is_page(name) and not is_pattern(name):
            return self._page(name, story, overwrite, how)
        how |= {} if story is None else {"story": story}
        known = format_of(name)
        if not is_pattern(name) and known and known.write_nodes and self.kind != FRAMES:
            check_outputs([Output("save", name, SUFFIXES, splats=True)], [], overwrite)
            if odd := sorted(set(how) - {"frame", "up", "sh_degree", "comments"}):
                raise UsageError(f"{name}: {', '.join(odd)}: not for one file of several clouds")
            return write_bytes(name, known.write_nodes(self.nodes(**how), name), overwrite)
        if not is_pattern(name):
            suffix = known.suffix if known else Path(name).suffix
            name = f"{name[: len(name) - len(suffix)]}_{{}}{suffix}"
        files = [put_name("save", name, self.kind, cloud.stem, cloud.facts) for cloud in self.clouds]
        index = index_output(name)
        check_outputs([*(Output("save", file, SUFFIXES, splats=True) for file in files), index], [], overwrite)
        rows, total, folder = [], 0, Path(index.path).parent
        for cloud, file in zip(self.clouds, files, strict=True):
            size = cloud.save(file, overwrite=overwrite, **how)
            beside = Path(os.path.relpath(file, folder)).as_posix()
            rows.append(entry(cloud.name, len(cloud.gaussians), size, cloud.report, cloud.facts, beside))
            total += size
        write_index(index.path, self.kind, self.volume, rows, self.facts, overwrite)
        return total

    def nodes(self, sh_degree: int | None = None, **how: Any) -> list[Node]:
        """Return the clouds as nodes of one file, with what is known of them unless it has no comments.

        Args:
            sh_degree: of all of them; None: that of their files, else the highest.
            **how: frame, up and comments; see `Result.save`.
        """
        degree = max(cloud.gaussians.degree for cloud in self.clouds)
        nodes = []
        for cloud in self.clouds:
            ply = cloud.layout(sh_degree=sh_degree, **how)
            ply = replace(ply, live=None, sh_degree=degree if ply.sh_degree is None else ply.sh_degree)
            splats = splats_of(replace(cloud.gaussians, live=None), ply)
            facts = {key: value for key, value in cloud.facts.items() if key not in NOT_IN_NODES and ply.comments}
            place = tuple(cloud.facts.get("parents", ())), facts, cloud.facts.get("visible", True)
            nodes.append(Node(cloud.name, splats, *place))
        return nodes

    def recolor(self, look: str | TransferFunction | None = None, **how: Any) -> Clouds:
        """Return all live clouds under another function: `Result.recolor` of each.

        Args:
            look: file, colour map's name, or a function; None: their own.
            **how: tf_range, opacity_unit_distance, labels and light; see `Result.recolor`.

        Raises:
            DataError, UsageError: see `Result.recolor`.
        """
        shown = []
        for cloud in self.clouds:
            other = cloud.recolor(look, **how)
            dropped = replace(cloud, directions=None, held=None)  # values come with the old look
            shown.append(replace(dropped, gaussians=other.gaussians, report=other.report, ply=other.ply))
        return replace(self, clouds=shown)

    def _page(self, path: str, story: StoryLike | None, overwrite: bool, how: dict[str, Any]) -> int:
        """Write one page of all clouds."""
        if how:
            raise UsageError(f"{path}: a page shows the unit frame unchanged; remove {', '.join(how)}")
        told = None if story is None else read_story(story).checked((), len(self.clouds))
        return write_bytes(path, self._html(path, told), overwrite)

    def _html(self, name: str, story: Story | None = None) -> bytes:
        """Return one page of all clouds."""
        plys = [cloud.ply if story is None else replace(cloud.ply, story=story) for cloud in self.clouds]
        shown = [(cloud.shown_name(), cloud.gaussians, ply) for cloud, ply in zip(self.clouds, plys, strict=True)]
        return page_of_several(shown, name, [cloud.held for cloud in self.clouds])

    def _repr_html_(self) -> str | None:
        """Return the page for a notebook; None where a library is missing."""
        from vvgt_cli.gaussians.formats.page_file import iframe

        try:
            return iframe(self._html(self.kind), self.kind)
        except DataError:
            return None


def write_together(run: Run, clouds: Clouds, output: str, overwrite: bool) -> None:
    """Write one file of all clouds by a stage of a run, and report what it holds; errors are those of `Clouds.save`."""
    with run.stage("write") as stage:
        run.report.bytes = clouds.save(output, overwrite=overwrite)
        run.report.gaussians = sum(len(cloud.gaussians) for cloud in clouds.clouds)
        size = f"{run.report.gaussians} Gaussians, {run.report.bytes / 1e6:.1f} MB"
        stage.note = f"{output}: {len(clouds)} clouds, {size}"
    first, names = clouds.clouds[0], [cloud.shown_name() for cloud in clouds.clouds]
    page = is_page(output)
    run.console.message(contents(first.ply, output, names, first.held) if page else SORTED.format(output))
