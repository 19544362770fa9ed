"""Several clouds in one page: frames of a series, functions, labels, files; each with its name, as alone."""

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest

from vvgt_cli.gaussians import read_ply
from vvgt_cli.gaussians.formats import read_splats
from vvgt_cli.gaussians.formats.gsply_files import read_compressed_ply

HOW = ("--max-gaussians", "60", "--screen", "32", "--steps", "2")


def clouds(page: Path) -> dict[str, np.ndarray]:
    """Name to sorted opacities of each cloud that a page holds, in the order of its list."""
    text = page.read_text("utf-8")
    scene = json.loads(re.search(r'id="scene">(.*?)</script>', text, re.S)[1])
    found = {}
    for frame in scene["frames"]:
        content = re.search(rf'id="{frame["element"]}">([^<]+)</script>', text)[1]
        found[frame["name"]] = np.sort(read_compressed_ply(base64.b64decode(content), "page").logits)
    assert len(found) == len(scene["frames"])
    return found


def same(held: np.ndarray, file: Path) -> bool:
    """As a `.compressed.ply` holds it: opacities in 8 bits."""
    own = np.sort(read_ply(str(file))[0].opacity_logits)
    alpha = lambda logits: 1 / (1 + np.exp(-logits))  # noqa: E731
    return len(own) == len(held) and bool(np.abs(alpha(own) - alpha(held)).max() < 1 / 200)


