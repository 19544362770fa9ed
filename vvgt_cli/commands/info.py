"""`vvgt info`: what a file holds, or this machine."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, Unpack

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.errors import UsageError

if TYPE_CHECKING:
    from vvgt_cli.library.inputs import LookLike, PathLike, Reading
    from vvgt_cli.progress import Console


def info(
    file: PathLike | None = None, look: LookLike = None, *, machine: bool = False, sharing: bool = False,
    **reading: Unpack[Reading],
) -> dict[str, Any]:  # fmt: skip
    """Return facts about a file, of which "kind" is the first, in plain values: ``vvgt info``.

    Args:
        file: a volume, function, label table, view set, file of Gaussians, or index of several.
        look: to describe Gaussians of ``vvgt convert --live`` under, as in `recolor`.
        machine: describe this machine instead.
        sharing: describe what leaves with a file of Gaussians.
        **reading: of a volume, as in `convert`.

    Raises:
        DataError: a file that is not valid, or not of a known kind.
        UsageError: no such file, or options that do not fit it.
    """
    from vvgt_cli.commands.inspect import inspect, machine_facts, what_leaves
    from vvgt_cli.library.inputs import Look, live_look, source_of
    from vvgt_cli.score.record import plain
    from vvgt_cli.volume import ReadOptions

    if machine and sharing:
        raise UsageError("--machine describes this machine, --sharing a file; expected one of them")
    if machine == (file is not None):
        raise UsageError("expected a file, or --machine")
    if file is None:
        return machine_facts()
    name, shown, read = os.fspath(file), live_look(Look.of(look)), source_of(file, None, reading).read
    if sharing and (shown, read) != (None, ReadOptions()):
        raise UsageError("--sharing describes the file as it is; omit --tf and reading options")
    return plain(what_leaves(name) if sharing else inspect(name, read, shown))


@shared.command("info", short_help="Describe a volume, transfer function, view set or .ply.")
@click.argument("file", required=False)
@click.option("--machine", is_flag=True, help="Describe this machine instead: processors, memory, GPU.")
@click.option("--sharing", is_flag=True, help="Describe what leaves with a file of Gaussians: names, places, values.")
@shared.json_option
@shared.group(
    "optics",
    tf=click.option("--tf", metavar="TF", help="Function to describe a .ply of 'vvgt convert --live' under."),
    iso=shared.iso_option,
    layers=shared.layer_looks_option,
    tf_range=shared.tf_range_option,
    opacity_unit_distance=shared.unit_distance_option,
)
@shared.placed_read_options
@shared.common_options
def command(as_json: bool, console: Console, **options: Any) -> None:
    """Describe FILE: a volume, transfer function, label table, view set, .ply of Gaussians, or index of several.

    The type is detected from the content. A view set is a transforms.json.

    Examples:
      vvgt info example:frog
      vvgt info frog.ply --json | jq .gaussians
      vvgt info presets.xml#CT-AAA
      vvgt info head.html --sharing
      vvgt info --machine
    """
    facts = info(**shared.arguments(**options))
    if as_json:
        import json

        click.echo(json.dumps(facts, indent=2, allow_nan=False))
        return
    width = max(map(len, facts)) + 2
    for key, value in facts.items():
        rows = value if isinstance(value, list) and value and isinstance(value[0], dict) else [value]
        if key == "certificate" and isinstance(value, dict):
            rows = [{name: item} for name, item in value.items()]
        for n, row in enumerate(rows):  # of tables a line an entry
            click.echo(f"{'' if n else key:<{width}}{_text(row)}")


def _text(value: object) -> str:
    """Return a value as one line shows it."""
    if isinstance(value, list):
        return " ".join(map(_text, value)) if value else "-"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_text(item)}" for key, item in value.items()) or "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    return "-" if value is None else " ".join(str(value).splitlines())
