"""Requests of conversions: options, limits, inputs and outputs."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from vvgt_cli.conversion.place import AUTO
from vvgt_cli.defaults import INIT, MAX_GAUSSIANS, RULE, SIZE
from vvgt_cli.errors import UsageError
from vvgt_cli.field.settings import MANY, BlockOptions
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.files import is_stream
from vvgt_cli.gaussians import PlyOptions
from vvgt_cli.gaussians.formats import SUFFIXES, format_of, is_page
from vvgt_cli.gaussians.formats.page_file import page_bytes
from vvgt_cli.gaussians.formats.page_values import SMALLEST as SMALLEST_VALUES
from vvgt_cli.gaussians.formats.streamed import MANIFEST, is_streamed
from vvgt_cli.gaussians.outputs import STDOUT, Output
from vvgt_cli.gaussians.story import Story
from vvgt_cli.gaussians.targets import target_of

VERTEX_BYTES = 68  # x y z, normals, three colours, opacity, three scales, four of rotation: float32
HARMONIC_BYTES = {0: 0, 1: 36, 2: 96, 3: 180}  # by degree
HEADER_BYTES = {0: 3600, 1: 3800, 2: 4200, 3: 4800}  # a legend takes up to 2500


@dataclass(frozen=True)
class FitOptions:
    """Options of the fit: budget, screen, method, steps, and limits of error, time and size.

    Attributes:
        max_gaussians: maximum number of Gaussians.
        screen: pixels along the edge of the screen that the file is made for.
        init: "moments", "wavelet" or "uniform".
        rule: drawing rule (`vvgt_cli.gaussians.rules`) that is fitted to and scored by.
        seed: seed of random numbers.
        model: network that runs before the steps, a folder or the name of a shipped one; None for none.
        steps: maximum number of steps of gradient descent; None: the default.
        device: "cpu", or "cuda" for views and steps.
        target: name of the device that the file is made for (`vvgt_cli.gaussians.targets`), None for none.
        target_psnr: PSNR (dB) on the check views at which to stop.
        time_budget: wall seconds of the whole run, from the start of reading on.
        max_megabytes: maximal size of the file, 10^6 bytes.

    Raises:
        UsageError: a limit is out of range.
    """

    max_gaussians: int = MAX_GAUSSIANS
    screen: int = SIZE
    init: str = INIT
    rule: str = RULE
    seed: int = 0
    steps: int | None = None
    model: str | None = None
    device: str = "cpu"
    target: str | None = None
    target_psnr: float | None = None
    time_budget: float | None = None
    max_megabytes: float | None = None

    def __post_init__(self) -> None:
        """Check the limits; take whole numbers such as 1e5 for integers."""
        for name in ("max_gaussians", "screen", "steps", "seed"):
            given = getattr(self, name)
            if given is not None or name != "steps":
                with suppress(TypeError, ValueError, OverflowError):  # of text, lists, NaN and infinity
                    object.__setattr__(self, name, int(given))
                if not isinstance(now := getattr(self, name), int) or now != given:
                    raise UsageError(f"{name} {given!r}: expected a whole number")
        if self.target_psnr is not None and not 0 <= self.target_psnr <= 150:
            raise UsageError(f"--target-psnr {self.target_psnr:g}: expected 0 to 150 dB")
        if self.time_budget is not None and not 0 < self.time_budget < math.inf:
            raise UsageError(f"--time-budget {self.time_budget:g}: expected more than 0 seconds")
        if self.max_megabytes is not None and not 0 < self.max_megabytes < math.inf:
            raise UsageError(f"--max-megabytes {self.max_megabytes:g}: expected more than 0 MB")

    @property
    def ended(self) -> bool:
        """Return whether a target or a time budget ends descent."""
        return self.target_psnr is not None or self.time_budget is not None

    @classmethod
    def of(cls, target: str | None = None, **given: Any) -> FitOptions:
        """Return the options that are given and not None; others are the target's, or the defaults.

        Raises:
            UsageError: there is no such target.
        """
        device = target_of(target)
        names = ("max_gaussians", "screen", "rule") if device else ()
        known = {name: getattr(device, name) for name in names}
        return cls(target=target, **known | {name: value for name, value in given.items() if value is not None})


def file_bytes(gaussians: int, sh_degree: int) -> int:
    """Return the maximal size of a `.ply` in bytes."""
    return HEADER_BYTES[sh_degree] + gaussians * (VERTEX_BYTES + HARMONIC_BYTES[sh_degree])


@dataclass(frozen=True)
class ConvertRequest:
    """A whole conversion.

    Attributes:
        source: volume and look to read.
        output: file to write, any of `vvgt_cli.gaussians.formats`, "-" for a `.ply` on standard output, None for none.
        fit: options of the fit, and limits of error, time and size.
        ply: layout of the file; up, the volume's place and the unit distance follow from the source.
        up: world axis or anatomical direction that viewers show upwards, "none", or "auto" (superior in the unit frame
            of an anatomical space).
        report: JSON to write, "-" for standard output, None for none.
        preview: PNG to write (reference, ours, difference of a few test views), None for none.
        overwrite: replace existing files.
        checkpoint: folder for the results of stages until the output is written; None for none.
        blocks: how the volume is processed in blocks; None: blocks only where the volume is large.
        live: let the Gaussians carry values, so that they can be shown under any function (docs/live.md).
        values: a page also holds the values of the volume.
        command: command line that the file records; None from Python.
        title: title of pages; None: what is shown, or the name of an example.
        story: of pages, not yet checked against the volume.
        scored: score the result, for which views are rendered; without, it is the closed form alone.
        all_views: score on all ten test views, by SSIM and FLIP too, as with a report.
        shares_output: the output holds other clouds, too, so a device's limit of bytes does not apply.
    """

    source: SourceRequest
    output: str | None = None
    fit: FitOptions = field(default_factory=FitOptions)
    ply: PlyOptions = field(default_factory=PlyOptions)
    up: str = AUTO
    report: str | None = None
    preview: str | None = None
    overwrite: bool = False
    checkpoint: str | None = None
    live: bool = False
    values: bool = False
    scored: bool = True
    all_views: bool = False
    shares_output: bool = False
    command: str | None = None
    title: str | None = None
    story: Story | None = None
    blocks: BlockOptions | None = None

    def budget(self, degree: int | None = None) -> int:
        """Return the number of Gaussians that the limits allow; values of a page get what these leave.

        Args:
            degree: of the harmonics; None: the degree that was asked for.

        Raises:
            UsageError: not even one fits, or the size limit is neither for a `.ply` nor for a page.
        """
        degree, known = (self.ply.sh_degree or 0) if degree is None else degree, format_of(self.output or "")
        if is_page(self.output):
            header, each = page_bytes(degree)
            header += (SMALLEST_VALUES if self.values else 0) + (self.story.size if self.story else 0)
        elif self.fit.max_megabytes is not None and (known is not None or is_streamed(self.output)):
            raise UsageError(
                f"--max-megabytes needs .ply or .html output; got -o {self.output}; try --max-gaussians instead"
            )
        else:
            header, each = file_bytes(0, degree), file_bytes(1, degree) - file_bytes(0, degree)
        if self.megabytes is None:
            return self.fit.max_gaussians
        room = int((self.megabytes * 1e6 - header) // each)
        if room < 1:
            least = (header + each) / 1e6
            raise UsageError(f"--max-megabytes {self.megabytes:g}: no Gaussian fits; expected {least:.4f} MB or more")
        return min(self.fit.max_gaussians, room)

    @property
    def megabytes(self) -> float | None:
        """Return the limit of the file's size: the given one, or the target's for files that have such a limit."""
        target, known = target_of(self.fit.target), format_of(self.output or "")
        if self.fit.max_megabytes is not None or target is None:
            return self.fit.max_megabytes
        limited = not self.live if known is None else is_page(self.output)
        return target.megabytes if limited and not (self.shares_output or is_streamed(self.output)) else None

    @property
    def scored_whole(self) -> bool:
        """Return whether all ten test views are scored."""
        return self.all_views or self.report is not None

    @property
    def writes(self) -> int:
        """Return how often the output is written: before and after scoring; once for pipes and with a checkpoint."""
        if self.output is None:
            return 0
        once = not self.scored or self.output == STDOUT or is_stream(self.output) or self.checkpoint is not None
        return 1 if once else 2

    def outputs(self) -> list[Output]:
        """List the files that will be written."""
        endings = (MANIFEST,) if is_streamed(self.output) else SUFFIXES
        outputs = [Output("-o", self.output, endings, splats=True)] if self.output else []
        if self.report:
            outputs.append(Output("--report", self.report, (".json",), binary=False))
        if self.preview:
            outputs.append(Output("--preview", self.preview, (".png",)))
        return outputs

    @property
    def out_of_core(self) -> bool:
        """Return whether Gaussians are made part by part where the volume is processed in blocks.

        Levels are, the closed form alone, and more Gaussians than memory holds with their cells.
        """
        fit = self.fit
        if is_streamed(self.output) or self.live or fit.init != INIT:
            return is_streamed(self.output)
        whole = fit.model or fit.device != "cpu" or self.checkpoint or fit.steps == 0
        return not self.scored or (self.budget() > MANY and not whole)

    def inputs(self) -> list[str]:
        """List the files that are read."""
        return self.source.paths()
