"""The same bytes on any number of threads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_a_conversion_has_the_same_bytes_on_any_number_of_threads(tmp_path):
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    line = ["convert", "example:blob:24", "--max-gaussians", "400", "--size", "64", "--steps", "4", "-q", "--threads"]
    for threads in ("1", "2", "3"):
        subprocess.run(
            [sys.executable, "-m", "vvgt_cli.cli.main", *line, threads, "-o", f"{threads}.ply"], cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": paths}, check=True,
        )  # fmt: skip
    first = (tmp_path / "1.ply").read_bytes()
    assert all((tmp_path / f"{threads}.ply").read_bytes() == first for threads in (2, 3))
