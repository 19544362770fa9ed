"""AFNI and Philips PAR/REC: against nibabel, by headers that come with it, and against the formula in the headers."""

import gzip
import re
import sys
from pathlib import Path

import nibabel
import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError, SeveralComponents, SeveralSteps
from vvgt_cli.volume import ReadOptions, read_volume

DATA = Path(nibabel.__file__).parent / "tests" / "data"


def par_of(name: str, size: int = 8) -> bytes:
    """A header that comes with nibabel, with slices of ``size`` x ``size`` pixels, without most comments."""
    lines = (DATA / name).read_text().splitlines()
    lines = lines[:8] + [line for line in lines[8:] if not line.startswith("#")]
    rows = [line.split() if re.match(r" *\d", line) else None for line in lines]
    text = (
        line if row is None else " ".join([*row[:9], f"{size} {size}", *row[11:]])
        for line, row in zip(lines, rows, strict=True)
    )
    return "\n".join(text).encode() + b"\n"


def head_of(name: str, old: str, new: str) -> bytes:
    text = (DATA / name).read_text()
    assert old in text
    return text.replace(old, new).encode()


def philips(folder: Path, name: str, images: int, header: str = "v.PAR", values: str = "v.REC") -> np.ndarray:
    """A pair of ``images`` slices; their values."""
    (folder / header).write_bytes(par_of(name))
    stored = np.random.default_rng(2).integers(0, 4096, (images, 8, 8)).astype("<u2")
    stored.tofile(folder / values)
    return stored


@pytest.mark.parametrize("stored", [False, True])
def test_philips_values_are_floating_point_ones(tmp_path: Path, stored: bool) -> None:
    pixels = philips(tmp_path, "variant_v4_2_header.PAR", 27)
    with pytest.raises(SeveralSteps) as caught:
        read_volume(str(tmp_path / "v.REC"))
    assert caught.value.steps == 3
    volume = read_volume(str(tmp_path / "v.PAR"), ReadOptions(time=1, stored=stored))
    # FP = DV / (RS * SS), DV = PV * RS + RI, here with RS 1.29035, RI 0, SS 4.28404e-3
    np.testing.assert_allclose(volume.data[0:], pixels[9:18] / 4.28404e-3, rtol=1e-6)
    np.testing.assert_array_equal(volume.affine, nibabel.load(tmp_path / "v.PAR").affine)
    assert volume.space == "RAS"


def test_philips_images_of_several_kinds_are_no_time_steps(tmp_path: Path) -> None:
    pixels = philips(tmp_path, "fieldmap.PAR", 20)
    with pytest.raises(SeveralComponents) as caught:
        read_volume(str(tmp_path / "v.PAR"))
    name = "image_type_mr 3, scanning sequence 4"
    assert caught.value.names[1] == name
    volume = read_volume(str(tmp_path / "v.PAR"), ReadOptions(component=name))
    want = nibabel.parrec.PARRECImage.from_filename(tmp_path / "v.PAR", scaling="fp").dataobj[..., 1].T
    np.testing.assert_allclose(volume.data, want, rtol=1e-6)
    assert set(np.unique(volume.data.astype(int))) <= set(np.unique(want.astype(int)))
    assert pixels.size == 2 * want.size


@pytest.mark.parametrize(("header", "values"), [("V.PAR", "V.REC"), ("v.par", "v.rec"), ("V.Par", "v.rec")])
def test_a_rec_file_is_philips_where_its_par_lies_beside_it(tmp_path: Path, header: str, values: str) -> None:
    philips(tmp_path, "T1.PAR", 10, header, values)
    assert read_volume(str(tmp_path / values)).dims == (8, 8, 10)
    (tmp_path / header).unlink()
    refused(DataError, r"mode|sizes|bytes", read_volume, str(tmp_path / values))


def afni(folder: Path, head: bytes, name: str = "v+orig.BRIK", count: int = 1) -> np.ndarray:
    (folder / "v+orig.HEAD").write_bytes(head)
    stored = np.random.default_rng(4).integers(-900, 900, (count, 3, 4, 5)).astype("<i2")
    (folder / name).write_bytes(gzip.compress(stored.tobytes()) if name.endswith("gz") else stored.tobytes())
    return stored


@pytest.mark.parametrize("name", ["v+orig.BRIK", "v+orig.BRIK.gz", "v+orig.brik"])
@pytest.mark.parametrize("stored", [False, True])
def test_afni_steps(tmp_path: Path, name: str, stored: bool) -> None:
    values = afni(tmp_path, head_of("example4d+orig.HEAD", "33 41 25", "5 4 3"), name, 3)
    with pytest.raises(SeveralSteps) as caught:
        read_volume(str(tmp_path / "v+orig.HEAD"))
    assert (caught.value.times, caught.value.unit) == ([0, 3, 6], "s")
    volume = read_volume(str(tmp_path / name), ReadOptions(time=2, stored=stored))
    np.testing.assert_array_equal(volume.data[0:], values[2])
    np.testing.assert_array_equal(
        volume.affine, nibabel.brikhead.AFNIImage.from_filename(DATA / "example4d+orig.HEAD").affine
    )


def test_afni_sub_bricks_by_label_and_factor(tmp_path: Path) -> None:
    head = head_of("scaled+tlrc.HEAD", "47 54 43", "5 4 3").replace(b" 3 1 0 0 0", b" 3 2 0 0 0")
    factor = float(re.search(rb"BRICK_FLOAT_FACS\s+count = 1\s+(\S+)", head)[1])
    head += b"\ntype = string-attribute\nname = BRICK_LABS\ncount = 10\n'Coef~Tstat~\n"
    values = afni(tmp_path, head.replace(b"count = 1\n   3.88", b"count = 1\n   3.88"), count=2)
    with pytest.raises(SeveralComponents) as caught:
        read_volume(str(tmp_path / "v+orig.HEAD"))
    assert list(caught.value.names) == ["Coef", "Tstat"]
    volume = read_volume(str(tmp_path / "v+orig.HEAD"), ReadOptions(component="Tstat"))
    assert volume.data.dtype == np.float32
    assert factor > 0
    np.testing.assert_allclose(
        read_volume(str(tmp_path / "v+orig.HEAD"), ReadOptions(component=0)).data, values[0] * factor, rtol=1e-6
    )


def test_half_a_pair_and_no_nibabel_are_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    philips(tmp_path, "T1.PAR", 10)
    (tmp_path / "a.PAR").write_bytes((tmp_path / "v.PAR").read_bytes())
    refused(DataError, r"expected \.PAR and \.REC", read_volume, str(tmp_path / "a.PAR"))
    (tmp_path / "v.PAR").write_bytes(b"# === DATA DESCRIPTION FILE ===\n# Research image export tool     V4.2\n")
    refused(DataError, "dcm2niix may convert", read_volume, str(tmp_path / "v.REC"))
    monkeypatch.setitem(sys.modules, "nibabel", None)
    refused(DataError, r"pip install 'nibabel>=5'$", read_volume, str(tmp_path / "v.PAR"))
