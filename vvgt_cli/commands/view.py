"""`vvgt view`: Gaussians or a volume shown in a browser, or written in another format."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Unpack

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.errors import UsageError

if TYPE_CHECKING:
    from vvgt_cli.gaussians.story import StoryLike
    from vvgt_cli.library.inputs import LookLike, PathLike, Reading
    from vvgt_cli.progress import Console


def view(
    files: PathLike | Sequence[PathLike], look: LookLike = None, *, output: PathLike | None = None,
    port: int | None = None, browser: bool = True, values: bool = True, title: str | None = None,
    story: StoryLike | None = None, overwrite: bool = False, progress: bool | Console = False,
    **reading: Unpack[Reading],
) -> None:  # fmt: skip
    """Show files of Gaussians or a volume in a browser until an interrupt, or write them: ``vvgt view``.

    Args:
        files: of Gaussians, globs of them, or indexes of ``vvgt convert``; several are a series. Or one volume, or one
            series of volumes: a glob, or a file of several time steps.
        look: of a volume, as in `convert`.
        output: file to write instead of showing.
        port: of the server; None takes a free one. Its address is printed.
        browser: open one, if there is a display.
        values: let a page of a volume hold its values, for slices and other looks.
        title: of the page that is written; None: the file's own.
        story: for the page to tell, a story.json or its content (docs/page.md).
        overwrite: replace the output if it exists.
        progress: print messages on standard error.
        **reading: of a volume, as in `convert`.

    Raises:
        UsageError: several volumes, options of volumes with files of Gaussians, or a port or an output that cannot be
            used.
        DataError: a file that is not valid.
    """
    from vvgt_cli.commands import viewer
    from vvgt_cli.conversion.index import named_files
    from vvgt_cli.gaussians.formats import is_page
    from vvgt_cli.gaussians.story import read_story
    from vvgt_cli.library.inputs import console_of, source_of
    from vvgt_cli.score.record import ConversionReport, Run

    if output is not None and (port is not None or not browser):
        raise UsageError("-o writes a file and starts no server; omit --port and --no-browser")
    if output is None and (title or not values):
        option = "--no-values" if not values else "--title"
        raise UsageError(f"{option} is for a page that is saved; give -o OUT.html, or omit it")
    if story is not None and not is_page(output):
        raise UsageError("--story is for a page that is saved; give -o OUT.html, or omit it")
    told = None if story is None else read_story(story)
    names = [files] if isinstance(files, str | os.PathLike) else files
    clouds, run = named_files([os.fspath(name) for name in names]), Run(console_of(progress), ConversionReport("view"))
    source = source_of(clouds[0][1], look, reading)
    if output is None:
        viewer.show(run, clouds, source, port or 0, browser, click.echo)
    else:
        viewer.save(run, clouds, source, os.fspath(output), values=values, title=title, story=told, overwrite=overwrite)


@shared.command("view", short_help="Show Gaussians or a volume in a browser, or save a page.")
@click.argument("files", metavar="FILE...", nargs=-1, required=True)
@click.option(
    "-o", "--output", metavar="OUT.html",
    help="Save a page that works offline, or another format by its ending, instead of showing.",
)  # fmt: skip
@click.option(
    "--port", type=click.IntRange(1, 65535), metavar="N", help="Port of the local server. Default: any free port."
)
@click.option(
    "--no-browser", "browser", is_flag=True, default=True, flag_value=False,
    help="Print the address without opening a browser.",
)  # fmt: skip
@shared.values_option
@shared.title_option
@shared.story_option
@shared.tf_options
@shared.light_options
@shared.placed_read_options
@shared.overwrite_option
@shared.common_options
def command(**options: Any) -> None:
    """Show FILE in a browser: Gaussians in any supported format, or a volume.

    A volume appears within seconds. If its transfer function is changed in the page, the volume is converted for it in
    the background.

    A server on 127.0.0.1 serves the page to the browser and nobody else; nothing is loaded from the network. The
    address is printed; Ctrl-C stops the server. Several files, a glob, or an index written by convert form a series
    with a slider. A series of volumes (a quoted glob, or a file of several time steps) is converted first, refined only
    with -o.

    A folder with a lod-meta.json is streamed: near parts load in fine detail, far ones coarsely. FOLDER#1 is level 1
    alone.

    With -o, nothing is shown: OUT.html holds viewer and Gaussians and opens by double click; .spz, .compressed.ply,
    .sog, .glb, .usdc and .usdz are for other programs. The loss due to the format is printed.

    Examples:
      vvgt view frog.ply
      vvgt view example:frog
      vvgt view head.nrrd --tf bone.json
      vvgt view head_index.json
      vvgt view 'run_*.vti' --tf viridis
      vvgt view 'run/*.ply' --port 8000 --no-browser
      vvgt view frog.ply -o frog.html
    """
    view(**shared.arguments(**options))
