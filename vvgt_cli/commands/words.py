"""Words of a command line: forms of numbers, options given twice, what was typed, and sections of `--help`."""

from __future__ import annotations

import copy
import os
import re
import shlex
from collections import Counter
from collections.abc import Collection, Sequence
from typing import Any

import click
from click.core import ParameterSource

from vvgt_cli.errors import UsageError

THREES = {"--dims": "256 256 128", "--spacing": "1 1 2.5", "--background": "1 1 1"}  # with an example each
RANGE = "--tf-range"
_BETWEEN = re.compile(r"[,x×]", re.IGNORECASE)
_LONGEST = 5  # words: 64 x 64 x 93


def expand(args: Sequence[str]) -> list[str]:
    """Return a command line in the declared form: three words for `THREES`, one word ``LO,HI`` for `RANGE`.

    Args:
        args: words of a command line; those after ``--`` are not changed.

    Raises:
        UsageError: an option of `THREES` without three numbers.
    """
    done: list[str] = []
    rest = list(args)
    while rest:
        word = rest.pop(0)
        option, equals, value = word.partition("=")
        if word == "--":
            return [*done, word, *rest]
        if option not in THREES and option != RANGE:
            done.append(word)
            continue
        words = [value, *rest] if equals else rest
        wanted = 2 if option == RANGE else 3
        taken, numbers = _numbers(words, wanted)
        if option == RANGE:
            done += [option, ",".join(numbers)] if numbers else [word]
        elif numbers:
            done += [option, *numbers]
        else:
            given = " ".join(words[:wanted])
            example = THREES[option]
            raise UsageError(
                f"{option} {given}: expected three numbers, as {option} {example} or {option} "
                f"{example.replace(' ', ',')}"
            )
        rest = words[taken:] if numbers else rest
    return done


def _numbers(words: list[str], count: int) -> tuple[int, list[str]]:
    """Return how many words hold ``count`` numbers, and the numbers; (0, []) if the words are something else."""
    numbers: list[str] = []
    for taken, word in enumerate(words[:_LONGEST], 1):
        parts = [part.strip() for part in _BETWEEN.split(word)]
        if not all(map(_is_number, filter(None, parts))):
            break
        numbers += filter(None, parts)
        if len(numbers) == count:
            return taken, numbers
        if len(numbers) > count:
            break
    return 0, []


def _is_number(text: str) -> bool:
    return re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", text) is not None


ASIDE = {  # parameters that do not change what a file of Gaussians holds
    *("output", "overwrite", "report", "preview", "checkpoint", "quiet", "story"),
    *("threads", "memory", "workers", "scheduler", "block_size", "shard"),
}
_FOLDERS = re.compile(r".*/(?=[^/])", re.DOTALL)  # before a name
_SETTINGS = re.compile(r",(?=[a-z]+=)")  # of a layer, FILE,tf=TF (`vvgt_cli.field.source.parse_layer`)
_LAYER_FOLDERS = re.compile(r"(?<==)[^=]*/(?=[^/])")  # before the name in tf=TF


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
        if parameter.name == "camera":
            values = [",".join(values)]
        if isinstance(parameter, click.Argument):
            words += values
        elif isinstance(parameter, click.Option) and parameter.name in ctx.params:
            name = parameter.opts[-1]
            repeated = [[name, v] for v in values] if parameter.multiple else [[name, *values]]
            words += [name] if parameter.is_flag else [word for part in repeated for word in part]
    return shlex.join(words)


def _anonymous(name: str, value: str) -> str:
    """Return the value of a parameter without folders and without names of volumes, examples excepted."""
    if name in ("volume", "mask"):
        return value if value.startswith("example:") else "VOLUME"
    if name == "layers":
        file, *rest = _SETTINGS.split(value)
        return ",".join([file if file.startswith("example:") else "LAYER", *(_LAYER_FOLDERS.sub("", x) for x in rest)])
    return _FOLDERS.sub("", value)


SECTIONS = {  # parameters by name, in the order shown; all others come first, under "Options"
    "Input": "dims dtype byte_order header_bytes spacing space array component time suv crop mask keep_largest",
    "Look": "iso tf_range opacity_unit_distance labels layers ambient diffuse specular specular_power",
    "Quality": "steps init model rule seed renderer samples step",
    "Output": "frame up camera sh_degree comments split_labels values story format half background points report "
    "conditions",
    "Running": "dry_run device checkpoint shard block_size workers scheduler level threads memory quiet",
}


class SectionedCommand(click.Command):
    """A command that lists its options under the headings of `SECTIONS`, and takes one value of most of them."""

    def __init__(self, name: str | None, *, help: str | None = None, **attributes: Any) -> None:
        """Keep the lines of examples apart: click wraps other paragraphs."""
        text = re.sub(r"\n( *)(Examples?:\n)", "\n\\1\b\n\\1\\2", help or "")
        super().__init__(name, help=text, **attributes)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments; where there are more files than expected, say how a series is given.

        Raises:
            click.UsageError: invalid arguments, or several values of an option that is not repeatable.
        """
        given = list(args)
        try:
            self._check_repeated(ctx, list(args))
            left = super().parse_args(ctx, args)
            for param in self.params:
                value = None if param.name == "array" or ctx.resilient_parsing else ctx.params.get(param.name)
                if "" in (value if isinstance(value, tuple) else (value,)):
                    raise click.BadParameter("'' is empty; expected a value (is a variable unset?)", ctx, param)
            return left
        except click.UsageError as error:
            files = [word for word in given if os.path.exists(word)]
            if "unexpected extra argument" not in error.message or len(files) < 2:
                raise
            raise click.UsageError(
                f"{len(files)} files, {files[0]} to {files[-1]}; expected one: for a series, quote the pattern so that "
                "the shell does not expand it, as 'run_*.vti'",
                ctx,
            ) from None

    def _check_repeated(self, ctx: click.Context, args: list[str]) -> None:
        """Raise click.UsageError that names all values of an option given several times; click would take the last."""
        parser = self.make_parser(ctx)
        given = Counter(parser.parse_args(list(args))[2])
        for option, times in given.items():
            if not isinstance(option, click.Option) or option.multiple or times == 1:
                continue
            if option.is_flag and not option.secondary_opts:
                continue
            names, text = "/".join([*option.opts, *option.secondary_opts]), ""
            if not option.is_flag:
                collecting = copy.copy(option)
                collecting.multiple = True
                collecting.add_to_parser(parser, ctx)
                values = parser.parse_args(list(args))[0][option.name]
                values = [option.flag_value if not isinstance(v, str | tuple) else v for v in values]  # left out
                text = ", " + " and ".join(" ".join(v) if isinstance(v, tuple) else str(v) for v in values)
            raise click.UsageError(f"{names}: given {times} times{text}; expected one", ctx)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options under their headings."""
        options = [param for param in self.get_params(ctx) if isinstance(param, click.Option)]
        rows = {option.name: row for option in options if (row := option.get_help_record(ctx))}
        sections = {
            title: [rows.pop(name) for name in names.split() if name in rows] for title, names in SECTIONS.items()
        }
        for title, listed in {"Options": list(rows.values()), **sections}.items():
            if listed:
                with formatter.section(title):
                    formatter.write_dl(listed)
