"""`vvgt` as a command-line module of 3D Slicer: `vvgt --xml`, the arguments that Slicer then gives, and its progress.

The description is that of Slicer's execution model (SlicerExecutionModel, ModuleDescriptionParser.cxx): long flags are
letters, digits and underscores, flags come before arguments without one, and progress is tags on standard output.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

import click

from vvgt_cli.commands.convert import command
from vvgt_cli.defaults import MAX_GAUSSIANS, SIZE
from vvgt_cli.progress import Console, ProgressCallback
from vvgt_cli.version import VERSION

FLAG = "--slicer"  # the first word that Slicer gives: a parameter that its panel does not show
LAYER = "layer"  # an image of labels, which Slicer stores without their names: distinct colours
DEFAULTS = {"max_gaussians": MAX_GAUSSIANS, "screen": SIZE}
FIELDS = {  # tag of each parameter, by the option of `vvgt convert` whose help it shows
    "tf": '<file fileExtensions=".vp,.json,.xml">',
    "labels": '<file fileExtensions=".ctbl,.txt,.csv,.label,.json">',
    LAYER: '<image type="label">',
    "mask": '<image type="label">',
    "max_gaussians": "<integer>",
    "screen": "<integer>",
}
HEAD = """<?xml version="1.0" encoding="utf-8"?>
<executable>
<category>Rendering</category>
<title>Gaussian Splats (command)</title>
<description>Converts a volume under a transfer function to 3D Gaussian splats: a page that opens in a browser, or a
file for viewers.</description>
<version>{version}</version>
<parameters>
<label>Files</label><description>Volume and result</description>
<boolean hidden="true"><name>slicer</name><longflag>slicer</longflag><label>slicer</label>
<description>Says that Slicer calls</description><default>true</default></boolean>
<image><name>volume</name><label>Volume</label>
<description>Volume to convert</description><channel>input</channel><index>0</index></image>
<file fileExtensions="{endings}"><name>output</name><label>Result</label>
<description>Page, or file of Gaussians</description><channel>output</channel><index>1</index></file>
</parameters>
<parameters>
<label>Look and limits</label><description>Options of vvgt convert</description>"""


def description() -> str:
    """Return the XML that describes `vvgt convert` to Slicer, with the help and defaults of its options."""
    from vvgt_cli.gaussians.formats import ENDINGS

    options = {option.name: option for option in command.params if isinstance(option, click.Option)}
    lines = [HEAD.format(version=VERSION, endings=",".join(ENDINGS))]
    for name, tag in FIELDS.items():
        option = options["layers" if name == LAYER else name]
        kind = tag[1:-1].partition(" ")[0]
        end = "<channel>input</channel>" if kind in ("file", "image") else f"<default>{DEFAULTS[name]}</default>"
        lines += [
            f"{tag}<name>{name}</name><longflag>{name}</longflag><label>{name.replace('_', ' ')}</label>",
            f"<description>{escape(option.help or '')}</description>{end}</{kind}>",
        ]
    return "\n".join([*lines, "</parameters>", "</executable>"])


def arguments(words: Sequence[str]) -> list[str]:
    """Return the command line of `vvgt convert` for the words that Slicer gives after `FLAG`."""
    if len(words) < 2:
        raise click.UsageError(f"{FLAG}: expected a volume and a result at the end, as 3D Slicer gives them")
    *flags, volume, output = words
    taken = [word.replace("_", "-") if word[2:] in FIELDS else word for word in flags]
    for at in [k for k, word in enumerate(taken[:-1]) if word == f"--{LAYER}"]:
        taken[at + 1] += ",labels=auto"
    return ["convert", volume, "-o", output, "--overwrite", *taken]


@dataclass
class SlicerConsole(Console):
    """Messages on standard error, and progress on standard output in the tags that Slicer reads."""

    def stage(self, name: str, seconds: float, detail: str = "") -> None:
        """Print the line of a stage, and that it has ended."""
        super().stage(name, seconds, detail)
        click.echo(
            f"<filter-end><filter-name>{name}</filter-name><filter-time>{seconds:.2f}</filter-time></filter-end>"
        )

    def bar(self, label: str) -> ProgressCallback:
        """Print that a stage begins; return a callback ``(done, total)`` that prints its share."""
        click.echo(
            f"<filter-start><filter-name>{label}</filter-name><filter-comment>{label}</filter-comment></filter-start>"
        )
        last = -1

        def draw(done: int, total: int) -> None:
            nonlocal last
            if (percent := 100 * done // max(total, 1)) != last:
                last = percent
                click.echo(f"<filter-progress>{percent / 100:.2f}</filter-progress>")

        return draw
