"""`vvgt info`."""

from __future__ import annotations

from typing import Any

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.progress import Console


@shared.command("info", short_help="Describe a volume, transfer function, view set or .ply.")
@click.argument("file", required=False)
@click.option("--machine", is_flag=True, help="Describe this machine instead: processors, memory, GPU.")
@click.option("--sharing", is_flag=True, help="Describe what leaves with a file of Gaussians: names, places, values.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
@click.option("--tf", metavar="TF", help="Transfer function to describe a .ply of 'vvgt convert --live' under.")
@shared.iso_option
@shared.layer_looks_option
@shared.tf_range_option
@shared.unit_distance_option
@shared.placed_read_options
@shared.common_options
def command(
    file: str | None, machine: bool, sharing: bool, as_json: bool, tf: str | None, iso: tuple[str, ...],
    layers: tuple[str, ...],
    tf_range: str, opacity_unit_distance: str | None, read: dict[str, Any], console: Console,
) -> None:  # fmt: skip
    """Describe FILE: a volume, transfer function, label table, view set, .ply of Gaussians, or index of several.

    The type is detected from the content. A view set is a transforms.json.

    Examples:
      vvgt info example:frog
      vvgt info frog.ply --json | jq .gaussians
      vvgt info presets.xml#CT-AAA
      vvgt info head.html --sharing
      vvgt info --machine
    """
    from vvgt_cli.commands.inspect import inspect, machine_facts, what_leaves
    from vvgt_cli.errors import UsageError
    from vvgt_cli.library.inputs import Look, live_look
    from vvgt_cli.score.record import plain
    from vvgt_cli.volume import ReadOptions

    if machine and sharing:
        raise UsageError("--machine describes this machine, --sharing a file; expected one of them")
    if machine == (file is not None):
        raise UsageError("expected a file, or --machine")
    look, how = live_look(Look(tf, tf_range, opacity_unit_distance, layers=layers, iso=iso)), ReadOptions(**read)
    if sharing and (look, how) != (None, ReadOptions()):
        raise UsageError("--sharing describes the file as it is; omit --tf and reading options")
    if file is None:
        facts = machine_facts()
    elif sharing:
        facts = plain(what_leaves(file))
    else:
        facts = plain(inspect(file, how, look))
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