@pytest.fixture
def steps(tmp_path):
    """A file of three steps, of which the second shows nothing, and the files of a glob."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 12)] * 3, indexing="ij")
    ball = np.exp(-4 * (x * x + y * y + z * z)).astype(np.float32)
    import nibabel

    nibabel.save(nibabel.Nifti1Image(np.stack([ball, 0 * ball, ball**2], axis=-1), np.eye(4)), tmp_path / "four.nii")
    for k, values in enumerate((ball, ball**2)):
        np.save(tmp_path / f"run_{k}.npy", values)
    node = lambda v, o: {"x": v, "rgb": [1, 0.5, 0.2], "opacity": o}  # noqa: E731
    (tmp_path / "tf.json").write_text(json.dumps({"range": [0, 1], "points": [node(0.1, 0), node(1, 0.6)]}))
    return tmp_path


def test_a_file_of_several_steps_is_a_page_of_them(vvgt, steps):
    page, how = steps / "four.html", ("--tf", steps / "tf.json", *HOW)
    done = vvgt.ok("convert", steps / "four.nii", "-o", page, *how)
    vvgt.ok("convert", steps / "four.nii", "-o", steps / "f_{}.ply", *how)
    held = clouds(page)
    assert list(held) == ["frame 0", "frame 2"]  # the other one shows nothing
    assert same(held["frame 0"], steps / "f_0.ply")
    assert same(held["frame 2"], steps / "f_2.ply")
    assert not same(held["frame 0"], steps / "f_2.ply")
    assert "2 clouds" in done.err
    one = vvgt("convert", steps / "four.nii", "--time", "2", "-o", steps / "one.html", *how)
    assert (one.code, list(clouds(steps / "one.html"))) == (0, ["volume, 12 x 12 x 12"])
    assert "four.html" in vvgt.fails(2, "convert", steps / "four.nii", "-o", page, *how)
    vvgt.ok("convert", steps / "four.nii", "-o", page, "--overwrite", "--light", "headlight", *how)
    assert list(clouds(page)) == list(held)


def test_a_glob_of_volumes_is_a_page_and_one_of_slices_a_volume(vvgt, steps):
    vvgt.ok("convert", str(steps / "run_*.npy"), "--tf", steps / "tf.json", "-o", steps / "run.html", *HOW)
    assert list(clouds(steps / "run.html")) == ["frame 0", "frame 1"]
    import tifffile

    for k in range(6):
        tifffile.imwrite(steps / f"slice_{k}.tif", np.full((8, 9), 40 * k, np.uint8))
    vvgt.ok("convert", str(steps / "slice_*.tif"), "-o", steps / "stack.html", *HOW)
    assert list(clouds(steps / "stack.html")) == ["volume, 9 x 8 x 6"]
    for k in range(6):
        tifffile.imwrite(steps / f"color_{k}.tif", np.full((8, 9, 3), 40 * k, np.uint8), photometric="rgb")
    vvgt.ok("convert", str(steps / "color_*.tif"), "-o", steps / "color.html", *HOW)
    vvgt.ok("convert", str(steps / "run_0*.npy"), "--tf", steps / "tf.json", "-o", steps / "r.html", *HOW)
    assert list(clouds(steps / "r.html")) == ["frame 0"]
    assert not list(steps.glob(".*"))


def test_functions_and_labels_have_their_names(vvgt, steps):
    (steps / "other.json").write_text((steps / "tf.json").read_text().replace("0.6", "0.1"))
    two = ("--tf", steps / "tf.json", "--tf", steps / "other.json")
    vvgt.ok("convert", steps / "run_0.npy", *two, "-o", steps / "two.html", *HOW)
    big = vvgt.fails(2, "convert", steps / "run_0.npy", *two, "-o", steps / "big.html", "--max-megabytes", "1")
    assert "the limit is for one cloud" in big
    held = clouds(steps / "two.html")
    assert list(held) == ["tf", "other"]
    assert held["tf"].mean() > held["other"].mean()
    labels = np.zeros((12, 12, 12), np.uint8)
    labels[3:6, 3:9, 3:9], labels[6:9, 3:9, 3:9] = 1, 2
    np.save(steps / "map.npy", labels)
    how = ("--labels", "auto", "--split-labels", *HOW)
    vvgt.ok("convert", steps / "map.npy", *how, "-o", steps / "map.html")
    vvgt.ok("convert", steps / "map.npy", *how, "-o", steps / "map_{}.ply")
    files = json.loads((steps / "map_index.json").read_text())["files"]
    held = clouds(steps / "map.html")
    assert list(held) == [row["name"] for row in files]
    assert all(same(held[row["name"]], steps / row["file"]) for row in files)


def test_files_are_joined(vvgt, steps):
    files = []
    for k, budget in enumerate((40, 60)):
        files.append(steps / f"<b>{k}.ply")
        vvgt.ok("init", "example:blob:12", "--max-gaussians", budget, "-o", files[-1])
    vvgt.ok("view", *files, "-o", steps / "both.html")
    held = clouds(steps / "both.html")
    assert list(held) == ["<b>0.ply", "<b>1.ply"]
    assert all(same(cloud, file) for cloud, file in zip(held.values(), files, strict=True))
    assert "<b>" not in (steps / "both.html").read_text("utf-8")


def test_what_pages_of_several_cannot_is_one_line(vvgt, steps, monkeypatch):
    monkeypatch.chdir(steps)
    how = ("--tf", "tf.json", *HOW)
    for extra in ("--report", "r.json"), ("--preview", "p.png"), ("--checkpoint", "c"):
        done = vvgt("convert", "four.nii", "-o", "four.html", *extra, *how)
        assert (done.code, len(done.error.splitlines())) == (2, 1)
        assert "with one file of several clouds" in done.error
    done = vvgt.fails(
        2, "convert", "four.nii", "-o", "four.html", "--max-megabytes", "2", "--tf", "tf.json", "--screen", "32"
    )
    assert "--max-megabytes with one file of several clouds" in done
    two = ("--tf", "viridis", "--time", "0")
    done = vvgt.fails(2, "convert", "four.nii", "-o", "four.html", "--no-values", *two, *how)
    assert "--no-values with one file of several clouds" in done
    assert "is for a page" in vvgt.fails(2, "convert", "four.nii", "-o", "four_{}.ply", "--no-values", *how)
    white = {"rgb": [1, 1, 1]}
    dark = json.dumps({"points": [{"x": 900, "opacity": 0, **white}, {"x": 901, "opacity": 1, **white}]})
    Path("dark.json").write_text(dark)
    done = vvgt.fails(1, "convert", "four.nii", "-o", "four.html", "--tf", "dark.json", *HOW)
    assert "shows nothing in any of 3 frames" in done
    assert not list(steps.glob("*.html"))
    assert not list(steps.glob(".*"))
    vvgt.ok("convert", "four.nii", "-o", "four.html", *how)
    for command in (
        ("evaluate", "four.html", "--volume", "run_0.npy"),
        ("render", "four.html", "--orbit", "1", "-o", "o"),
    ):
        assert "a page of 2 clouds of Gaussians; expected one" in vvgt.fails(1, *command)
    vvgt.ok("init", "example:blob:12", "--max-gaussians", "40", "-o", "a.ply")
    assert "expected a page (.html), which holds several" in vvgt.fails(2, "view", "a.ply", "a.ply", "-o", "b.spz")


def held_bytes(page: Path) -> bytes:
    """A page with everything it holds in base64."""
    content = page.read_bytes()
    return content + b"".join(map(base64.b64decode, re.findall(rb'id="(?:splats|values)-\d">([^<]+)<', content)))


def test_no_file_names_the_volume_that_it_was_made_of(vvgt, tmp_path, small_screen):
    x, y, z = np.mgrid[-1:1:14j, -1:1:14j, -1:1:14j]
    np.save(tmp_path / "Mueller_Hans.npy", np.exp(-3 * (x**2 + y**2 + z**2)))
    np.save(tmp_path / "Mueller_Eva.npy", np.exp(-3 * (x**2 + 2 * y**2 + z**2)))
    source = tmp_path / "Mueller_Hans.npy"
    vvgt.ok("convert", source, "-o", tmp_path / "a.ply", *HOW)
    done = vvgt("convert", source, "-o", tmp_path / "a.html", *HOW)
    assert "a.html holds Gaussians, values of the volume (14 x 14 x 14 voxels)" in done.err
    assert "a checksum of the volume; its title is" in done.err
    vvgt.ok("view", source, "-o", tmp_path / "b.html")
    vvgt.ok("convert", tmp_path / "Mueller_*.npy", "-o", tmp_path / "c.html", *HOW)
    for name in ("a.ply", "a.html", "b.html", "c.html"):
        content = held_bytes(tmp_path / name)
        assert b"Mueller" not in content, name
        assert b"volume, 14 x 14 x 14" in content, name
    assert list(clouds(tmp_path / "c.html")) == ["frame 0", "frame 1"]
    vvgt.ok("convert", source, "-o", tmp_path / "d.html", "--title", "Case <17>", *HOW)
    assert b"<title>Case &lt;17&gt;</title>" in (tmp_path / "d.html").read_bytes()
    vvgt.ok("view", tmp_path / "a.ply", "--title", "other", "-o", tmp_path / "e.html")
    assert b"<title>other</title>" in (tmp_path / "e.html").read_bytes()
    vvgt.ok("view", tmp_path / "a.ply", tmp_path / "a.ply", "--title", "both", "-o", tmp_path / "f.html")
    assert b"<title>both</title>" in (tmp_path / "f.html").read_bytes()


def test_the_page_of_one_volume_holds_its_values_and_look_unless_it_cannot(vvgt, tmp_path):
    values = np.random.default_rng(1).uniform(size=(10, 11, 12)).astype(np.float32)
    np.save(tmp_path / "v.npy", values)
    np.save(tmp_path / "rgb.npy", np.stack([values] * 3, axis=-1))

    def scene(*args: str) -> dict:
        vvgt.ok("convert", tmp_path / args[0], "-o", tmp_path / "a.html", "--overwrite", *HOW, *args[1:])
        text = (tmp_path / "a.html").read_text("utf-8")
        return dict(json.loads(re.search(r'id="scene">(.*?)</script>', text, re.S)[1]))

    both = scene("v.npy")
    assert both["frames"][0]["element"] == "splats-0"
    assert len(both["look"]["layers"][0]["nodes"]) > 1
    assert both["values"][0]["dims"] == [12, 11, 10]
    vvgt.ok("convert", tmp_path / "v.npy", "-o", tmp_path / "v.ply", *HOW)
    assert same(np.sort(read_splats(tmp_path / "a.html")[0].opacity_logits), tmp_path / "v.ply")
    assert {"look", "values"} <= set(scene("v.npy", "--light", "1,0,0", "--time-budget", "5"))
    assert not {"look", "values"} & set(scene("v.npy", "--no-values"))
    assert not {"look", "values"} & set(scene("rgb.npy", "--component", "color"))
    for thin in ((128, 1, 128), (8, 1000, 8)):
        np.save(tmp_path / "thin.npy", np.ones(thin, np.float32) * np.linspace(0, 1, thin[0])[:, None, None])
        assert "look" in scene("thin.npy", "--tf", "viridis")
    np.save(tmp_path / "many.npy", np.arange(512, dtype=np.uint16).reshape(8, 8, 8))
    assert "look" not in scene("many.npy", "--labels", "auto")  # of so many labels
