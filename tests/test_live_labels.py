"""Gaussians that carry the label under them, and their look under any table."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli as vvgt_library
from tests.refused import refused
from tests.test_live import SMALL, cloud
from tests.test_page_look import options, page_of
from vvgt_cli.closed_form.gaussian_samples import labels_and_gradients
from vvgt_cli.conversion.live import label_fog
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply, write_ply
from vvgt_cli.gaussians.formats import read_columns
from vvgt_cli.gaussians.header import legend_text
from vvgt_cli.gaussians.live import Palette, apply_look, baked, opacities, visible_under
from vvgt_cli.gaussians.live_facts import LABEL_ROW, LiveFacts
from vvgt_cli.look.label_files import read_labels
from vvgt_cli.look.labels import Label, LabelTable
from vvgt_cli.volume import Volume

LABELS = (
    Label(3, "liver", (0.6, 0.3, 0.2), 0.5),
    Label(7, "</script><b>x \u00e9", (0.1, 0.9, 0.4), 1.0),
    Label(300, "none", (1.0, 1.0, 0.0), 0.0),
)


def labels_cloud(labels: tuple[Label, ...] = LABELS) -> Gaussians:
    some = cloud()
    row = np.arange(len(some)) % len(labels)
    return replace(some, live=np.column_stack([np.zeros((len(some), 2)), some.live[:, 2:], row]))


def facts(labels: tuple[Label, ...] = LABELS) -> LiveFacts:
    return LiveFacts(3.0, 300.0, (9, 8, 7), labels=labels)


def halves() -> Volume:
    """A label map: 1 for x below 8, 2 beyond; nothing for z beyond 12."""
    data = np.ones((16, 16, 16), np.uint8)
    data[:, :, 8:] = 2
    data[12:] = 0
    return Volume(data, (1.0, 1.0, 1.0), name="halves_label")


def test_a_gaussian_has_its_labels_color_and_extinction_where_it_is() -> None:
    some = labels_cloud()
    assert some.live is not None
    some.live[:, 3:9] = 0  # axis and gradient: in no surface
    shown = apply_look(some, Palette.of_labels(LABELS, 0.05))
    for row, label in enumerate(LABELS[:2]):
        own = some.live[:, LABEL_ROW] == row
        np.testing.assert_allclose(shown.colors[own], np.tile(label.color, (own.sum(), 1)), atol=1e-6)
        tau = -np.log1p(-min(label.opacity, 1 - 1e-5)) / 0.05
        opacity = 1 / (1 + np.exp(-shown.opacity_logits[own].astype(float)))
        length, variances = some.live[own, 2].astype(float), np.exp(2 * shown.log_scales[own].astype(float))
        np.testing.assert_allclose(opacity, opacities(tau * length**3, variances, 0.0), atol=2e-5)
        np.testing.assert_allclose(np.sort(shown.log_scales[own]), np.sort(some.log_scales[own]), atol=1e-5)
    np.testing.assert_allclose(shown.means, some.means, atol=1e-6)
    assert set(some.live[visible_under(some, Palette.of_labels(LABELS, 0.05)), LABEL_ROW]) == {0, 1}


def test_a_ply_keeps_labels_in_a_byte_and_names_in_its_header(tmp_path: Path) -> None:
    some = baked(labels_cloud(), Palette.of_labels(LABELS, 0.05))
    write_ply(tmp_path / "a.ply", some, PlyOptions(up="y", scale=0.1, centre=(1, 2, 3), live=facts()))
    back, header = read_ply(tmp_path / "a.ply")
    assert header.live == facts()
    assert header.dtype["label"] == np.uint8
    np.testing.assert_array_equal(back.live[:, [0, 1, 2, LABEL_ROW]], some.live[:, [0, 1, 2, LABEL_ROW]])  # type: ignore[index]
    many = tuple(Label(n, f"n{n}", (0.5, 0.5, 0.5)) for n in range(1, 301))
    row = np.full(len(some), 299.0)
    last = replace(some, live=np.column_stack([labels_cloud().live[:, :LABEL_ROW], row]))  # type: ignore[index]
    write_ply(tmp_path / "b.ply", last, PlyOptions(live=facts(many)))
    assert read_ply(tmp_path / "b.ply")[1].dtype["label"] == np.dtype("<u2")
    assert read_ply(tmp_path / "b.ply")[0].live[0, LABEL_ROW] == 299  # type: ignore[index]
    long = tuple(replace(label, name="\u97f3" * 200) for label in many)
    write_ply(tmp_path / "e.ply", last, PlyOptions(live=facts(long)))
    assert read_columns(tmp_path / "e.ply").comments == read_ply(tmp_path / "e.ply")[1].comments
    longest = tuple(replace(label, name="\U0001f9e0" * 300) for label in many)
    refused(
        vvgt_library.DataError,
        "shorten the names",
        write_ply,
        tmp_path / "f.ply",
        last,
        PlyOptions(live=facts(longest)),
    )
    whole = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "c.ply").write_bytes(whole.replace(b"live label 300", b"live labex 300", 1))
    refused(vvgt_library.DataError, "expected one that vvgt writes", read_ply, tmp_path / "c.ply")
    (tmp_path / "d.ply").write_bytes(whole[:-1] + b"\x09")
    refused(vvgt_library.DataError, "row 9", read_ply, tmp_path / "d.ply")


def test_labels_in_the_header_of_a_file_without_their_column_are_ignored(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", cloud(), options())
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(
        content.replace(b"end_header\n", b'comment vvgt live label 1 0 0 0 1 "a"\nend_header\n', 1)
    )
    gaussians, header = read_ply(tmp_path / "b.ply")
    assert header.live is None
    assert gaussians.live is None


NAMES = ("left  kidney", ' "upper"  lobe\\ ', "\u80be\u810f \U0001f9e0  \u00e9", "a\nb\tc", "0 1 1 1", "x" * 200, "")


def test_names_of_labels_are_kept_whole(tmp_path: Path) -> None:
    labels = tuple(Label(n, name, (0.5, 0.5, 0.5)) for n, name in enumerate(NAMES))
    known = replace(facts(labels), name="a  layer")
    two = replace(known, distance=0.5, others=(replace(known, distance=0.5, name='b "2"'),))
    some = baked(labels_cloud(labels), Palette.of_labels(labels, 0.05))
    both = replace(some, live=np.column_stack([some.live, np.arange(len(some)) % 2]))  # type: ignore[arg-type]
    for gaussians, given in ((some, known), (both, two)):
        (tmp_path / "a.ply").unlink(missing_ok=True)
        write_ply(tmp_path / "a.ply", gaussians, PlyOptions(live=given, function="a  b"))
        header = read_ply(tmp_path / "a.ply")[1]
        assert header.live is not None
        assert header.function == "a  b"
        for layer, own in zip(header.live.layers, given.layers, strict=True):
            assert [label.name for label in layer.labels] == list(NAMES)
            assert given is known or layer.name == own.name
    text = legend_text(LabelTable("t", labels), 0.0, 0.0, "") or ""
    assert [name for name, _ in json.loads(text)["labels"]] == list(NAMES)
    scene = page_of(known, options())[1]
    assert [label["name"] for label in scene["look"]["layers"][0]["labels"]] == list(NAMES)


def test_a_name_that_is_too_long_is_cut_with_a_word(tmp_path: Path) -> None:
    (tmp_path / "t.json").write_text(json.dumps({"1": {"name": "n" * 201, "color": "#ffffff"}}))
    with pytest.warns(UserWarning, match=r"label 1: name of 201 characters, cut to 200: 'nnn"):
        assert read_labels(str(tmp_path / "t.json")).labels[0].name == "n" * 200


def test_names_of_labels_are_no_markup_in_the_page() -> None:
    content, scene = page_of(facts(), options())
    assert b"</script><b>x" not in content
    assert [label["name"] for label in scene["look"]["layers"][0]["labels"]] == [label.name for label in LABELS]
    assert scene["look"]["layers"][0]["nodes"] == []


def test_labels_under_gaussians_and_the_way_they_end() -> None:
    """Of Gaussians right and left of the border x = 8 of two labels, and beyond the labels."""
    volume = halves()
    frame = volume.unit_frame()
    half, step = np.array(frame.half), np.array(frame.step)
    at = np.array([[6.2, 8, 5], [8.9, 7, 5], [3, 8, 5], [12, 8, 6], [8, 8, 15.4]])
    some = Gaussians(
        at * step - half, np.full((5, 3), np.log(0.8 * step[0])), np.tile([1, 0, 0, 0], (5, 1)), np.zeros(5),
        np.zeros((5, 3)),
    )  # fmt: skip
    owner, gradient = labels_and_gradients(some, [(volume, [1, 2])], half, step)
    np.testing.assert_array_equal(owner, [0, 1, 0, 1, -1])
    assert (gradient[2:4] == 0).all()
    assert abs(gradient[0] @ [1, 0, 0]) > 0.9
    assert gradient[0, 0] < 0 < gradient[1, 0]


def test_labels_of_a_fog_differ_in_colour() -> None:
    table = label_fog(LabelTable("t", LABELS), {3: 1000, 7: 8})
    assert len({label.color[0] for label in table.labels}) == 3
    assert [label.opacity > 0 for label in table.labels] == [True, True, False]
    hidden = label_fog(LabelTable("t", LABELS), {3: 8, 7: 8, 300: 8}).labels
    assert hidden[2].opacity == hidden[1].opacity
    assert 0 < hidden[2].color[2] < hidden[1].color[2]
    assert table.labels[0].opacity == table.labels[1].opacity
    for label in table.labels:
        assert label.color[1] == pytest.approx(label.color[0] ** 2)
    assert table.labels[1].color[2] > 3 * table.labels[0].color[2]


def test_cells_do_not_straddle_labels() -> None:
    """Where the budget allows it nearly no Gaussian of one label lies in the other."""
    result = vvgt_library.convert(halves(), vvgt_library.Look(labels="auto"), max_gaussians=800, screen=48, live=True)
    live, means = result.gaussians.live, result.gaussians.means
    assert set(live[:, LABEL_ROW]) == {0, 1}
    right = (means[:, 0] > 0) == (live[:, LABEL_ROW] == 1)
    assert right.mean() > 0.97


@pytest.fixture(scope="module")
def label_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from vvgt_cli.commands.main import run

    folder = tmp_path_factory.mktemp("labels")
    np.save(folder / "map_label.npy", halves().data)
    arguments = ["convert", str(folder / "map_label.npy"), "--labels", "auto", "--live", "-q", "-o"]
    assert run([*arguments, str(folder / "live.ply"), *map(str, SMALL)]) == 0
    return folder / "live.ply"


def test_recolor_takes_another_table_and_hides_labels(vvgt, label_file, tmp_path) -> None:
    table = {"1": {"name": "one", "color": [1, 0, 0]}, "2": {"name": "two", "color": [0, 0, 1], "opacity": 0}}
    (tmp_path / "t.json").write_text(json.dumps(table))
    whole = read_ply(label_file)[0]
    look = ("--labels", tmp_path / "t.json", "--light", "none")
    vvgt.ok("recolor", label_file, *look, "-o", tmp_path / "a.ply")
    found, header = read_ply(tmp_path / "a.ply")
    assert header.live is None
    assert len(found) == (whole.live[:, LABEL_ROW] == 0).sum()  # type: ignore[index]
    np.testing.assert_allclose(found.colors, np.tile([1, 0, 0], (len(found), 1)), atol=1e-6)
    scores = []
    for file in (label_file, tmp_path / "a.ply"):
        shown = ("evaluate", file, "--step", 1, "--volume", label_file.parent / "map_label.npy", *look)
        scores.append(json.loads(vvgt(*shown, "--json", "--no-conditions").out)["scores"]["psnr"])
    assert scores[0] == pytest.approx(scores[1], abs=1e-6)
    assert scores[0] > 18
    told = json.loads(vvgt("info", label_file, "--json").out)["live_labels"]
    assert [entry["label"] for entry in told] == [1, 2]
    assert sum(entry["gaussians"] for entry in told) == len(whole)
    assert len(vvgt_library.recolor(label_file, labels=tmp_path / "t.json").gaussians) == len(found)


def test_labels_that_are_hidden_at_first_can_be_shown_later(vvgt, label_file, tmp_path) -> None:
    table = {"1": {"name": "one", "color": [1, 0, 0]}, "2": {"name": "two", "color": [0, 0, 1], "opacity": 0}}
    (tmp_path / "t.json").write_text(json.dumps(table))
    volume, first = label_file.parent / "map_label.npy", tmp_path / "first.ply"
    for more in ((), ("--blocks", 16)):
        source = (volume, "--labels", tmp_path / "t.json", "--live", *more, "-o", first, "--overwrite")
        vvgt.ok("convert", *source, *SMALL)
        gaussians, header = read_ply(first)
        assert [label.opacity for label in header.live.labels] == [1, 0]
        counts = np.bincount(gaussians.live[:, LABEL_ROW].astype(int))
        assert 0.05 < counts[1] / counts.sum() < 0.5
        assert gaussians.opacity_logits[gaussians.live[:, LABEL_ROW] == 1].max() < -10
        vvgt.ok("recolor", first, "--labels", "auto", "-o", tmp_path / "a.ply", "--overwrite")
        assert len(read_ply(tmp_path / "a.ply")[0]) == len(gaussians)


def test_what_labels_do_not_go_with(vvgt, label_file, tmp_path) -> None:
    table = {
        "1": {"name": "one", "color": [1, 0, 0], "opacity": 0},
        "2": {"name": "two", "color": "#ffffff", "opacity": 0},
    }
    (tmp_path / "t.json").write_text(json.dumps(table | {"9": {"name": "nine", "color": "#ffffff"}}))
    (tmp_path / "one.json").write_text(json.dumps({"1": {"name": "one", "color": "#ffffff"}}))
    for more, code, said in (
        (("--tf", "viridis"), 2, "replace --tf by --labels"),
        (("--labels", tmp_path / "t.json"), 1, "none of its labels is visible"),
        (("--labels", tmp_path / "one.json"), 1, "1 labels have no entry"),
    ):
        assert said in vvgt.fails(code, "recolor", label_file, *more, "-o", tmp_path / "a.ply")
    done = vvgt.fails(2, "render", label_file, "--tf-range", "0,1", "--orbit", 1, "-o", tmp_path / "r")
    assert "replace --tf-range" in done
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.json", "t.json"]
