"""Labels and layers as nodes of one file: the tree, measures in the world, and the Gaussians of the whole."""

import json
import struct
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from vvgt_cli.conversion.labels import HiddenCells, assign_labels
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians, in_unit_frame
from vvgt_cli.gaussians.formats import read_splats
from vvgt_cli.gaussians.formats.gltf import glb, read_glb
from vvgt_cli.gaussians.formats.nodes import Node
from vvgt_cli.gaussians.formats.splats import Splats
from vvgt_cli.look.label_files import read_labels
from vvgt_cli.look.labels import Label, LabelTable
from vvgt_cli.volume import Volume
from vvgt_cli.volume.label_maps import extents_of

SMALL = ("--max-gaussians", 500, "--screen", 64, "--steps", 0, "--light", "none", "--split-labels")
# as FreeSurfer's volumes lie: i to the left, j down, k forwards; 2 mm, off centre
AFFINE = np.array([[-2.0, 0, 0, 30], [0, 0, 2, -20], [0, -2, 0, 40], [0, 0, 0, 1]])
LUT = """#No. Label Name: R G B A
0 Unknown 0 0 0 0
17 Left-Hippocampus 220 216 20 0
53 Right-Hippocampus 220 60 20 0
1028 ctx-lh-superiorfrontal 20 220 160 0
16 Brain-Stem 119 159 176 0
"""
CENTRES = {17: (-12.0, 0.0, 12.0), 53: (16.0, 2.0, 12.0), 1028: (-12.0, 4.0, 32.0), 16: (4.0, -8.0, 22.0)}  # mm, RAS


