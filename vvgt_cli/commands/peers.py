"""Other trainers in a report: outside commands that read our views and write a file of Gaussians (docs/peers.md)."""

from __future__ import annotations

import shlex
import subprocess
from dataclasses import dataclass
from pathlib import Path

from vvgt_cli.commands.view_sets import Layout, camera_views, write_views
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run, StageRecord

VIEWS, OUT = "{views}", "{out}"  # in a command
TAIL = 200  # characters of a failed command's last line


@dataclass(frozen=True)
class Peer:
    """Another program.

    Attributes:
        name: for tables and charts.
        command: words, with `VIEWS` for the folder of views and `OUT` for the `.ply` to write.
    """

    name: str
    command: tuple[str, ...]

    @classmethod
    def of(cls, text: str) -> Peer:
        """Parse ``NAME=COMMAND``; raise UsageError without a name, or a place in the command for views and output."""
        name, _, command = text.partition("=")
        try:
            words = tuple(shlex.split(command))
        except ValueError as error:
            raise UsageError(f"--peer {text}: {error}; expected a command as a shell reads it") from None
        if not name.strip() or any(not any(place in word for word in words) for place in (VIEWS, OUT)):
            raise UsageError(
                f"--peer {text}: expected NAME=COMMAND with {VIEWS} (folder of views) and {OUT} (.ply to write) in it"
            )
        return cls(name.strip(), words)

    def words(self, views: Path, out: Path) -> list[str]:
        """Return the command with its places filled in."""
        return [word.replace(VIEWS, str(views)).replace(OUT, str(out)) for word in self.command]


@dataclass(frozen=True)
class PeerViews:
    """Views that every peer reads.

    Attributes:
        folder: written by `vvgt render-views`.
        count: training views.
        stage: time that they took.
    """

    folder: Path
    count: int
    stage: StageRecord

    @classmethod
    def render(
        cls, source: SourceRequest, folder: Path, count: int, size: int, blocks: BlockOptions | None
    ) -> PeerViews:
        """Render ``count`` training views of ``size`` px as PNG, with transforms.json, COLMAP and points to start from.

        Raises:
            DataError, UsageError: as `vvgt render-views`.
        """
        run = Run(Console(quiet=True), ConversionReport("report"))
        with run.stage("views") as stage:
            write_views(
                run, {"": source}, folder, camera_views("sphere", count, size=size), Layout("png"), blocks=blocks
            )
        return cls(folder, count, stage)


def train(peer: Peer, views: PeerViews) -> tuple[ConversionReport, Gaussians]:
    """Run a peer; return its report, timed with its views, and its Gaussians in the unit frame.

    Raises:
        UsageError: no such program.
        DataError: it fails, or writes no file of Gaussians.
    """
    folder = views.folder.parent
    out = folder / "peer.ply"
    out.unlink(missing_ok=True)
    run = Run(Console(quiet=True), ConversionReport("report"))
    run.report.stages.append(views.stage)
    with run.stage("training") as stage:
        try:
            done = subprocess.run(
                peer.words(views.folder, out), cwd=folder, stdin=subprocess.DEVNULL, capture_output=True
            )
        except OSError as error:
            raise UsageError(f"--peer {peer.name}: {peer.command[0]}: {error.strerror}; expected a program") from None
        stage.note = shlex.join(peer.command)
    if done.returncode or not out.is_file():
        output = (done.stderr.strip() or done.stdout.strip()).decode("utf-8", "replace").splitlines()
        why = f"exit status {done.returncode}" if done.returncode else f"left no {OUT}"
        last = f": {output[-1][-TAIL:]}" if output else ""
        raise DataError(f"--peer {peer.name}: {why}{last}; expected a .ply of Gaussians; run it alone to see why")
    gaussians, _ = open_gaussians(str(out))
    run.report.gaussians, run.report.bytes = len(gaussians), out.stat().st_size
    return run.finish(), gaussians
