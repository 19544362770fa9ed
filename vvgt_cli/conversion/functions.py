"""`vvgt convert` of one volume under several transfer functions, with an index: it is read and laid out once."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vvgt_cli.conversion.convert import convert
from vvgt_cli.conversion.frames import interrupted
from vvgt_cli.conversion.index import FUNCTIONS, entry_of, index_of, index_output, is_pattern, write_index
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import UsageError
from vvgt_cli.field.layered import open_parts
from vvgt_cli.field.open import automatic
from vvgt_cli.gaussians.outputs import check_outputs
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run


def convert_functions(
    request: ConvertRequest, functions: Sequence[str], console: Console | None = None
) -> dict[str, Any]:
    """One `.ply` a function, and their index; ``{}`` in the outputs of ``request`` is its file's name without endings.

    Returns:
        The index.

    Raises:
        UsageError: outputs without a place for the name, or two functions of one name; found before anything is read.
        DataError: as `convert`; what is done before stays.
    """
    console = console or Console()
    requests = [_one(request, tf) for tf in functions]
    names = [function_name(tf) for tf in functions]
    index = index_output(str(request.output))
    for one in requests:
        check_outputs([*one.outputs(), index], one.inputs(), one.overwrite)
    if len(set(names)) < len(names):
        told = ", ".join(dict.fromkeys(names))
        raise UsageError(f"{len(functions)} functions, named {told}: the files would have the same name; rename one")
    blocks = request.blocks or automatic(request.source, console)
    if blocks is not None:
        requests = [replace(one, blocks=blocks) for one in requests]
    else:
        requests = _opened(Run(console, ConversionReport("convert")), request, requests)
    files = []
    folder = Path(index.path).parent
    for number, (one, name, tf) in enumerate(zip(requests, names, functions, strict=True), 1):
        console.say(f"{tf}: function {number} of {len(requests)}, to {one.output}")
        report = convert(one, console)
        if interrupted(report):
            raise KeyboardInterrupt
        files.append({**entry_of(name, report, function=tf), "file": beside(str(one.output), folder)})
    found = index_of(FUNCTIONS, Path(request.source.path).name, files)
    write_index(index.path, found, request.overwrite)
    console.say(f"{index.path}: {len(files)} functions")
    return found


def beside(file: str, folder: Path) -> str:
    """A file's name as an index in ``folder`` has it."""
    return Path(os.path.relpath(file, folder)).as_posix()


def _opened(run: Run, request: ConvertRequest, requests: list[ConvertRequest]) -> list[ConvertRequest]:
    """The requests with the volume, which is read once."""
    with run.stage("volume") as stage:
        content = open_parts(request.source.path, request.source.read)
        content.prepare()
        stage.note = f"{content.volumes[0].name}, for {len(requests)} functions"
    return [replace(one, source=replace(one.source, volume=content)) for one in requests]


def _one(request: ConvertRequest, tf: str) -> ConvertRequest:
    """The request of one function."""
    return named(replace(request, source=replace(request.source, tf=tf)), function_name(tf), "function")


def named(request: ConvertRequest, name: str, what: str) -> ConvertRequest:
    """The request with a name in its outputs.

    Raises:
        UsageError: outputs without a place for it.
    """

    def put(option: str, pattern: str | None) -> str | None:
        if pattern is None:
            return None
        if pattern.count("{}") != 1 or not is_pattern(pattern):
            raise UsageError(f"{option} {pattern}: expected one place for the {what}'s name, as out_{{}}.ply")
        return pattern.replace("{}", name)

    return replace(
        request,
        output=put("-o", request.output),
        report=put("--report", request.report),
        preview=put("--preview", request.preview),
    )


def function_name(tf: str) -> str:
    """Of a file without folder and endings; of a preset of several (FILE#NAME) its own."""
    return tf.rpartition("#")[2] if "#" in tf else Path(tf).name.partition(".")[0]
