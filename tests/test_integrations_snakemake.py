"""The Snakemake rule of `examples`: made once, then taken from the cache; made again, the same bytes."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.long
def test_a_page_is_made_once_and_the_same_again(tmp_path: Path) -> None:
    snakemake = shutil.which("snakemake", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if snakemake is None:
        pytest.skip("no snakemake (pip install snakemake)")
    command = tmp_path / "bin" / "vvgt"
    command.parent.mkdir()
    command.write_text(
        f"#!/bin/sh\necho run >> {tmp_path}/runs\n"
        f'PYTHONPATH={ROOT} exec {sys.executable} -m vvgt_cli.commands.main "$@"\n'
    )
    command.chmod(0o755)
    values = np.indices((20, 22, 24)).sum(axis=0).astype(np.uint8)
    head = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 24 22 20\nencoding: raw\nendian: little\n\n"
    function = '{"points": [{"x": 0, "opacity": 0, "rgb": [1, 0, 0]}, {"x": 60, "opacity": 0.5, "rgb": [1, 1, 0]}]}'

    def made(name: str, *more: str) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        (folder / "a.nrrd").write_bytes(head.encode() + values.tobytes())
        (folder / "tf.json").write_text(function)
        words = [snakemake, "--snakefile", ROOT / "examples" / "splats.smk", "--cores", "1", *more, "--config"]
        where = {"PATH": f"{command.parent}:{os.environ['PATH']}", "SNAKEMAKE_OUTPUT_CACHE": str(tmp_path / "cache")}
        done = subprocess.run(
            [*words, "options=--max-gaussians 300 --screen 64 --steps 2", "--", "a.html"], cwd=folder,
            env=os.environ | where, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return folder

    (tmp_path / "cache").mkdir()
    first, second, again = made("first", "--cache"), made("second", "--cache"), made("again")
    assert (tmp_path / "runs").read_text().split() == ["run", "run"]  # the second took the first's from the cache
    assert not (again / "a.html").is_symlink()
    assert (first / "a.html").read_bytes() == (second / "a.html").read_bytes() == (again / "a.html").read_bytes()
