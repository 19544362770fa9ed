"""`vvgt view`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.cli.options import (
    common_options,
    light_options,
    overwrite_option,
    placed_read_options,
    slices_option,
    tf_options,
    title_option,
)
from vvgt_cli.cli.sections import SectionedCommand
from vvgt_cli.progress import Console


@click.command("view", cls=SectionedCommand, short_help="Show Gaussians or a volume in a browser, or save a page.")
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
@click.option(
    "--no-live", "live", is_flag=True, default=True, flag_value=False,
    help="With -o OUT.html and a volume: omit the function editor, for a page half as large.",
)  # fmt: skip
@slices_option
@title_option
@tf_options
@light_options
@placed_read_options
@overwrite_option
@common_options
def command(
    files: tuple[str, ...], output: str | None, port: int | None, browser: bool, live: bool, slices: bool,
    title: str | None, read: dict[str, Any], optics: dict[str, Any], light: dict[str, Any], overwrite: bool,
    console: Console,
) -> None:  # fmt: skip
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
    from vvgt_cli.cli.fit import source_request
    from vvgt_cli.commands.view import ViewRequest, view
    from vvgt_cli.errors import UsageError

    if output is not None and (port is not None or not browser):
        raise UsageError("-o writes a file and starts no server; omit --port and --no-browser")
    if output is None and not (live and slices):
        raise UsageError("--no-live and --no-slices are for a page that is saved; give -o OUT.html, or omit them")
    source = source_request(files[0], read, optics, light)
    request = ViewRequest(files, source, output, port or 0, browser, overwrite, live, slices, title)
    view(request, click.echo, console)