@pytest.fixture
def atlas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Four boxes of 3 x 5 x 3 voxels, none of which hides another, with their table."""
    values = np.zeros((28, 28, 28), np.int16)
    back = np.linalg.inv(AFFINE)
    for number, centre in CENTRES.items():
        i, j, k = (back[:3, :3] @ centre + back[:3, 3]).round().astype(int)
        values[i - 1 : i + 2, j - 2 : j + 3, k - 1 : k + 2] = number
    nib.save(nib.Nifti1Image(values, AFFINE), tmp_path / "aseg.nii")
    (tmp_path / "lut.txt").write_text(LUT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def document(path: Path) -> dict:
    content = path.read_bytes()
    return json.loads(content[20 : 20 + struct.unpack_from("<I", content, 12)[0]])


def tree(path: Path) -> dict[str, tuple[tuple[str, ...], dict]]:
    """Path and node of each node with a mesh, by name."""
    nodes, found = document(path)["nodes"], {}

    def visit(number: int, above: tuple[str, ...]) -> None:
        node = nodes[number]
        if "mesh" in node:
            found[node["name"]] = above, node
        for child in node.get("children", ()):
            visit(child, (*above, node["name"]))

    visit(0, ())
    return found


def middle(path: Path, node: dict) -> np.ndarray:
    """Middle (3,) mm, in the scanner's space, of the box of a node's centres, by the formulas of glTF."""
    whole = document(path)
    root = whole["nodes"][0]
    box = whole["accessors"][whole["meshes"][node["mesh"]]["primitives"][0]["attributes"]["POSITION"]]
    data = (np.array(box["min"]) + box["max"]) / 2 + node["translation"]
    assert "rotation" not in root
    scene = data * root["scale"] + root["translation"]
    world = np.reshape(root["extras"]["worldFromScene"], (4, 4))
    return world[:3, :3] @ scene + world[:3, 3]


def test_a_node_of_each_label_where_it_is_in_the_world(vvgt, atlas) -> None:
    vvgt.ok("convert", "aseg.nii", "--labels", "lut.txt", *SMALL, "-o", "a.glb")
    nodes = tree(atlas / "a.glb")
    assert {name: above for name, (above, _) in nodes.items()} == {
        "Left-Hippocampus": ("Splats", "Left"),
        "Right-Hippocampus": ("Splats", "Right"),
        "ctx-lh-superiorfrontal": ("Splats", "Left", "Left cortex"),
        "Brain-Stem": ("Splats",),
    }
    for _, node in nodes.values():
        facts = node["extras"]
        centre = CENTRES[facts["label"]]
        assert facts["centroid_mm"] == pytest.approx(centre)
        assert facts["volume_ml"] == pytest.approx(45 * 8 / 1000)
        half = np.array([3.0, 3, 5])  # mm: i, k and j run along x, y and z
        assert np.array(facts["bounds_mm"]) == pytest.approx(np.array([centre - half, centre + half]))
        assert np.abs(middle(atlas / "a.glb", node) - centre).max() < 2  # where the Gaussians are: neither side swapped


BLOCKS = ("--blocks", "16")


@pytest.mark.parametrize(("ending", "blocks"), [(".glb", ()), (".glb", BLOCKS), (".usdc", ()), (".usdz", ())])
def test_the_nodes_together_are_the_file_without_nodes(vvgt, atlas, monkeypatch, ending, blocks) -> None:
    if ending != ".glb":
        pytest.importorskip("pxr")
    monkeypatch.setattr(HiddenCells, "meet_label", lambda *_: False)  # a few voxels inside are hidden by others
    line = ("convert", "aseg.nii", "--labels", "lut.txt", *blocks)
    vvgt.ok(*line, *SMALL, "-o", f"a{ending}")
    vvgt.ok(*line, *SMALL[:-1], "-o", "b.ply")
    (ours, header), (whole, alone) = read_splats(f"a{ending}"), read_splats("b.ply")
    assert header.facts()["affine"] == alone.facts()["affine"]
    columns = [np.column_stack([one.means, one.quaternions, one.colors, one.log_scales]) for one in (ours, whole)]
    ours_first, whole_first = (rows[np.lexsort(rows.T)] for rows in columns)
    np.testing.assert_allclose(ours_first, whole_first, atol=1e-5)


def test_usd_has_the_same_tree_and_measures(vvgt, atlas) -> None:
    usd, geom = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    table = json.loads("{}")
    for number, name in ((17, "Hippo campus"), (53, "Hippo-campus"), (1028, "Cortex"), (16, "Brain-Stem")):
        table[str(number)] = {
            "name": name,
            "color": [0.5, 0.6, 0.7],
            "parents": ["Brain", "Depth"],
            "visible": number != 53,
        }
    (atlas / "t.json").write_text(json.dumps(table))
    for ending in (".usdc", ".usdz", ".glb"):
        vvgt.ok("convert", "aseg.nii", "--labels", "t.json", *SMALL, "-o", f"a{ending}")
    for ending in (".usdc", ".usdz"):
        stage = usd.Stage.Open(f"a{ending}")
        prims = {prim.GetDisplayName(): prim for prim in stage.Traverse()}
        assert str(prims["Hippo campus"].GetPath()) == "/Splats/Brain/Depth/Hippo_campus"
        assert str(prims["Hippo-campus"].GetPath()) == "/Splats/Brain/Depth/Hippo_campus_"
        shown = {
            name: geom.Imageable(prim).ComputeVisibility()
            for name, prim in prims.items()
            if prim.GetAttribute("positions")
        }
        assert shown == {
            "Hippo campus": "inherited", "Hippo-campus": "invisible", "Cortex": "inherited", "Brain-Stem": "inherited"
        }  # fmt: skip
        geom.Imageable(prims["Brain"]).MakeInvisible()
        assert geom.Imageable(prims["Cortex"]).ComputeVisibility() == "invisible"
        facts = prims["Brain-Stem"].GetCustomData()
        assert tuple(facts["centroid_mm"]) == pytest.approx(CENTRES[16])
        assert (facts["volume_ml"], np.array(facts["bounds_mm"]).shape) == (pytest.approx(0.36), (2, 3))
    off = [name for name, (_, node) in tree(atlas / "a.glb").items() if "extensions" in node]
    assert off == ["Hippo-campus"]
    for ending in (".usdc", ".usdz", ".glb"):
        with pytest.warns(UserWarning, match="1 of its nodes are switched off, and read all the same: Hippo-campus"):
            read_splats(f"a{ending}")
    assert document(atlas / "a.glb")["extensionsUsed"] == ["KHR_gaussian_splatting", "KHR_node_visibility"]


def test_layers_are_nodes_in_one_frame(vvgt, atlas) -> None:
    """A scalar ball of other extent and grid, under the atlas."""
    grid = np.indices((12, 12, 12)) - 5.5
    ball = np.where((grid**2).sum(axis=0) < 16, 300, -1000).astype(np.int16)
    nib.save(nib.Nifti1Image(ball, np.diag([8.0, 8, 8, 1])), "ct.nii")
    layer = ("--layer", "aseg.nii,labels=lut.txt")
    line = ("convert", "ct.nii", "--tf", "ct-bone", *layer, *SMALL)
    vvgt.ok(*line, "-o", "both.glb")
    nodes = tree(atlas / "both.glb")
    assert nodes["ct"][0] == ("Splats",)
    assert nodes["ctx-lh-superiorfrontal"][0] == ("Splats", "aseg", "Left", "Left cortex")
    for name, centre in (("ct", (44, 44, 44)), ("Left-Hippocampus", CENTRES[17]), ("Right-Hippocampus", CENTRES[53])):
        assert np.abs(middle(atlas / "both.glb", nodes[name][1]) - centre).max() < 4, name
    assert "each layer has a frame of its own" in vvgt.fails(2, *line, "-o", "x_{}.glb")
    vvgt.ok(*line, "-o", "both.html")


def test_layers_of_one_name_stay_apart_and_units_must_agree(vvgt, atlas) -> None:
    (atlas / "more").mkdir()
    (atlas / "more/aseg.nii").write_bytes((atlas / "aseg.nii").read_bytes())
    line = ("convert", "aseg.nii", "--labels", "lut.txt", *SMALL, "-o", "both.glb", "--overwrite")
    vvgt.ok(*line, "--layer", "more/aseg.nii,labels=lut.txt")
    groups = [above[1] for above, _ in tree(atlas / "both.glb").values()]
    assert sorted(set(groups)) == ["aseg", "aseg 2"]
    assert len(groups) == 2 * len(CENTRES)  # no name twice
    np.save("plain_label.npy", np.eye(28, dtype=np.uint8)[None].repeat(28, 0))
    refused = vvgt.fails(1, *line, "--layer", "plain_label.npy,labels=auto")
    assert "plain_label: its lengths are in no stated unit, those of aseg in mm" in refused


def test_a_label_without_a_name_is_no_root(vvgt, atlas) -> None:
    table = {"17": {"name": "", "color": [1, 0, 0]}, "53": {"name": "b", "color": [0, 1, 0]}}
    table |= {number: {"name": number, "color": [0, 0, 1]} for number in ("16", "1028")}
    (atlas / "t.json").write_text(json.dumps(table))
    vvgt.ok("convert", "aseg.nii", "--labels", "t.json", *SMALL, "-o", "a.glb")
    assert {"label 17", "b"} <= set(tree(atlas / "a.glb"))


def test_functions_are_nodes_without_paths(vvgt, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    ball = np.exp(-4 * (np.stack(np.meshgrid(*[np.linspace(-1, 1, 16)] * 3)) ** 2).sum(axis=0)).astype(np.float32)
    np.save("ball.npy", ball)
    for name, opacity in (("bone", 0.6), ("skin", 0.2)):
        points = [{"x": 0.1, "opacity": 0, "rgb": [1, 0, 0]}, {"x": 1, "opacity": opacity, "rgb": [1, 1, 0]}]
        Path(f"{name}.json").write_text(json.dumps({"points": points}))
    line = ("convert", "ball.npy", "--tf", tmp_path / "bone.json", "--tf", tmp_path / "skin.json", *SMALL[:6])
    vvgt.ok(*line, "-o", "x.glb")
    assert list(tree(tmp_path / "x.glb")) == ["bone", "skin"]
    assert str(tmp_path).encode() not in (tmp_path / "x.glb").read_bytes()
    assert "--preview with one file of several clouds" in vvgt(*line, "-o", "y.glb", "--preview", "y.png").error


def test_no_comments_no_measures(vvgt, atlas) -> None:
    vvgt.ok("convert", "aseg.nii", "--labels", "lut.txt", *SMALL, "--no-comments", "-o", "a.glb")
    assert [node for _, node in tree(atlas / "a.glb").values() if "extras" in node] == []


def test_slicers_terms_are_groups(tmp_path) -> None:
    def entry(*codes: str) -> str:
        return f"Status:done|TerminologyEntry:context~{'~'.join(codes[:3])}~regions~{'~'.join(codes[3:])}"

    structure, changed, kidney = "SCT^123037004^Anatomical Structure", "SCT^49755003^Altered", "SCT^64033007^Kidney"
    segments = [
        ("Liver", entry(structure, "SCT^10200004^Liver", "^^", "^^", "^^"), ("Anatomical Structure",)),
        ("left kidney", entry(structure, kidney, "SCT^7771000^Left", "^^", "^^"), ("Anatomical Structure", "Kidney")),
        ("tumour", entry(changed, "SCT^4147007^Mass", "^^", "SCT^10200004^Liver", "^^"), ("Altered", "Liver", "Mass")),
        ("Left-thing", "Segmentation.Status:inprogress", ("Left",)),
        ("odd", "TerminologyEntry:context~a~b", ()),
    ]
    lines = ["NRRD0004"]
    for k, (name, tags, _) in enumerate(segments):
        lines += [f"Segment{k}_LabelValue:={k + 1}", f"Segment{k}_Name:={name}", f"Segment{k}_Color:=1 0 0"]
        lines += [f"Segment{k}_Tags:={tags}"]
    (tmp_path / "s.seg.nrrd").write_text("\n".join(lines) + "\n\n")
    labels = read_labels(str(tmp_path / "s.seg.nrrd")).labels
    assert [label.parents for label in labels] == [parents for *_, parents in segments]
    assert dict((part, code) for part, code, _ in labels[1].codes)["type_modifier"] == "SCT:7771000"
    columns = ",".join(
        f"{part}_{field}" for part in ("Category", "Type", "TypeModifier", "Region", "RegionModifier")
        for field in ("CodingScheme", "CodeValue", "CodeMeaning")
    )  # fmt: skip
    row = "3,left kidney,10,20,30,255,SCT,123037004,Anatomical Structure,SCT,64033007,Kidney,SCT,7771000,Left,,,,,,"
    (tmp_path / "s.csv").write_text(f"LabelValue,Name,Color_R,Color_G,Color_B,Color_A,{columns}\n{row}\n")
    (label,) = read_labels(str(tmp_path / "s.csv")).labels
    assert (label.parents, label.codes) == (labels[1].parents, labels[1].codes)


def test_a_label_that_itk_snap_switches_off_is_there_switched_off(vvgt, atlas, recwarn) -> None:
    rows = [f'{number} 10 20 30 0.5 {int(number != 16)} 1 "part {number}"' for number in sorted(CENTRES)]
    (atlas / "t.label").write_text("\n".join(rows) + "\n")
    line = ("convert", "aseg.nii", "--labels", "t.label", *SMALL)
    vvgt.ok(*line, "-o", "a_{}.spz")
    assert [str(one.message) for one in recwarn if "hides" in str(one.message)] == []  # it is in its file
    with pytest.warns(UserWarning, match=r"t.label hides 1 of its labels \(opacity 0\): 16 \(part 16\)"):
        vvgt.ok(*line[:-1], "-o", "a.ply")
    (atlas / "u.label").write_text((atlas / "t.label").read_text().replace('0.5 1 1 "part 53', '0 1 1 "part 53'))
    with pytest.warns(UserWarning, match=r"u.label hides 1 of its labels \(opacity 0\): 53 \(part 53\)"):
        vvgt.ok(*line[:3], "u.label", *SMALL, "-o", "b_{}.spz")
    index = {row["label"]: row for row in json.loads((atlas / "a_index.json").read_text())["files"]}
    assert index[16]["visible"] is False
    assert index[16]["opacity"] == 0.5
    assert index[53]["centroid_mm"] == pytest.approx(CENTRES[53])
    assert "visible" not in index[53]
    gaussians, header = read_splats(str(atlas / index[16]["file"]))
    assert len(in_unit_frame(gaussians, header)) > 10


@pytest.mark.parametrize(("kind", "wide"), [(np.uint8, 1), (np.int32, 100_000), (np.float32, 1)])
def test_extents_are_those_of_every_voxel(kind, wide) -> None:
    values = (np.random.default_rng(3).integers(0, 4, (5, 6, 7)) * wide).astype(kind)
    volume = Volume(values, (0.5, 1.0, 2.0), (10.0, 0, 0), (0, 1, 0, 1, 0, 0, 0, 0, 1), slope=2.0, unit="um")
    found = extents_of(volume)
    assert sorted(found) == sorted({2.0 * value for value in values.ravel().tolist()})
    for number in np.unique(values):
        index = np.argwhere(values == number)[:, ::-1]
        world = index @ volume.affine[:3, :3].T + volume.affine[:3, 3]
        facts = found[2.0 * number].measures(volume)
        assert facts["voxels"] == len(index)
        assert facts["centroid_mm"] == pytest.approx(world.mean(axis=0) / 1000)
        assert facts["volume_ml"] == pytest.approx(len(index) * 1e-12)
        assert facts["bounds_mm"][0] == pytest.approx((world.min(axis=0) - [0.5, 0.25, 1]) / 1000)


ONE = Splats(*(np.zeros(shape, np.float32) for shape in ((1, 3), (1, 3), (1, 4), (1,), (1, 3), (1, 0, 3))))


@pytest.mark.parametrize("wrong", [b'{"visible":"no"}', b'{"visible":null}', b"[]", b'"off"'])
def test_a_wrong_visibility_is_refused_in_a_line(wrong: bytes) -> None:
    content = glb([Node("a", ONE, visible=False), Node("b", ONE)], "x")
    size = struct.unpack_from("<I", content, 12)[0]
    head = content[20 : 20 + size].replace(b'{"visible":false}', wrong)
    with pytest.raises(DataError, match=r"^x: not a \.glb of Gaussians \(.*\); expected meshes"):
        read_glb(content[:12] + struct.pack("<I", len(head)) + content[16:20] + head + content[20 + size :], "x")


def test_groups_have_names_that_no_node_has() -> None:
    nodes = [Node("Liver", ONE), Node("cyst", ONE, ("Liver",)), Node("vein", ONE, ("Blood", "Liver"))]
    size = struct.unpack_from("<I", content := glb(nodes, "a"), 12)[0]
    names = [node["name"] for node in json.loads(content[20 : 20 + size])["nodes"]]
    assert names == ["Splats", "Liver group", "Blood", "Liver group group", "Liver", "cyst", "vein"]


def test_a_gaussian_beside_a_label_is_not_of_its_twin_on_the_other_side() -> None:
    """Left and right have one colour in FreeSurfer's table."""
    values = np.zeros((12, 12, 24), np.uint8)
    values[4:8, 4:8, 2:6], values[4:8, 4:8, 18:22] = 1, 2
    volume = Volume(values, (1.0, 1.0, 1.0), (0.0, 0, 0), (1, 0, 0, 0, 1, 0, 0, 0, 1))
    labels = [Label(number, str(number), (0.1, 0.8, 0.6), 1.0) for number in (1, 2)]
    table, frame = LabelTable("t", tuple(labels)), volume.unit_frame()
    voxels = np.array([[1.4, 6, 6], [22.6, 6, 6], [20, 8.6, 6], [4, 6, 10.5]])  # beside 1, 2, 2 and 1
    means = (voxels * frame.step - frame.half).astype(np.float32)
    turn, zeros = np.tile(np.float32([1, 0, 0, 0]), (4, 1)), np.zeros(4, np.float32)
    some = Gaussians(means, np.full((4, 3), -12, np.float32), turn, zeros, np.tile(np.float32([0.1, 0.8, 0.6]), (4, 1)))
    assert assign_labels(some, [(volume, table, label) for label in labels]).tolist() == [0, 1, 1, 0]
