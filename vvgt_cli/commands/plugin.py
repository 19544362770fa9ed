"""`vvgt plugin`: the adapters for other programs, what each does and how it is enabled, as its own file says."""

from __future__ import annotations

import ast
from pathlib import Path

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.errors import UsageError

FOLDER = Path(__file__).parents[1] / "integrations"
PLUGINS = {  # file of each, in that folder; its docstring has the lines "Tried:" and "Enable:"
    "pyvista": "pyvista.py",
    "paraview": "paraview_plugin.py",
    "catalyst": "catalyst.py",
    "slicer": "slicer/GaussianSplats.py",
    "napari": "napari.py",
    "jupyter": "jupyter.py",
    "xarray": "xarray.py",
    "blender": "blender/gaussian_splats/__init__.py",
}


def plugin(name: str) -> tuple[Path, str, str, list[str]]:
    """Return an adapter's file, what it does, the version it was tried with, and the lines that enable it.

    They are those of the file's docstring, as its program may be missing.
    """
    path = FOLDER / PLUGINS[name]
    lines = (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "").splitlines()
    tried = next(line.removeprefix("Tried:").strip() for line in lines if line.startswith("Tried:"))
    places = {"file": path, "folder": path.parent, "above": path.parents[1]}
    enable = [line.strip().format(**places) for line in lines[lines.index("Enable:") + 1 :]]
    return path, lines[0], tried, list(filter(None, enable))


@shared.command("plugin", short_help="List the adapters for other programs, or say how one is enabled.")
@click.argument("name", required=False)
def command(name: str | None) -> None:
    """List the adapters for the programs that volumes are open in; with NAME, print its file and how it is enabled.

    Examples:
      vvgt plugin
      vvgt plugin slicer
    """
    if name is not None and name not in PLUGINS:
        raise UsageError(f"no plugin {name!r}; expected one of {', '.join(PLUGINS)}")
    for one in PLUGINS if name is None else [name]:
        path, does, tried, enable = plugin(one)
        short = f"{one:<10}{does}\n{'':<10}tried with {tried}"
        click.echo(short if name is None else "\n".join((str(path), *enable)))
