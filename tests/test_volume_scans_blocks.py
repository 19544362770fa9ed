"""Maps and scans in blocks: the same Gaussians as in memory; what their files hold, and their time steps."""

from collections.abc import Callable
from pathlib import Path

import mrcfile
import netCDF4
import nibabel as nib
import numpy as np
import pytest
import pyvista

pytestmark = pytest.mark.filterwarnings("ignore:.*Analyze does not say")
Z, Y, X = np.indices((40, 36, 44))
BALL = 100 * np.exp(-((X - 15) ** 2 + (Y - 18) ** 2 + (Z - 22) ** 2) / 60)  # z, y, x


def mrc(path: Path, values: np.ndarray, **words: object) -> Path:
    with mrcfile.new(path, values) as file:
        file.voxel_size = (1.5, 2.0, 2.5)
        for name, value in words.items():
            setattr(file.header, name, value)
    return path


def stack(folder: Path) -> Path:
    return mrc(folder / "v.mrc", np.stack([0 * BALL, BALL]).astype("f4"))


def cube(folder: Path) -> Path:
    small = BALL[::2, ::2, ::2]
    rows = "\n".join(" ".join(f"{v:.5E}" for v in row) for row in small.reshape(-1, small.shape[2]))
    head = "one\ntwo\n 0 1 2 3\n 20 0 0 0.5\n 18 0 0.4 0\n 22 0.3 0 0\n"
    (folder / "v.cube").write_text(head + rows + "\n")
    return folder / "v.cube"


def dx(folder: Path) -> Path:
    head = (
        "object 1 class gridpositions counts 40 36 44\norigin 1 2 3\ndelta 0 0 0.5\ndelta 0 0.4 0\ndelta 0.3 0 0\n"
        f"object 3 class array type float rank 0 items {BALL.size} lsb data follows\n"
    )
    (folder / "v.dx").write_bytes(head.encode() + BALL.astype("<f4").tobytes())
    return folder / "v.dx"


def mgh(folder: Path, name: str = "v.mgh") -> Path:
    image = nib.MGHImage(BALL.T.astype("f4"), nib.affines.from_matvec([[-1, 0, 0], [0, 0, 1], [0, -1, 0]], [9, 8, 7]))
    nib.save(image, str(folder / name))
    return folder / name


def analyze(folder: Path) -> Path:
    nib.AnalyzeImage(BALL.T.astype("i2"), None).to_filename(folder / "v.img")
    return folder / "v.hdr"


def netcdf(folder: Path) -> Path:
    with netCDF4.Dataset(folder / "v.nc", "w") as file:
        for name, size in zip("zyx", BALL.shape, strict=True):
            file.createDimension(name, size)
        file.createVariable("ball", "f4", ("z", "y", "x"), zlib=True, chunksizes=(16, 16, 16))[:] = BALL
    return folder / "v.nc"


def vti(folder: Path) -> Path:
    image = pyvista.ImageData(dimensions=BALL.shape[::-1])
    image["ball"] = BALL.astype("f4").ravel()
    image.save(folder / "v.vti")
    return folder / "v.vti"


def test_workers_do_not_repeat_what_is_said_of_a_file(tmp_path: Path, vvgt) -> None:
    out = tmp_path / "o.ply"
    done = vvgt.ok("init", analyze(tmp_path), "-o", out, "--max-gaussians", 50, "--blocks", 32, "--workers", 2)
    assert "Analyze" not in done.err  # of this process the warning goes to pytest


@pytest.mark.parametrize("make", [netcdf, vti])
def test_packed_values_give_the_bytes_of_plain_ones(make: Callable, tmp_path: Path, vvgt) -> None:
    """In blocks; the packed ones with processes of workers."""
    np.save(tmp_path / "v.npy", BALL.astype("f4"))
    files = []
    for source, more in ((tmp_path / "v.npy", ()), (make(tmp_path), ("--workers", 2))):
        files.append(tmp_path / f"{source.suffix[1:]}.ply")
        how = ("--max-gaussians", 200, "--blocks", 32, *more, "--no-comments")
        vvgt.ok("init", source, "-o", files[-1], *how)
    assert files[0].read_bytes() == files[1].read_bytes()
