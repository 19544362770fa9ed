"""OpenFOAM cases that stop or go on in their processor folders, and cases with fields that VTK cannot read."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from tests import vtk_files as files
from tests.ramps import X, Y, Z, ramp
from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.registry import contents, time_steps

CENTRES = [(a[:-1] + a[1:]) / 2 for a in (X, Y, Z)]
DIMS = (4, 3, 2)


def case(folder: Path, times: dict[str, float], axes=(X, Y, Z)) -> Path:
    """A case whose field "cells" is the ramp plus a number at each time."""
    values = ramp(*((a[:-1] + a[1:]) / 2 for a in axes))
    return files.write_openfoam(folder, axes, {time: values + more for time, more in times.items()})


def decomposed(folder: Path, times: dict[str, float]) -> None:
    """Two parts of the same case, side by side along x."""
    for k, part in enumerate((X[:3], X[2:])):
        case(folder / f"processor{k}", times, (part, Y, Z))


def at(path: Path, step: int | None = None) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return read_volume(str(path), ReadOptions(time=step, dims=DIMS)).data - ramp(*CENTRES)


def test_times_of_the_processor_folders_are_read_where_the_case_lacks_them(tmp_path: Path) -> None:
    path = case(tmp_path, {"0": 7.0})
    decomposed(tmp_path, {"0": 0.0, "2": 5.0})
    with pytest.warns(
        UserWarning, match=r"decomposed case is read.* 2 times up to 2, reconstructed 1 .*reconstructed\.foam"
    ):
        read_volume(str(path), ReadOptions(time=0))
    assert [time[0] for time in time_steps(str(path), ReadOptions())] == [0, 2]
    np.testing.assert_allclose(at(path, 1), 5, atol=1e-3)
    np.testing.assert_allclose(at(path, 0), 0, atol=1e-3)
    other = path.with_name("reconstructed.foam")
    other.touch()
    with pytest.warns(UserWarning, match=r"the reconstructed case is read.*decomposed\.foam"):
        read_volume(str(other))
    np.testing.assert_allclose(at(other), 7, atol=1e-3)


def test_a_case_that_has_all_times_is_read_unless_the_name_asks_for_its_parts(tmp_path: Path) -> None:
    path = case(tmp_path, {"0": 7.0, "2": 7.5, "4": 8.0})
    decomposed(tmp_path, {"0": 0.0, "2": 5.0})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(time_steps(str(path), ReadOptions())) == 3
    other = path.with_name("decomposed.foam")
    other.touch()
    np.testing.assert_allclose(at(other, 1), 5, atol=1e-3)


@pytest.mark.parametrize("whole", [True, False])
def test_the_collated_format_is_named(tmp_path: Path, whole: bool) -> None:
    path = case(tmp_path, {"0": 7.0})
    (tmp_path / "processors2" / "1").mkdir(parents=True)
    if whole:
        with pytest.warns(UserWarning, match=r"collated.*reconstructPar"):
            read_volume(str(path))
    else:
        (tmp_path / "constant").rename(tmp_path / "gone")
        refused(DataError, r"collated.*reconstructPar", read_volume, str(path))


WALLS = "boundaryField { walls { type zeroGradient; } }"
BAD = {
    "code": "internalField #codeStream { code #{ os << 1; #}; };",
    "count": "internalField nonuniform List<scalar> 3(1 2 3);",
    "cut": "internalField nonuniform List<scalar> 24(1 2 ",
    "word": "internalField nonuniform List<scalar> 2(1 a);",
    "include": '#include "missing"\ninternalField uniform $x;',
}


@pytest.mark.parametrize(("kind", "parts"), [*((kind, False) for kind in BAD), ("cut", True)])
def test_one_field_that_cannot_be_read_leaves_the_others(tmp_path: Path, kind: str, parts: bool) -> None:
    path = case(tmp_path, {"0": 7.0})
    later = files.foam_text(
        "volScalarField", "later", f"dimensions [0 0 0 0 0 0 0];\ninternalField uniform 1;\n{WALLS}"
    )
    folder = tmp_path
    if parts:
        decomposed(tmp_path, {"0": 7.0, "1": 7.0})
        folder = tmp_path / "processor1"
    text = files.foam_text("volScalarField", "T", f"dimensions [0 0 0 1 0 0 0];\n{BAD[kind]}\n{WALLS}")
    (folder / "0" / "T").write_text(text)
    (folder / "3").mkdir()
    (folder / "3" / "later").write_text(later)  # which is not lost at time 0
    with pytest.warns(UserWarning, match=r"without T(, later)?, which VTK cannot read"):
        volume = read_volume(str(path), ReadOptions(array="cells", time=0, dims=DIMS))
    np.testing.assert_allclose(volume.data - ramp(*CENTRES), 7, atol=1e-3)
    refused(DataError, "VTK cannot read field T ", read_volume, str(path), ReadOptions(array="T", time=0))
    with pytest.warns(UserWarning, match="without T"):
        assert [row["array"] for row in contents(str(path), ReadOptions())["arrays"]] == ["cells"]
    with pytest.raises(UsageError, match="no array 'U'"), pytest.warns(UserWarning, match="without T"):
        read_volume(str(path), ReadOptions(array="U", time=0))


def test_a_mesh_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    path = case(tmp_path, {"0": 7.0})
    owner = tmp_path / "constant" / "polyMesh" / "owner"
    owner.write_text(owner.read_text().replace("\n1\n", "\nx\n", 1))
    refused(DataError, r"is the OpenFOAM file whole|finds no dataset", read_volume, str(path))


def test_regions(tmp_path: Path) -> None:
    path = case(tmp_path, {"0": 7.0})
    (tmp_path / "constant" / "fluid").mkdir()
    (tmp_path / "constant" / "polyMesh").rename(tmp_path / "constant" / "fluid" / "polyMesh")
    (tmp_path / "0" / "fluid").mkdir()
    (tmp_path / "0" / "cells").rename(tmp_path / "0" / "fluid" / "cells")
    np.testing.assert_allclose(at(path), 7, atol=1e-3)
