"""Gaussians or a volume shown in a browser by a local server, or written in another format."""

from __future__ import annotations

import os
import sys
import tempfile
import time
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from vvgt_cli.commands.converter import Converter
from vvgt_cli.commands.live_site import BYTES, HTML, JSON, SCRIPT, PageController, plain_name, stored
from vvgt_cli.commands.server import Resource, Site, served
from vvgt_cli.conversion.clouds import Cloud, Clouds, write_together
from vvgt_cli.conversion.gaussian_files import STDIN, layout_of, open_gaussians, read_back, write_gaussians
from vvgt_cli.conversion.index import FRAMES, is_pattern, named_files
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import PlyHeader, PlyOptions
from vvgt_cli.gaussians.formats import SUFFIXES, is_page, is_splats
from vvgt_cli.gaussians.formats.page_file import PROGRAM, VIEWER, asked, asset, camera, farthest, page
from vvgt_cli.gaussians.formats.sog import IMAGES, META
from vvgt_cli.gaussians.formats.splats import columns_of
from vvgt_cli.gaussians.formats.streamed import MANIFEST, corners, is_streamed, placed, read_manifest
from vvgt_cli.gaussians.outputs import Output, claimed
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.gaussians.story import Story
from vvgt_cli.jit.ahead import DRAW, for_degree
from vvgt_cli.score.record import Run

TICK = 0.2  # seconds within which Ctrl-C is answered
SOON = 10.0  # seconds of reading after which a page is shown that waits; earlier failures are reported without one
LINGER = 1.0  # seconds in which such a page hears why nothing comes


Named = Sequence[tuple[str, str]]  # name and file of each


def save(
    run: Run, clouds: Named, source: SourceRequest, output: str, *, values: bool, title: str | None,
    story: Story | None, overwrite: bool,
) -> None:  # fmt: skip
    """Write Gaussians, or a volume that is converted, as `vvgt_cli.view` does."""
    from vvgt_cli.conversion.convert_batch import convert_all
    from vvgt_cli.conversion.request import ConvertRequest

    file = clouds[0][1]
    if len(clouds) > 1:
        _join(run, output, clouds, source, title, story, overwrite)
    elif file != STDIN and not is_splats(file):
        if not is_page(output) and _is_series(source):
            raise UsageError(f"-o {output}: holds one frame; expected a page (.html), or --time N")
        request = ConvertRequest(source, output, values=values, title=title, story=story, overwrite=overwrite)
        convert_all({"": request}, console=run.console)
    else:
        with claimed([Output("-o", output, SUFFIXES, splats=True)], [file], overwrite):
            _refuse_reading(source, file)
            gaussians, header = open_gaussians(file)
            options = _layout(header, title, story and story.checked(()))
            write_gaussians(run, output, gaussians, options, overwrite)
            run.compile(for_degree(DRAW, gaussians.degree))
            read_back(run, output, gaussians, options)


def show(
    run: Run, clouds: Named, source: SourceRequest, port: int, browser: bool, announce: Callable[[str], None]
) -> None:  # fmt: skip
    """Show Gaussians or a volume until an interrupt; ``announce`` is called with the page's URL when it can be opened.

    The server takes a free port for 0.
    """
    from vvgt_cli.conversion.convert_batch import convert_all
    from vvgt_cli.conversion.request import ConvertRequest, FitOptions

    if len(clouds) > 1 or not _is_series(source):
        _serve(run, clouds, source, port, browser, announce)
        return
    with tempfile.TemporaryDirectory(prefix="vvgt-") as folder:
        quick = ConvertRequest(source, os.path.join(folder, "{}.ply"), FitOptions(steps=0))
        convert_all({"": quick}, console=run.console)
        frames = named_files(sorted(map(str, Path(folder).glob("*index.json"))))
        _serve(run, frames, SourceRequest(source.path), port, browser, announce)


def _is_series(source: SourceRequest) -> bool:
    """Return whether a volume is several frames: a glob of files, or a file of several time steps."""
    from vvgt_cli.conversion.frames import is_glob_of_volumes, list_steps

    if source.path == STDIN or is_splats(source.path) or is_streamed(source.path):
        return False
    return is_glob_of_volumes(source) or (
        os.path.isfile(source.path) and source.read.time is None and len(list_steps(source)) > 1
    )


def _join(
    run: Run, output: str, clouds: Named, source: SourceRequest, title: str | None, story: Story | None, overwrite: bool
) -> None:  # fmt: skip
    """Write several files into one page."""
    files = [file for _, file in clouds]
    _only_gaussians(files)
    _refuse_reading(source, files[0])
    if not is_page(output):
        raise UsageError(
            f"-o {output}: got {len(files)} files; expected a page (.html), which holds several "
            "(one .glb, .usdc or .usdz of several labels is written by 'vvgt convert MAP --split-labels')"
        )
    if is_pattern(output):
        raise UsageError(f"-o {output}: one page shows all files; use a name without braces")
    with claimed([Output("-o", output, (".html",), splats=True)], files, overwrite):
        names = [name for name, _ in clouds]
        names = names if len(set(names)) == len(names) else files
        shown, told, rules = list[Cloud](), story and story.checked((), len(files)), set[str]()
        for name, file in zip(names, files, strict=True):
            gaussians, header = open_gaussians(file)
            layout = _layout(header, title, told)
            shown.append(Cloud(gaussians, run.report, layout, name, name, {}, None))
            rules.add(header.rule or INRIA.name)
        if len(rules) > 1:
            made = ", ".join(sorted(rules))
            run.console.message(f"{output}: made for {made}; the page draws all by the rule of the first")
        write_together(run, Clouds(FRAMES, output, shown), output, overwrite)


