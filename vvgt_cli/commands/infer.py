"""`infer`: Gaussians improved by an exported network, kept if the views agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from vvgt_cli.cameras import Camera
from vvgt_cli.conversion.gaussian_files import layout_of, open_gaussians, write_gaussians
from vvgt_cli.gaussians.outputs import Output, claimed, write_text
from vvgt_cli.jit.ahead import INFER
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.score.views import Views

SHIPPED = "vvgt-small"  # the model that comes with the program
JUDGES = 4  # views that the network is not shown, as many as the default check set


@dataclass(frozen=True)
class InferRequest:
    """A run of a network.

    Attributes:
        ply: Gaussians, "-" for standard input.
        views: folder that `vvgt render-views` wrote.
        model: folder of a model, or the name of one that is shipped.
        output: the .ply to write, "-" for standard output.
        provider: "cpu" or "cuda".
        report: JSON to write, or None.
        overwrite: replace files that exist.
    """

    ply: str
    views: str
    model: str
    output: str
    provider: str = "cpu"
    report: str | None = None
    overwrite: bool = False


def divide(cameras: Sequence[Camera], wanted: int) -> tuple[list[int], list[int]]:
    """Return the indices of the views that the network reads, and of those that judge it.

    The judges are other views, as far apart as possible; if there are none, the views that it reads.
    """
    from vvgt_cli.cameras import farthest_cameras

    read = farthest_cameras(cameras, wanted)
    others = [i for i in range(len(cameras)) if i not in read]
    judges = [others[i] for i in farthest_cameras([cameras[i] for i in others], JUDGES)] if others else read
    return read, judges


def infer_file(request: InferRequest, console: Console | None = None) -> ConversionReport:
    """Improve a `.ply` with a network and write it; if the judging views show no gain, write the input's Gaussians.

    Raises:
        UsageError: an output that may not be written, or an unknown model or provider.
        DataError: Gaussians, views or a model that are not valid.
    """
    outputs = [Output("-o", request.output, (".ply",))]
    if request.report:
        outputs.append(Output("--report", request.report, (".json",), binary=False))
    with claimed(outputs, [request.ply], request.overwrite):
        return _infer_file(request, Run(console or Console(), ConversionReport("infer")))


def _infer_file(request: InferRequest, run: Run) -> ConversionReport:
    import numba

    from vvgt_cli.images.files import load_views
    from vvgt_cli.network.card import find_model
    from vvgt_cli.network.runtime import Model

    with run.stage("read") as stage:
        model = Model.open(find_model(request.model), numba.get_num_threads(), request.provider)
        gaussians, header = open_gaussians(request.ply)
        cameras, images = load_views(request.views, "train")
        wanted = model.card.network.total_views
        read, judges = divide(cameras, wanted)
        stage.note = f"{len(gaussians)} Gaussians, {len(cameras)} views, model {model.card.name}"
    run.compile(INFER)
    with run.stage("network") as stage:
        shown = [cameras[i] for i in read]
        better = model.improve(gaussians, shown, images[read], progress=run.console.bar("network"))
        stage.note = f"reads {len(read)} views"
    with run.stage("judge") as stage:
        before, after = map(Views(cameras, images).take(judges).psnr, (gaussians, better))
        stage.psnr, stage.kept = after, after > before
        own = "" if set(judges) - set(read) else ", all read by the network"
        stage.note = f"from {before:.2f} dB on {len(judges)} views{own}"
    run.report.options = {
        "model": model.card.name,
        "provider": request.provider,
        "read": [cameras[i].name for i in read],
        "judges": [cameras[i].name for i in judges],
        "psnr_before": before,
        "psnr_after": after,
    }
    kept = better if stage.kept else gaussians
    write_gaussians(run, request.output, kept, replace(layout_of(header), certificate=None), request.overwrite)
    report = run.finish()
    if request.report:
        write_text(request.report, report.to_json(), request.overwrite)
    return report
