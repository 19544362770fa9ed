"""glTF and USD in metres: a point picked there maps to the scanner's millimetres, and files are read back."""

import json
import shutil
import struct
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from vvgt_cli.conversion.place import with_place as layout
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians, PlyOptions, in_unit_frame
from vvgt_cli.gaussians.formats import encoded, format_of, read_splats
from vvgt_cli.gaussians.formats.nodes import placed
from vvgt_cli.gaussians.frames import up_matrix
from vvgt_cli.volume import Volume

# a CT as scanners have it: oblique, far from the origin, its index axes not those of the patient
TURN = np.array([[0.0, 0.6, -0.8], [-1, 0, 0], [0, 0.8, 0.6]])
VOLUME = Volume(
    np.zeros((12, 20, 16), np.int16), (0.7, 0.9, 2.5), (-180.25, 95.5, -1043.75), tuple(TURN.ravel()), name="ct",
    space="RAS",
)  # fmt: skip


def marks() -> tuple[Gaussians, np.ndarray]:
    """A Gaussian at each of some voxels, and where these are: (n, 3) mm."""
    index = np.array([[0, 0, 0], [15, 0, 0], [0, 19, 0], [15, 19, 11], [7, 3, 8]])
    affine = VOLUME.affine
    world = index @ affine[:3, :3].T + affine[:3, 3]
    frame = VOLUME.unit_frame()
    means = (world - np.array(frame.centre)) * frame.scale
    count = len(means)
    return Gaussians(
        means, np.full((count, 3), -4.0), np.eye(4)[[0] * count], np.zeros(count), np.full((count, 3), 0.5)
    ), world


def gltf_points(content: bytes) -> tuple[np.ndarray, dict]:
    """What a viewer shows: (n, 3) metres, by the formulas of glTF; and the node."""
    size = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + size])
    (node,) = document["nodes"]
    points = np.frombuffer(content, "<f4", 3 * document["accessors"][0]["count"], 28 + size).reshape(-1, 3)
    assert "rotation" not in node
    return points.astype(np.float64) * node.get("scale", [1, 1, 1]) + node.get("translation", [0, 0, 0]), node


def usd_points(content: bytes, path) -> tuple[np.ndarray, dict]:
    from pxr import Usd, UsdGeom

    path.write_bytes(content)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    prim = stage.GetDefaultPrim()
    place = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0.0))
    points = np.array(prim.GetAttribute("positions").Get(), np.float64)
    told = dict(prim.GetCustomData())
    if "worldFromScene" in told:
        told["worldFromScene"] = np.array(told["worldFromScene"]).T.ravel().tolist()
    return points @ place[:3, :3] + place[3, :3], {"extras": told}


@pytest.mark.parametrize("ending", [".glb", ".usdc"])
@pytest.mark.parametrize("frame", ["unit", "world"])
@pytest.mark.parametrize("up", ["none", "z", "-x"])
def test_a_point_that_is_picked_is_the_scanners(ending, frame, up, tmp_path):
    if ending == ".usdc":
        pytest.importorskip("pxr")
    gaussians, world = marks()
    options = layout(PlyOptions(frame=frame, up=up), VOLUME)
    content = encoded(format_of(f"a{ending}"), gaussians, options, "a")
    points, node = gltf_points(content) if ending == ".glb" else usd_points(content, tmp_path / "a.usdc")
    extent = np.linalg.norm(points[3] - points[0])
    assert extent == pytest.approx(np.linalg.norm(world[3] - world[0]) / 1000, rel=1e-5)  # metres
    assert (node["extras"]["space"], node["extras"]["unit"]) == ("RAS", "mm")
    matrix = np.reshape(node["extras"]["worldFromScene"], (4, 4))
    picked = points @ matrix[:3, :3].T + matrix[:3, 3]
    assert abs(picked - world).max() < 1e-3  # mm
    if up == "none":  # as docs/formats.md has it
        assert abs(1000 * points * [-1, -1, 1] - world).max() < 1e-3
    upwards = up_matrix(up).T @ [0, -1, 0]  # direction of the world that +y of the scene is
    assert (matrix[:3, :3] @ [0, 1, 0] / 1000) == pytest.approx(upwards)
    path = tmp_path / f"b{ending}"
    path.write_bytes(content)
    back, header = read_splats(path)
    assert abs(in_unit_frame(back, header).means - gaussians.means).max() < 2e-6 * (1 if frame == "unit" else 20)