def _refuse_reading(given: SourceRequest, name: str) -> None:
    """Refuse options for volumes with a file of Gaussians."""
    if given != SourceRequest(given.volume):
        raise UsageError(
            f"{name} holds Gaussians; --tf, --labels, --layer, light and reading options are for volumes only: omit "
            "them ('vvgt recolor' relights live files)"
        )


def _only_gaussians(files: Sequence[str]) -> None:
    """Refuse several files that are not all ordinary files of Gaussians."""
    if any(map(is_streamed, files)):
        first = next(filter(is_streamed, files))
        raise UsageError(f"{first}: streamed levels are shown alone; open one, as 'vvgt view {Path(first).parent}'")
    volumes = [name for name in files if name != STDIN and not is_splats(name)]
    if len(files) > 1 and (volumes or STDIN in files):
        raise UsageError(
            f"{(volumes or [STDIN])[0]}: not Gaussians; expected files of Gaussians, or one volume: for a series of "
            "volumes, quote the pattern so that the shell does not expand it, as 'run_*.vti'"
        )


def _layout(header: PlyHeader, title: str | None, story: Story | None) -> PlyOptions:
    """Return how Gaussians are written again, with a title, if it is given, and a story."""
    layout = layout_of(header)
    return replace(layout, title=title or layout.title, story=story)


def _serve(
    run: Run, clouds: Named, source: SourceRequest, port: int, browser: bool, announce: Callable[[str], None]
) -> None:
    files = [file for _, file in clouds]
    if len(files) > 1:
        _only_gaussians(files)
    resources = {"viewer.js": Resource("text/javascript; charset=utf-8", lambda: asset(PROGRAM), packed=True)}
    site = Site(resources, run.console.message)
    controller = PageController(site.resources, site.posts, plain_name(files[0]), run.console)
    with ExitStack() as stack:
        stack.enter_context(suppress(KeyboardInterrupt))
        if given := files[0] == STDIN or is_splats(files[0]):
            _refuse_reading(source, files[0])
        if is_streamed(files[0]):
            resources |= streamed_resources(files[0])
        elif len(files) > 1:
            resources |= _series(clouds)
        elif given:
            gaussians, header = open_gaussians(files[0])
            controller.show(gaussians, layout_of(header))
        url = stack.enter_context(served(site, port))
        if not resources.get(""):
            converter = stack.enter_context(Converter(source, controller.name, controller.on_message))
            controller.await_volume(converter)
            controller.ready.wait(SOON)
        if controller.error is None:
            announce(url)
            opened = browser and display() and webbrowser.open(url)
            run.console.message(f"{'shown in a browser' if opened else 'open this address in a browser'}; Ctrl-C stops")
        while controller.error is None:
            time.sleep(TICK)  # a signal may reach another thread, which wakes nobody here
        if controller.waited_for:
            time.sleep(LINGER)
        raise controller.error


def _series(clouds: Named) -> dict[str, Resource]:
    """Return the page of several files, and each file, read when it is requested."""

    def content(k: int) -> bytes:
        gaussians, header = open_gaussians(clouds[k][1])
        return stored(gaussians, layout_of(header))

    first, frames = content(0), [{"name": name, "file": f"{k}.ply"} for k, (name, _) in enumerate(clouds)]
    text = page(clouds[0][0], columns_of(first, clouds[0][1]), frames, SCRIPT)
    resources = {f"{k}.ply": Resource(BYTES, partial(content, k)) for k in range(len(clouds))}
    return resources | {"": Resource(HTML, lambda: text.encode("utf-8")), "0.ply": Resource(BYTES, lambda: first)}


def display() -> bool:
    """Return whether a browser would have a screen; without one `webbrowser` may start a text browser."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def streamed_resources(file: str) -> dict[str, Resource]:
    """Return the resources by name; "" is the page.

    Raises:
        DataError: not a manifest, or a file that it names is missing.
    """
    manifest, folder = read_manifest(file), Path(file).parent
    resources = {MANIFEST: Resource(JSON, Path(file).read_bytes)}
    for name in manifest["filenames"]:
        if not (folder / name).is_file():
            raise DataError(f"{file}: {folder / name} is missing; expected the whole folder")
        resources[name] = Resource(JSON, (folder / name).read_bytes)
        for image in IMAGES:
            path = (folder / name).with_name(f"{image}.webp")
            resources[f"{name.removesuffix(META)}{path.name}"] = Resource("image/webp", partial(path.read_bytes))
    splats, scale = placed(manifest)
    view = camera(splats)
    view |= {key: [scale * x for x in view[key]] for key in ("position", "target")}
    reach = [] if asked(splats) else farthest(corners(manifest) * VIEWER)
    more: dict[str, Any] = {
        "streamed": True, "camera": view, "outermost": reach, "comments": splats.comments,
        "enlarged": scale,
    }  # fmt: skip
    name = Path(file).absolute().parent.name
    text = page(name, splats, [{"name": name, "file": MANIFEST}], SCRIPT, more)
    return resources | {"": Resource(HTML, lambda: text.encode("utf-8"))}
