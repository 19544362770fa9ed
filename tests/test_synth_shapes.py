"""Shapes: what each has of what it is for; the NRRD that `vvgt synth` writes."""

import numpy as np
import pytest

from vvgt_cli.errors import UsageError
from vvgt_cli.volume import read_volume
from vvgt_cli.volume.shapes import SHAPES, make_shape
from vvgt_cli.volume.types import Volume
from vvgt_cli.volume.writers import write_nrrd


@pytest.mark.parametrize("kind", SHAPES)
def test_a_seed_gives_one_volume(kind):
    one, same, other = (make_shape(kind, 24, seed).data for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert np.abs(one - other).max() > 0.1
    assert one.shape == (24, 24, 24)
    assert one.dtype == np.float32
    assert -0.3 < one.min() < one.max() < 1.3


def test_shells_lie_within_each_other():
    for seed in range(4):
        values = make_shape("shells", 48, seed).data
        body = values > 0.1
        assert not body[0].any()  # air all around
        assert 0.1 < body.mean() < 0.6
        line = values[24, 24]
        inner = line[np.flatnonzero(line > 0.1)]
        assert np.ptp(inner) > 0.1  # bodies of several values


def test_noise_has_the_spectrum_of_a_power_law():
    power = np.abs(np.fft.fftn(make_shape("noise", 48, 0).data.astype(np.float64))) ** 2
    line = np.fft.fftfreq(48, 1 / 48)
    k = np.sqrt(line[:, None, None] ** 2 + line[None, :, None] ** 2 + line[None, None, :] ** 2)
    shells = np.arange(2, 14)
    means = [power[(k >= i - 0.5) & (k < i + 0.5)].mean() for i in shells]
    slope = np.polyfit(np.log(shells), np.log(means), 1)[0]
    assert -5.4 < slope < -3.0  # twice the amplitude's, 1.6 to 2.6
    assert power[k > 17].max() < 1e-10 * power[0, 0, 0]


def test_a_volume_written_as_nrrd_reads_back(tmp_path):
    values = np.random.default_rng(0).normal(size=(3, 4, 5)).astype(np.float32)
    volume = Volume(values, (0.1, 2.0, 1 / 3), (1.0, -2.5, 1e-7), slope=2.0, intercept=-1.0)
    write_nrrd(tmp_path / "v.nrrd", volume)
    back = read_volume(str(tmp_path / "v.nrrd"))
    assert np.array_equal(back.data, values * np.float32(2) - np.float32(1))
    assert back.spacing == pytest.approx(volume.spacing, rel=1e-15)
    assert back.origin == pytest.approx(volume.origin, rel=1e-15)
    write_nrrd(tmp_path / "v.nrrd", Volume(values.astype(">f8")), overwrite=True)
    assert np.array_equal(read_volume(str(tmp_path / "v.nrrd")).data, values)


@pytest.mark.parametrize("kind", ["tubes", "stratified"])
def test_the_command_writes_what_it_reports(kind, tmp_path, vvgt):
    more = [] if kind == "tubes" else ["--turnovers", "0.1"]
    result = vvgt.ok("synth", kind, "--size", 16, "--seed", 3, *more, "-o", tmp_path / "v.nrrd")
    volume = read_volume(str(tmp_path / "v.nrrd"))
    assert volume.dims == (16, 16, 16)
    assert np.ptp(volume.data) > 0
    if kind == "stratified":
        assert "temperature after 0.1 turnovers" in result.err
        assert volume.data.min() < 0 < volume.data.max()  # a departure from the mean


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["tubes", "--field", "speed"], "apply only to turbulence"),
        (["noise", "--turnovers", 1], "apply only to turbulence"),
        (["isotropic", "--field", "temperature"], "applies only to stratified turbulence"),
        (["tubes", "--size", 4], "--size"),
        (["cheese"], "cheese"),
    ],
)
def test_what_a_kind_does_not_have_is_refused(args, message, tmp_path, vvgt):
    assert message in vvgt.fails(2, "synth", *args, "-o", tmp_path / "v.nrrd")
    assert not list(tmp_path.iterdir())


def test_a_shape_of_no_size():
    with pytest.raises(UsageError, match="at least 8"):
        make_shape("noise", 4)


def test_a_file_is_not_overwritten_and_its_name_describes_it(tmp_path, vvgt):
    (tmp_path / "v.nrrd").write_text("mine")
    assert "--overwrite" in vvgt("synth", "noise", "--size", 8, "-o", tmp_path / "v.nrrd").error
    assert (tmp_path / "v.nrrd").read_text() == "mine"
    assert ".nrrd" in vvgt("synth", "noise", "--size", 8, "-o", tmp_path / "v.ply").error
