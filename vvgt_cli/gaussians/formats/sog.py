"""`.sog` (PlayCanvas' images of sorted values) through the program splat-transform, which needs node."""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.splats import Splats, columns_of, ply_bytes

PROGRAM = "splat-transform"
_COMMENTS = "vvgt.json"  # a member of the archive that others pass over


def program(source: str) -> str:
    """Path of splat-transform.

    Raises:
        DataError: it is not installed.
    """
    found = shutil.which(PROGRAM)
    if found is None:
        raise DataError(
            f"{source}: .sog needs {PROGRAM} on the path; install node 22 or newer, then: "
            "npm install -g @playcanvas/splat-transform@3.7.0"
        )
    return found


def sog(splats: Splats, name: str) -> bytes:
    """A `.sog` of the columns.

    Raises:
        DataError: splat-transform fails, or is not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "in.ply"), Path(folder, "out.sog")
        source.write_bytes(ply_bytes(splats))
        _run(name, source, target)
        with zipfile.ZipFile(target, "a", zipfile.ZIP_STORED) as archive:
            archive.writestr(zipfile.ZipInfo(_COMMENTS), json.dumps(list(splats.comments)))
        return target.read_bytes()


def read_sog(content: bytes, name: str) -> Splats:
    """The columns of a `.sog`.

    Raises:
        DataError: splat-transform fails, or is not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "in.sog"), Path(folder, "out.ply")
        source.write_bytes(content)
        _run(name, source, target)
        return replace(columns_of(target.read_bytes(), name), comments=tuple(_comments(source)))


def _comments(path: Path) -> list[str]:
    try:
        with zipfile.ZipFile(path) as archive:
            found = json.loads(archive.read(_COMMENTS))
    except (KeyError, zipfile.BadZipFile, ValueError):
        return []
    return [str(line).replace("\n", " ") for line in found] if isinstance(found, list) else []


def _run(name: str, source: Path, target: Path) -> None:
    command = [program(name), "-q", "-g", "cpu", "-w", str(source), str(target)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode or not target.is_file():
        said = " ".join((done.stderr or done.stdout).split())[-300:]
        raise DataError(
            f"{name}: {PROGRAM} failed ({said or done.returncode}); try: {PROGRAM} --version (3.7 expected)"
        )
