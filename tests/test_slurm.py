"""The job scripts in `examples`, with the variables that SLURM sets."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def job(script: str, *words: object, cpus: int = 1, **variables: object) -> subprocess.CompletedProcess[str]:
    bin_folder = str(Path(sys.executable).parent)
    given = {"PATH": f"{bin_folder}:{os.environ['PATH']}", "SLURM_CPUS_PER_TASK": cpus, "SLURM_MEM_PER_NODE": 4096}
    env = os.environ | {name: str(value) for name, value in (given | variables).items()}
    command = ["bash", str(EXAMPLES / script), *map(str, words)]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=900)


def test_an_array_of_two_and_a_merge_leave_what_one_run_leaves(tmp_path: Path) -> None:
    z, y, x = np.mgrid[:64, :64, :64] / 31.5 - 1
    volume = tmp_path / "v_64x64x64_uint8.raw"
    volume.write_bytes((255 * np.exp(-4 * (x * x + 2 * y * y + z * z))).astype(np.uint8).tobytes())
    options = ("--max-gaussians", 500, "--screen", 64, "--blocks", 32, "-q")
    last = None
    for _ in range(3):
        for task in (1, 2):
            done = job("blocks.slurm", volume, tmp_path / "parts", *options, SLURM_ARRAY_TASK_ID=task,
                       SLURM_ARRAY_TASK_COUNT=2)  # fmt: skip
            assert done.returncode == 0, done.stderr
        last = job("merge.slurm", tmp_path / "parts", tmp_path / "a.ply", "-q")
        if last.returncode == 0:
            break
    assert last.returncode == 0, last.stderr
    whole = [str(Path(sys.executable).parent / "vvgt"), "init", volume, "-o", tmp_path / "b.ply", *options]
    subprocess.run(list(map(str, whole)), check=True, timeout=900)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@pytest.mark.parametrize("script", sorted(path.name for path in EXAMPLES.glob("*.slurm")))
def test_scripts_are_shell(script: str) -> None:
    subprocess.run(["bash", "-n", EXAMPLES / script], check=True)
