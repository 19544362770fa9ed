"""`vvgt plugin`."""

from __future__ import annotations

import click

from vvgt_cli.cli.sections import SectionedCommand


@click.command(
    "plugin", cls=SectionedCommand, short_help="List the adapters for other programs, or say how one is enabled."
)
@click.argument("name", required=False)
def command(name: str | None) -> None:
    """List the adapters for the programs that volumes are open in; with NAME, print its file and how it is enabled.

    Examples:
      vvgt plugin
      vvgt plugin slicer
    """
    from vvgt_cli.errors import UsageError
    from vvgt_cli.integrations.plugins import PLUGINS, plugin

    if name is None:
        for found in map(plugin, PLUGINS):
            click.echo(f"{found.name:<10}{found.does}\n{'':<10}tried with {found.tried}")
    elif name in PLUGINS:
        found = plugin(name)
        click.echo("\n".join((str(found.path), *found.enable)))
    else:
        raise UsageError(f"no plugin {name!r}; expected one of {', '.join(PLUGINS)}")
