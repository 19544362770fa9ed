"""`vvgt plugin`: every adapter is listed, short, and says how it is enabled."""

import tomllib
from pathlib import Path

import pytest

from tests.endings import LISTS, written
from vvgt_cli.commands.plugin import FOLDER, PLUGINS, plugin

ROOT = Path(__file__).parents[1]


def test_each_is_listed_with_its_program(vvgt) -> None:
    lines = vvgt("plugin").out.decode().splitlines()
    assert [line.split()[0] for line in lines[::2]] == list(PLUGINS)
    assert all(line.strip().startswith("tried with ") for line in lines[1::2])


@pytest.mark.parametrize("name", PLUGINS)
def test_one_prints_its_file_and_how_it_is_enabled(vvgt, name: str) -> None:
    path, *lines = vvgt("plugin", name).out.decode().splitlines()
    assert Path(path).is_file()
    assert lines
    assert "{" not in "".join(lines).replace("{:04d}", "")
    if name in ("slicer", "paraview", "blender"):  # loaded by its place
        assert any(str(Path(path).parents[name == "blender"]) in line for line in lines)


def test_an_unknown_one_is_refused(vvgt) -> None:
    assert vvgt.fails(2, "plugin", "slicr").startswith("vvgt: error: no plugin 'slicr'; expected one of ")


def test_adapters_are_listed_and_packaged() -> None:
    stated = [path for path in FOLDER.rglob("*.py") if "\nEnable:\n" in path.read_text("utf-8")]
    assert sorted(stated) == sorted(plugin(name)[0] for name in PLUGINS)
    for path in stated:
        assert len(path.read_text("utf-8").splitlines()) <= 150
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    beside = [path for path in stated if path.parent != FOLDER] + [FOLDER / "napari.yaml"]
    packaged = {path for pattern in data["vvgt_cli.integrations"] for path in FOLDER.glob(pattern)}
    assert set(beside) <= packaged
    assert FOLDER / "blender" / "gaussian_splats" / "blender_manifest.toml" in packaged


@pytest.mark.parametrize("row", LISTS, ids=lambda row: row[0])
def test_endings_in_other_programs_are_those_of_the_table(row) -> None:
    assert written(*row) == (ROOT / row[0]).read_text("utf-8"), "make formats"