@pytest.mark.parametrize(("unit", "metre"), [("um", 1e-6), ("m", 1), ("nm", 1e-9), (None, None), ("furlong", None)])
def test_other_units_and_none(unit, metre):
    volume = replace(VOLUME, space=None, unit=unit or "")
    gaussians, world = marks()
    points, node = gltf_points(encoded(format_of("a.glb"), gaussians, layout(PlyOptions(), volume), "a"))
    if metre is None:
        assert set(node) == {"name", "mesh"}
        assert points == pytest.approx(gaussians.means * [-1, -1, 1])
    else:
        assert points * [-1, -1, 1] / metre == pytest.approx(world, rel=1e-5)
        assert node["extras"]["unit"] == unit


def test_no_comments_no_place():
    content = encoded(format_of("a.glb"), marks()[0], layout(PlyOptions(comments=False), VOLUME), "a")
    assert set(gltf_points(content)[1]) == {"name", "mesh"}
    assert b"-1043" not in content
    assert placed((), "a").world is None


def changed(content: bytes, change) -> bytes:
    size = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + size])
    change(document["nodes"][0])
    head = json.dumps(document).encode()
    head += b" " * (-len(head) % 4)
    return content[:12] + struct.pack("<2I", len(head), 0x4E4F534A) + head + content[20 + size :]


def test_files_without_metres_are_read_and_moved_ones_refused(tmp_path):
    gaussians, _ = marks()
    content = encoded(format_of("a.glb"), gaussians, layout(PlyOptions(), VOLUME), "a")
    read = format_of("a.glb").read

    def plain(node):
        for key in ("scale", "translation", "extras"):
            del node[key]

    def as_matrix(node):
        s, t = node.pop("scale")[0], node.pop("translation")
        node["matrix"] = [s, 0, 0, 0, 0, s, 0, 0, 0, 0, s, 0, *t, 1]

    for change in (plain, as_matrix):
        assert read(changed(content, change), "a").means == pytest.approx(gaussians.means)
    for key, value in (("translation", [0, 0, 1]), ("rotation", [0, 0, 1, 0]), ("scale", [1, 1, 2])):
        with pytest.raises(DataError, match="moved by another program"):
            read(changed(content, lambda node, key=key, value=value: node.update({key: value})), "a")


VALIDATE = """
const validator = require('gltf-validator');
const bytes = new Uint8Array(require('fs').readFileSync(process.argv[1]));
validator.validateBytes(bytes).then(r => console.log(JSON.stringify(r.issues)));
"""


@pytest.mark.long
def test_the_validator_of_khronos_finds_nothing_but_an_extension_that_it_does_not_know(tmp_path):
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not on the path")
    done = subprocess.run([npm, "install", "--no-audit", "--no-fund", "gltf-validator@2.0.0-dev.3.10"], cwd=tmp_path,
                          capture_output=True)  # fmt: skip
    if done.returncode:
        pytest.skip("gltf-validator cannot be installed")
    (tmp_path / "a.glb").write_bytes(encoded(format_of("a.glb"), marks()[0], layout(PlyOptions(), VOLUME), "a"))
    said = subprocess.run(["node", "-e", VALIDATE, "a.glb"], cwd=tmp_path, capture_output=True, check=True).stdout
    messages = json.loads(said)["messages"]
    assert {message["code"] for message in messages} <= {"UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    assert all("KHR_gaussian_splatting" in message["message"] + message["pointer"] for message in messages)
