"""VASP's grids, written as VASP's wiki has them: cell, scale, factors of values, blocks of spin."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError, SeveralComponents
from vvgt_cli.volume import ReadOptions, read_volume

CELL = np.array([[4.0, 0, 0], [1, 5, 0], [0.5, 0.2, 6]])  # of volume 120
VALUES = np.random.default_rng(3).random((4, 3, 2)).round(6)  # z, y, x


def chgcar(blocks: Sequence[np.ndarray], scale: str = "1.0", elements: str = "Si O", more: str = "") -> str:
    """A file of blocks (z, y, x), x fastest, five values a line, each with augmentation behind it."""
    text = f"a comment\n   {scale}\n" + "".join("  {:.6f} {:.6f} {:.6f}\n".format(*row) for row in CELL)
    text += (f" {elements}\n" if elements else "") + f" 2 1\n{more}Direct\n" + " 0.1 0.2 0.3\n" * 3 + "\n"
    for values in blocks:
        text += "  {} {} {}\n".format(*values.shape[::-1])
        words = [f"{v:.11E}" for v in values.ravel()]
        text += "".join(" " + " ".join(words[k : k + 5]) + "\n" for k in range(0, len(words), 5))
        text += "augmentation occupancies   1  3\n  0.1 0.2 0.3\n"
    return text


def put(folder: Path, name: str, text: str) -> str:
    (folder / name).write_text(text)
    return str(folder / name)


@pytest.mark.parametrize(
    ("scale", "factor"), [("1.0", 1.0), ("2.0", 2.0), ("-960.0", 2.0), ("1.0 1.0 3.0", np.array([1.0, 1, 3]))]
)
@pytest.mark.parametrize(("elements", "more"), [("Si O", ""), ("", ""), ("Si O", "Selective dynamics\n")])
def test_densities_lie_on_a_periodic_cell(tmp_path, scale, factor, elements, more) -> None:
    volume = read_volume(put(tmp_path, "CHGCAR", chgcar([VALUES], scale, elements, more)))
    cell = CELL * factor
    np.testing.assert_allclose(volume.affine[:3, :3].T * np.array([[2], [3], [4]]), cell)
    assert volume.origin == (0, 0, 0)
    assert (volume.preset, volume.unit) == ("density", "angstrom")
    np.testing.assert_allclose(volume.slope * volume.data, VALUES / np.linalg.det(cell), rtol=1e-6)


@pytest.mark.parametrize("name", ["LOCPOT", "ELFCAR", "LOCPOT.vasp"])
def test_potentials_are_as_stored(tmp_path: Path, name: str) -> None:
    assert read_volume(put(tmp_path, name, chgcar([VALUES]))).slope == 1
    with pytest.warns(UserWarning, match="taken as a density"):
        assert read_volume(put(tmp_path, "a.vasp", chgcar([VALUES]))).slope == pytest.approx(1 / 120)


def test_blocks_of_spin_are_components(tmp_path: Path) -> None:
    source = put(tmp_path, "CHGCAR_sum", chgcar([VALUES, VALUES - 0.5]))
    refused(SeveralComponents, "total, then magnetization", read_volume, source)
    for k in range(2):
        np.testing.assert_allclose(read_volume(source, ReadOptions(component=k)).data, VALUES - 0.5 * k, atol=1e-7)


def test_what_has_no_grid_is_an_error(tmp_path: Path) -> None:
    whole = chgcar([VALUES])
    for text, message in (
        (whole[: whole.index("\n\n") + 2], "where the size of a grid was expected"),
        (whole.replace("2 3 4", "2 3 400"), "2 x 3 x 400"),
        (whole.replace("4.000000 0.000000 0.000000", "1.000000 5.000000 0.000000"), "expected three sizes, a volume"),
    ):
        refused(DataError, message, read_volume, put(tmp_path, "CHGCAR", text))
