"""`--split-labels`: the files' Gaussians are those of the whole, each once, and what the whole hides is there too."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.processes import VVGT, python
from vvgt_cli.closed_form import VbmOptions
from vvgt_cli.closed_form.tree import HIDDEN
from vvgt_cli.conversion import labels as split
from vvgt_cli.conversion.changes import around
from vvgt_cli.conversion.labels import HiddenCells, assign_labels
from vvgt_cli.conversion.request import file_bytes
from vvgt_cli.conversion.stages import ViewingConditions
from vvgt_cli.field.field import Resident
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import Gaussians, read_ply
from vvgt_cli.look.labels import distinct
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.score.views import score_test_views
from vvgt_cli.volume import Volume

SMALL = ("--max-gaussians", 600, "--screen", 64, "--steps", 0)


def nested(n: int = 24, cut: bool = False) -> np.ndarray:
    """A ball of label 3 in one of label 1, both solid, an octant of the outer one cut away where asked for."""
    z, y, x = np.mgrid[:n, :n, :n] - (n - 1) / 2
    radius = np.sqrt(x * x + y * y + z * z)
    found = np.where(radius < n / 4, 3, np.where(radius < n / 2.2, 1, 0)).astype(np.uint8)
    return np.where((x > 0) & (y > 0) & (z > 0) & (found == 1), 0, found).astype(np.uint8) if cut else found


def converted(vvgt, tmp_path: Path, values: np.ndarray, *options) -> dict[int, Gaussians]:
    np.save(tmp_path / "v.npy", values)
    out = ("--split-labels", *SMALL, "-o", tmp_path / "p_{}.ply", "--overwrite")
    vvgt.ok("convert", tmp_path / "v.npy", "--labels", "auto", *out, *options)
    index = json.loads((tmp_path / "p_index.json").read_text())
    return {row["label"]: read_ply(str(tmp_path / row["file"]))[0] for row in index["files"]}


def rows(gaussians: Gaussians) -> list[bytes]:
    return [row.tobytes() for row in np.column_stack([gaussians.means, gaussians.opacity_logits])]


def test_the_files_hold_the_gaussians_of_the_whole(vvgt, tmp_path: Path, monkeypatch) -> None:
    made = []
    fitted = split._fit
    monkeypatch.setattr(split, "_fit", lambda request, console: made.append(fitted(request, console)) or made[-1])
    files = converted(vvgt, tmp_path, nested(cut=True), "--light", "none")
    whole, together = rows(made[-1]), [row for part in files.values() for row in rows(part)]
    assert sorted(files) == [1, 3]
    assert len(together) <= 600
    assert len(set(together)) == len(together)
    assert set(whole) < set(together)  # and what the cut does not show of the core
    for number, part in files.items():
        wanted = distinct([number]).labels[0].color
        assert np.median(np.abs(part.colors - wanted).max(axis=1)) < 0.1  # on borders with a touch of the other's


def test_what_others_hide_is_there_when_they_are_switched_off(vvgt, tmp_path: Path) -> None:
    report = ("--report", tmp_path / "r_{}.json")
    core = converted(vvgt, tmp_path, nested(), *report)[3]
    np.testing.assert_allclose(core.means.max(axis=0) - core.means.min(axis=0), 1.0, atol=0.25)  # 12 voxels of 24
    assert len(core) > 50
    scores = json.loads((tmp_path / "r_3-label-3.json").read_text())
    assert scores["scores"]["psnr"] > 25
    assert [stage["name"] for stage in scores["plan"]["stages"]] == ["test views", "conditions"]
    assert scores["gaussians"] == len(core)


def test_every_label_is_told_of(vvgt, tmp_path: Path) -> None:
    """Also where a line says of several labels the same."""
    values = nested(16)
    values[values == 3] += np.arange(16, dtype=np.uint8)[np.nonzero(values == 3)[0]] // 8
    np.save(tmp_path / "v.npy", values)
    few = ("--max-gaussians", 60, "--screen", 24, "--steps", 0)
    told = vvgt.ok(
        "convert", tmp_path / "v.npy", "--labels", "auto", "--split-labels", *few, "-o", tmp_path / "{}.ply"
    ).err
    assert told.count("converting what others hide of it") == 3, told


def test_the_plan_of_a_part_is_of_the_gaussians_that_it_got(vvgt, tmp_path: Path, monkeypatch) -> None:
    counts, cost = [], ViewingConditions.cost
    monkeypatch.setattr(
        ViewingConditions, "cost", lambda stage, workload: counts.append(workload.gaussians) or cost(stage, workload)
    )
    files = converted(vvgt, tmp_path, nested(cut=True), "--report", tmp_path / "p_{}.json")
    names = {1: "p_1-label-1.json", 3: "p_3-label-3.json"}  # beside p_index.json
    for number, name in names.items():
        plan = json.loads((tmp_path / name).read_text())["plan"]
        assert plan["gaussians"] == len(files[number])
        assert plan["bytes"] == file_bytes(len(files[number]), 2)  # lit
        assert len(files[number]) in counts


def test_a_single_label_and_one_that_is_nowhere(vvgt, tmp_path: Path) -> None:
    assert list(converted(vvgt, tmp_path, np.where(nested() == 3, 3, 0))) == [3]
    line = ("convert", tmp_path / "v.npy", "--labels", "auto", "--split-labels", "-o", "p_{}.ply")
    assert "--max-megabytes with labels: the limit is for one cloud" in vvgt(*line, "--max-megabytes", 1).error
    time = vvgt.fails(2, "convert", tmp_path / "v.npy", "--labels auto --split-labels --time-budget 9 -o", "p_{}.ply")
    assert "--time-budget with labels: it is for one conversion" in time


def test_standard_input_is_read_once(tmp_path: Path) -> None:
    raw = ("--dims", "24", "24", "24", "--dtype", "uint8", "--labels", "auto", "--split-labels", "-o", "p_{}.ply")
    python(*VVGT, "convert", "-", *raw, *SMALL, cwd=tmp_path, given=nested(cut=True).tobytes(), text=False)
    assert len(list(tmp_path.glob("p_*.ply"))) == 2


def test_the_surface_of_labels_is_where_a_grazing_ray_is_half_covered(monkeypatch) -> None:
    """The closed form of a solid ball, nearer than with the surface where a cell is half opaque."""
    from vvgt_cli.closed_form import VbmOptions, initialise, surface_offset

    solid = Volume(np.where(nested() > 0, 1, 0).astype(np.uint8))
    source = load(SourceRequest(solid, labels=distinct([1]), light=LightOptions(("none",))))
    assert source.scene().labels

    def score() -> float:
        gaussians = initialise(source.scene(), VbmOptions(max_gaussians=1500, size=256)).gaussians
        return score_test_views(source.scene(), gaussians, 256).psnr

    ours = score()
    monkeypatch.setattr(surface_offset, "LABEL_DEPTH", surface_offset.OPAQUE_DEPTH)
    assert ours > score() + 1


def test_gaussians_are_assigned_to_the_label_with_most_of_them() -> None:
    """A box of label 1 beside one of label 2 along x, which is faint."""
    values = np.zeros((8, 8, 16), np.uint8)
    values[:, :, 2:8], values[:, :, 8:14] = 1, 2
    volume = Volume(values)
    table = distinct([1, 2])
    shown = [(volume, table, label) for label in table.labels]
    x = np.array([-0.5, 0.5, 0.02, -0.95])
    means = np.column_stack([x, 0 * x, 0 * x])
    wide = np.log(np.broadcast_to([[0.05, 0.01, 0.01]], (4, 3)))
    turned = np.tile([1.0, 0, 0, 0], (4, 1))
    colors = np.array([table.labels[k].color for k in (1, 0, 0, 1)])  # as it should not be told
    gaussians = Gaussians(means, wide, turned, np.zeros(4), colors)
    np.testing.assert_array_equal(assign_labels(gaussians, shown), [0, 1, 1, 0])  # the last lies beside label 1
    along_y = Gaussians(means, wide, np.tile([np.sqrt(0.5), 0, 0, np.sqrt(0.5)], (4, 1)), np.zeros(4), colors)
    np.testing.assert_array_equal(assign_labels(along_y, shown)[:3], [0, 1, 1])
    faint = [(volume, table, label) for label in (shown[0][2], split.replace(shown[1][2], opacity=0.01))]
    assert assign_labels(gaussians, faint)[2] == 0  # most of its extinction, not of its voxels


def test_gaussians_near_no_label_are_told_by_colours_that_light_darkens() -> None:
    volume, table = Volume(np.zeros((8, 8, 8), np.uint8)), distinct([1, 2, 3])
    shades = ((0.24, 0.24, 0.24), (0.96, 0.96, 0.96), (0.8, 0.1, 0.1))
    labels = [split.replace(label, color=rgb) for label, rgb in zip(table.labels, shades, strict=True)]
    colors = np.array([*shades, (0.4, 0.05, 0.05), (0.7, 0.7, 0.7)])
    means, turned = np.zeros((5, 3)), np.tile([1.0, 0, 0, 0], (5, 1))
    gaussians = Gaussians(means, np.full((5, 3), -4.0), turned, np.zeros(5), colors)
    for order in ((0, 1, 2), (2, 1, 0)):
        found = assign_labels(gaussians, [(volume, table, labels[k]) for k in order])
        np.testing.assert_array_equal(np.array(order)[found], [0, 1, 2, 2, 1])


def hidden_of(source):
    form = Resident(source).pyramid(VbmOptions(600, 64)).form
    unseen = ~around(form.seen.largest > HIDDEN, np.maximum)
    return HiddenCells(unseen, form.seen.edge, form.half, form.step)


@pytest.mark.parametrize("cut", [False, True])
def test_hidden_cells_are_those_that_no_view_sees(cut: bool) -> None:
    values = nested(cut=cut)
    source = load(SourceRequest(Volume(values), labels="auto"))
    hides = hidden_of(source)
    assert hides.meet_label(source.volume, 3)
    assert hides.meet_label(source.volume, 1)  # its wall towards the core
    alone = load(SourceRequest(Volume(np.where(values == 3, 3, 0)), labels="auto"))
    assert not hidden_of(alone).meet_label(alone.volume, 3)
    centre = np.zeros((2, 3))
    centre[1] = -0.95 / np.sqrt(3)  # on the outer surface, opposite to the cut
    points = Gaussians(centre, centre * 0 - 3, np.tile([1.0, 0, 0, 0], (2, 1)), np.zeros(2), centre)
    np.testing.assert_array_equal(hides.contain(points), [True, False])


def test_a_label_is_hidden_where_its_surface_is():
    """Each voxel hidden alone: its label is hidden somewhere where a neighbour is of another, or the box ends."""
    numbers = np.ones((5, 6, 7), np.uint8)
    numbers[1, 4, 3] = numbers[3, 2, 2] = numbers[4, 0, 6] = 2
    around = np.pad(numbers, 1)
    for z, y, x in np.ndindex(numbers.shape):
        cells = np.zeros(numbers.shape, bool)
        cells[z, y, x] = True
        hidden = HiddenCells(cells, np.ones(3), np.full(3, 0.5), np.ones(3))
        number, middle = numbers[z, y, x], np.array([z, y, x]) + 1
        moves = np.concatenate([np.eye(3, dtype=int), -np.eye(3, dtype=int)])
        surface = any(around[tuple(middle + move)] != number for move in moves)
        assert hidden.meet_label(Volume(numbers), number) == surface, (z, y, x)
        assert not hidden.meet_label(Volume(numbers), 3 - number)
