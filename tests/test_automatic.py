"""The function that is made when none is given, from files to its unit distance."""

from pathlib import Path

import numpy as np
import pytest

from tests.test_volume_slices import write_series
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.look.histogram import _side
from vvgt_cli.look.recognise import air_and_tissue, in_hounsfield
from vvgt_cli.volume import ReadOptions, read_volume


@pytest.mark.parametrize(
    ("changes", "units"),
    [
        ({"Modality": "CT"}, True),
        ({"Modality": "CT", "RescaleType": "HU"}, True),
        ({"Modality": "CT", "RescaleType": "US"}, False),
        ({"Modality": "CT", "RescaleIntercept": None, "RescaleSlope": None}, False),
        ({"Modality": "MR"}, False),
    ],
)
def test_dicom_states_which_values_are_hounsfield_units(tmp_path: Path, changes: dict, units: bool) -> None:
    write_series(tmp_path, **changes)
    assert read_volume(str(tmp_path)).hounsfield == units
    name = "automatic (Hounsfield units)" if units else "automatic (histogram)"
    assert load(SourceRequest(str(tmp_path))).tf.name == name  # a ramp: by its values it is no scan


def test_opacity_is_per_a_share_of_the_longest_edge(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.random.default_rng(0).exponential(10, (16, 8, 4)))
    read = ReadOptions(spacing=(1.0, 2.0, 4.0))
    made = load(SourceRequest(str(tmp_path / "a.npy"), read))
    assert (made.unit_distance, made.unit_label) == (64 / 256, "automatic")
    asked = load(SourceRequest(str(tmp_path / "a.npy"), read, unit_distance="mean-spacing"))
    assert (asked.unit_distance, asked.unit_label) == (7 / 3, "mean-spacing")


def test_a_constant_volume_is_a_box_with_a_warning(tmp_path: Path) -> None:
    np.save(tmp_path / "zero.npy", np.zeros((4, 4, 4), np.uint8))
    with pytest.warns(UserWarning, match=r"zero: every voxel is 0, so only the box is visible; check --dtype"):
        source = load(SourceRequest(str(tmp_path / "zero.npy")))
    assert 0 < source.tf.opacity(np.zeros(1))[0] < 0.05


def test_colours_go_half_by_rank_and_half_by_value() -> None:
    """Five bins of a hundred voxels; colours that are their own numbers."""
    counts, colors = np.array([0.0, 10, 30, 0, 60]), np.repeat(np.arange(5.0)[:, None], 3, axis=1)
    x, _, rgb = _side(counts, 100.0, colors)
    assert x.tolist() == [0, 1.5, 2.5, 4.5, 5]
    rank, value = np.array([0, 0.05, 0.25, 0.7, 1]), x / 5
    np.testing.assert_allclose(rgb[:, 0], 4 * (rank + value) / 2)


def test_hounsfield_units_are_known_by_air_alone_where_values_reach_bone() -> None:
    rng = np.random.default_rng(4)
    for bone, known in ((900, True), (200, False)):  # a skull without soft tissue; nothing that tells it from others
        values = np.concatenate([rng.normal(-1000, 10, 9000), rng.uniform(-900, bone, 1000)]).reshape(10, 10, 100)
        counts, edges = np.histogram(values, 256)
        assert in_hounsfield(counts.astype(float), edges) == known
        assert not air_and_tissue(counts.astype(float), edges)
    counts, edges = np.histogram(np.concatenate([rng.normal(0, 10, 9000), rng.uniform(100, 1900, 1000)]), 256)
    assert not in_hounsfield(counts.astype(float), edges)
