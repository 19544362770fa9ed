"""Arguments typed on the command line."""

from __future__ import annotations

import re
import shlex
from collections.abc import Collection

import click
from click.core import ParameterSource

ASIDE = {  # parameters that do not change what a file of Gaussians holds
    *("output", "overwrite", "report", "preview", "checkpoint", "quiet"),
    *("threads", "memory", "workers", "scheduler", "block_size"),
}
_FOLDERS = re.compile(r".*/(?=[^/])", re.DOTALL)  # before a name
_SETTINGS = re.compile(r",(?=[a-z]+=)")  # of a layer, FILE,tf=TF (`vvgt_cli.field.source.parse_layer`)
_LAYER_FOLDERS = re.compile(r"(?<==)[^=]*/(?=[^/])")  # before the name in tf=TF
_SHARD = re.compile(r"\d+/\d+")  # of a job array: no folder


def typed(ctx: click.Context) -> list[click.Parameter]:
    """Return the parameters given on the command line."""
    return [p for p in ctx.command.params if p.name and ctx.get_parameter_source(p.name) is ParameterSource.COMMANDLINE]


def command_line(ctx: click.Context, without: Collection[str] = (), folders: bool = True) -> str:
    """Return the call, arguments first, without ``--threads``, which reports record separately.

    Args:
        ctx: context of the call.
        without: names of parameters to omit.
        folders: whether paths keep their folders, and volumes their names, which may be a patient's.
    """
    words = ["vvgt", ctx.command.name or ""]
    for parameter in typed(ctx):
        value = ctx.params.get(parameter.name or "")
        values = [str(v) for v in (value if isinstance(value, tuple) else [value])]
        if not folders:
            values = [_anonymous(parameter.name or "", v) for v in values]
        if parameter.name in without:
            continue
        if isinstance(parameter, click.Argument):
            words += values
        elif isinstance(parameter, click.Option) and parameter.name in ctx.params:
            name = parameter.opts[-1]
            repeated = [[name, v] for v in values] if parameter.multiple else [[name, *values]]
            words += [name] if parameter.is_flag else [word for part in repeated for word in part]
    return shlex.join(words)


def _anonymous(name: str, value: str) -> str:
    """Return the value of a parameter without folders and without names of volumes, examples excepted."""
    if name == "volume":
        return value if value.startswith("example:") else "VOLUME"
    if name == "layers":
        file, *rest = _SETTINGS.split(value)
        return ",".join([file if file.startswith("example:") else "LAYER", *(_LAYER_FOLDERS.sub("", x) for x in rest)])
    return value if _SHARD.fullmatch(value) else _FOLDERS.sub("", value)
