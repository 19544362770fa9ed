"""Readers of other packages, which their entry points name."""

import os
from pathlib import Path

import pytest

from tests.processes import python

ROOT = Path(__file__).parent.parent
MODULE = """
import numpy as np
from vvgt_cli.volume import Volume
from vvgt_cli.volume.readers import Reader

def read(path, options):
    shape = tuple(path.read_bytes()[4:7])
    return Volume(np.arange(np.prod(shape), dtype=np.uint8).reshape(shape), (1.0, 2.0, 3.0), name=path.stem)

FORMATS = (Reader("Lab", (".lab",), read, lambda head: head.startswith((b"LAB1", b"NRRD"))),)
"""


def install(folder: Path, name: str, value: str, module: str = MODULE) -> None:
    """A package with a module, and an entry point, as an installation leaves them."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[vvgt.readers]\n{name} = {value}\n")
    (folder / f"{value.partition(':')[0]}.py").write_text(module)


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the path, with a file that its package reads."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), str(ROOT)]))
    install(tmp_path, "lab", "lab_readers:FORMATS")
    (tmp_path / "a.lab").write_bytes(b"LAB1" + bytes([4, 3, 2]))
    return tmp_path


VVGT = ("-m", "vvgt_cli.commands.main")


def test_a_package_adds_a_format(lab: Path) -> None:
    out, err = python(*VVGT, "info", lab / "a.lab", text=True)
    assert "dims           2 3 4" in out
    assert "spacing        1 2 3" in out
    assert err == ""


def test_ours_come_first_and_need_no_packages(lab: Path) -> None:
    nrrd = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n\n"
    (lab / "b.nrrd").write_bytes(nrrd.encode() + bytes(8))
    code = "import sys; sys.modules['importlib.metadata'] = None; from vvgt_cli.volume import read_volume"
    out, _ = python("-c", f"{code}; print(read_volume(sys.argv[1]).dims)", lab / "b.nrrd", text=True)
    assert out.strip() == "(2, 2, 2)"


@pytest.mark.parametrize(
    ("value", "module", "why"),
    [
        ("gone:FORMATS", "raise RuntimeError('no licence')", "RuntimeError: no licence"),
        ("words:FORMATS", "FORMATS = ['x']", "AttributeError"),
        ("same:FORMATS", MODULE.replace('"Lab"', '"NRRD"'), "ValueError: NRRD: registered twice"),
    ],
)
def test_a_broken_package_is_a_line_that_names_it(lab: Path, value: str, module: str, why: str) -> None:
    install(lab, "broken", value, module)
    out, err = python(*VVGT, "info", lab / "a.lab", text=True)
    assert "dims           2 3 4" in out
    assert err.startswith(f"vvgt: note: broken: its readers cannot be used ({why}")
    assert err.count("\n") == 1


def test_packages_are_not_asked_for_help() -> None:
    code = "import sys; from vvgt_cli.commands.main import run; run(['--help'])"
    asked = "print([name for name in ('importlib.metadata', 'vvgt_cli.volume', 'numpy') if name in sys.modules])"
    out, _ = python("-c", f"{code}; {asked}", text=True)
    assert out.splitlines()[-1] == "[]"
