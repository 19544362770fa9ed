"""The same command leaves the same bytes, whatever the clock says: caches of workflow systems compare files."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vvgt_cli.commands.main import run

SMALL = ("--screen", "32", "--max-gaussians", "200", "--steps", "2")
TF = '{"points": [{"x": 0, "opacity": 0, "rgb": [0, 0, 1]}, {"x": 1, "opacity": 0.7, "rgb": [1, 0.5, 0]}]}'
COMMANDS = {
    **{  # the bytes of the others do not depend on more than their Gaussians: tests/test_formats.py
        suffix: ("convert", "a_0.npy", "--tf", "a.json", *SMALL, "-o", f"OUT/x{suffix}")
        for suffix in (".ply", ".html", ".usdz")
    },
    "live": ("convert", "a_0.npy", "--tf", "a.json", *SMALL[:4], "--live", "-o", "OUT/x.ply"),
    "blocks": ("convert", "a_0.npy", "--tf", "a.json", *SMALL, "--blocks", "16", "-o", "OUT/x.sog"),
    "streamed": ("convert", "a_0.npy", "--tf", "a.json", *SMALL, "--blocks", "16", "-o", "OUT/x/lod-meta.json"),
    "series": ("convert", "a_*.npy", "--tf", "a.json", *SMALL, "-o", "OUT/x_{}.spz"),
    "series, page": ("convert", "a_*.npy", "--tf", "a.json", *SMALL, "-o", "OUT/x.html"),
    "functions": ("convert", "a_0.npy", "--tf", "a.json", "--tf", "b.json", *SMALL, "-o", "OUT/x_{}.ply"),
    "labels": ("convert", "labels.npy", "--labels", "auto", *SMALL, "--split-labels", "-o", "OUT/x_{}.ply"),
    "labels, nodes": ("convert", "labels.npy", "--labels", "auto", *SMALL, "--split-labels", "-o", "OUT/x.usdz"),
    "picture": ("convert", "a_0.npy", *SMALL, "--preview", "OUT/x.png", "-o", "OUT/x.ply"),
    "init": ("init", "a_0.npy", "--tf", "a.json", *SMALL[:4], "-o", "OUT/x.sog"),
    "views": ("render-views", "a_0.npy", "--tf", "a.json", "--size", "32", "--views", "2", "-o", "OUT/x"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("same_bytes")
    z, y, x = np.indices((22, 18, 20))
    for k in range(2):
        r = np.sqrt((x - 9.5 - k) ** 2 + (y - 8.5) ** 2 + (z - 10.5) ** 2)
        np.save(made / f"a_{k}.npy", np.clip(1.5 - r / 6, 0, 1).astype(np.float32))
    np.save(made / "labels.npy", ((r < 6) + (r < 3)).astype(np.uint8))
    (made / "a.json").write_text(TF)
    (made / "b.json").write_text(TF.replace("0.7", "0.3"))
    return made


def files(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


@pytest.mark.parametrize("name", COMMANDS)
def test_two_runs_leave_equal_bytes(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if name in (".usdz", "labels, nodes"):
        pytest.importorskip("pxr")
    monkeypatch.chdir(folder)

    def left(out: str) -> dict[str, bytes]:
        (folder / f"{name} {out}").mkdir()
        assert run([word.replace("OUT", f"{name} {out}") for word in COMMANDS[name]]) == 0
        return files(folder / f"{name} {out}")

    first = left("first")
    later = {"time": time.time, "perf_counter": time.perf_counter, "monotonic": time.monotonic}
    for clock, was in later.items():
        monkeypatch.setattr(time, clock, moved(was))
    second = left("second")
    assert first
    assert list(first) == list(second)
    assert [file for file in first if first[file] != second[file]] == []


def moved(clock: Callable[[], float]) -> Callable[[], float]:
    """Return a clock that is years ahead, and runs three times as fast."""
    start = clock()
    return lambda: start + 1e8 + 3 * (clock() - start)
