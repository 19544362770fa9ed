"""Functions that training scenes are made with; no torch is needed."""

import numpy as np

from vvgt_cli.look.readers import minimal
from vvgt_cli.look.suggest import Suggestion
from vvgt_cli.network.training.scenes import merge_bands


def test_functions_together_show_each_where_it_is():
    band = lambda lo, hi, opacity: Suggestion(  # noqa: E731
        "band", np.array([lo, hi]), np.array([opacity, opacity]), np.array([[1.0, 0, 0], [0, 1.0, 0]]), 2.0, 0.1
    )
    alone = minimal.read(merge_bands([band(0, 1, 0.1)], [1.0]), "t")
    assert np.allclose(alone.opacity(np.array([0.25, 0.5])), 0.1)
    denser = minimal.read(merge_bands([band(0, 1, 0.1)], [3.0]), "t")
    assert np.allclose(denser.opacity(np.array([0.5])), 1 - 0.9**3)
    both = minimal.read(merge_bands([band(0, 1, 0.1), band(0, 1, 0.3)], [1.0, 1.0]), "t")
    assert np.allclose(both.opacity(np.array([0.5])), 0.4)
    solid = merge_bands([band(0, 1, 0.9), band(0, 1, 0.9)], [8.0, 8.0])
    assert max(point["opacity"] for point in solid["points"]) < 1
    assert solid["opacity_unit_distance"] == 2.0


def test_colors_of_overlapping_functions_are_means_by_opacity():
    def band(lo, hi, opacity, rgb):
        return Suggestion("band", np.array([lo, hi]), np.full(2, opacity), np.array([rgb, rgb]), 2.0, 0.1)

    merged = merge_bands([band(0.0, 2.0, 0.1, [1.0, 0, 0]), band(1.0, 3.0, 0.3, [0, 0.5, 1.0])], [1.0, 2.0])
    second = 1 - 0.7**2
    found = {point["x"]: (point["opacity"], point["rgb"]) for point in merged["points"]}
    expected = {
        0.0: (0.1, [1, 0, 0]),
        1.0: (0.1 + second, np.array([0.1, second * 0.5, second]) / (0.1 + second)),
        2.0: (0.1 + second, np.array([0.1, second * 0.5, second]) / (0.1 + second)),
        3.0: (second, [0, 0.5, 1]),
    }
    assert list(found) == list(expected)
    for x, (opacity, rgb) in expected.items():
        np.testing.assert_allclose(found[x][0], opacity)
        np.testing.assert_allclose(found[x][1], rgb)
