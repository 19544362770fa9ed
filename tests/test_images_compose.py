"""Backgrounds, comparison strips, sheets, and files that appear whole or not at all."""

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import atomic_write
from vvgt_cli.images import captioned, contact_sheet, over, side_by_side


def test_over_black_white_and_colour():
    image = np.array([[[0.2, 0.1, 0.0, 0.5], [0, 0, 0, 0]]], dtype=np.float32)
    np.testing.assert_allclose(over(image), [[[0.2, 0.1, 0.0], [0, 0, 0]]], atol=1e-7)
    np.testing.assert_allclose(over(image, 1.0), [[[0.7, 0.6, 0.5], [1, 1, 1]]], atol=1e-7)
    np.testing.assert_allclose(over(image, (0, 0.5, 1)), [[[0.2, 0.35, 0.5], [0, 0.5, 1]]], atol=1e-7)
    refused(DataError, "four channels", over, np.zeros((2, 2, 3)))


def test_side_by_side_holds_both_and_the_difference():
    left, right = np.full((2, 3, 3), 0.5), np.full((2, 3, 4), 0.25)
    strip = side_by_side(left, right, gain=2)
    assert strip.shape == (2, 9, 3)
    np.testing.assert_allclose(strip[0, [0, 3, 6], 0], [0.5, 0.25, 0.5])
    assert side_by_side(left, right, gain=100)[..., 6:, :].max() == 1
    refused(DataError, "same size", side_by_side, left, right[:1])


def test_captions_say_what_is_seen_and_how_near_it_is():
    one, two = (side_by_side(np.full((60, 200, 3), 0.5), np.full((60, 200, 3), x)) for x in (0.51, 0.6))
    sheet = captioned(np.concatenate([one, two]), 2)
    assert sheet.shape == (2 * (60 + 18), 600, 3)
    np.testing.assert_array_equal(sheet[18:78], one)
    np.testing.assert_array_equal(sheet[96:], two)
    upper, lower = sheet[:18], sheet[78:96]
    lit = [(upper[:, 200 * k : 200 * k + 200] > 0.5).any() for k in range(3)]
    assert lit == [True] * 3
    assert [np.array_equal(upper[:, 200 * k : 200 * k + 200], lower[:, 200 * k : 200 * k + 200]) for k in range(3)] == [
        True,
        False,
        True,
    ]  # 40.0 and 20.0 dB


def test_contact_sheet_places_images_row_by_row():
    images = [np.full((2, 3, 3), value / 10) for value in range(5)]
    sheet = contact_sheet(images, background=(1, 1, 1))
    assert sheet.shape == (2 * 2 + 4, 3 * 3 + 8, 3)
    np.testing.assert_allclose(sheet[[0, 0, 0, 6, 6], [0, 7, 14, 0, 7], 0], [0, 0.1, 0.2, 0.3, 0.4], atol=1e-7)
    assert (sheet[2:6] == 1).all()  # a gap
    assert (sheet[6:, 10:] == 1).all()  # the place left over
    assert contact_sheet(images[:2]).shape == (2, 2 * 3 + 4, 3)
    for bad in ([], [np.zeros((2, 2, 3)), np.zeros((2, 3, 3))]):
        refused(DataError, "one size", contact_sheet, bad)


def test_atomic_write_leaves_nothing_on_failure(tmp_path):
    target = tmp_path / "a.txt"

    def fail():
        with atomic_write(target) as temporary:
            temporary.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert not list(tmp_path.iterdir())
    with pytest.raises(DataError, match=r"a\.txt: cannot be written \(No space left"), atomic_write(target):
        raise OSError(28, "No space left on device")
    assert not list(tmp_path.iterdir())


def test_atomic_write_checks_the_target(tmp_path):
    target = tmp_path / "a.txt"
    with atomic_write(target) as temporary:
        assert temporary.suffix == ".txt"
        assert temporary.parent == tmp_path
        temporary.write_text("one")
        assert not target.exists()
    assert target.read_text() == "one"
    with pytest.raises(UsageError, match="--overwrite"), atomic_write(target):
        pytest.fail("must not start")
    with pytest.raises(UsageError, match="does not exist"), atomic_write(tmp_path / "no" / "a.txt"):
        pytest.fail("must not start")
    with pytest.raises(UsageError, match="is a folder"), atomic_write(tmp_path):
        pytest.fail("must not start")


def test_atomic_write_does_not_replace_what_appeared_meanwhile(tmp_path):
    target = tmp_path / "a.txt"

    def race():
        with atomic_write(target) as temporary:
            temporary.write_text("ours")
            target.write_text("theirs")

    refused(UsageError, "--overwrite", race)
    assert target.read_text() == "theirs"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
