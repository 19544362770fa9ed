"""Other programs' formats of Gaussians: what each keeps, what it costs, and what it does with bad input."""

import gzip
import json
import re
import shutil
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.commands.convert import command
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians, PlyOptions, in_unit_frame, read_ply, write_ply
from vvgt_cli.gaussians.formats import FORMATS, encoded, format_of, read_splats, ready
from vvgt_cli.gaussians.formats.sog import ORDERS, QUARTERS, _product
from vvgt_cli.gaussians.formats.splats import Splats, columns_of, gaussians_of, ply_bytes, splats_of
from vvgt_cli.gaussians.frames import transform as turned_by
from vvgt_cli.images import read_png
from vvgt_cli.images.metrics import psnr

# largest error of means, log-scales, rotation (1 - |q.q'|), opacity, colours
ROUNDED = {
    ".compressed.ply": (2e-3, 4e-3, 1e-5, 2.1e-3, 3e-3),
    ".html": (2e-3, 4e-3, 1e-5, 2.1e-3, 3e-3),
    ".spz": (1e-6, 0.0313, 1e-5, 2.1e-3, 4e-3),
    ".v4.spz": (1e-6, 0.0313, 1e-5, 2.1e-3, 4e-3),
    ".sog": (4e-5, 0.02, 3e-5, 2.1e-3, 4e-3),
    ".glb": (0, 1e-6, 1e-6, 1e-6, 1e-6),
    ".usdc": (0, 1e-6, 1e-6, 1e-6, 1e-6),
    ".usdz": (0, 1e-6, 1e-6, 1e-6, 1e-6),
}
# largest error of harmonics
STEP = {".compressed.ply": 1 / 31, ".html": 1 / 31, ".spz": 1 / 256 + 1e-6, ".v4.spz": 1 / 256 + 1e-6, ".sog": 1 / 31}
STEP |= dict.fromkeys((".glb", ".usdc", ".usdz"), 0)
suffix = pytest.mark.parametrize("known", FORMATS, ids=lambda known: known.suffix)


def cloud(count: int = 700) -> Gaussians:
    rng = np.random.default_rng(5)
    means, scales = rng.uniform(-1.4, 1.4, (count, 3)), rng.uniform(-7, -1, (count, 3))
    logits = np.concatenate([rng.normal(0, 3, count - 2), [-30, 30]])
    return Gaussians(means, scales, 3 * rng.normal(size=(count, 4)), logits, rng.uniform(-0.1, 1.1, (count, 3)))


def unit(quaternions: np.ndarray) -> np.ndarray:
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def turned_as(after: Gaussians, before: Gaussians) -> Gaussians:
    """The same ellipsoids as ``before``, with the axes in the order that is nearest to that of ``after``."""
    all_of_them = _product(unit(before.quaternions)[:, None], QUARTERS)
    best = abs((all_of_them * unit(after.quaternions)[:, None]).sum(axis=2)).argmax(axis=1)
    log_scales = np.take_along_axis(before.log_scales, ORDERS[best], axis=1)
    return replace(before, quaternions=all_of_them[np.arange(len(best)), best], log_scales=log_scales)


def errors(before: Gaussians, after: Gaussians) -> tuple[float, ...]:
    """As `ROUNDED` has them; in whatever order the Gaussians are."""
    nearest = ((after.means[None] - before.means[:, None]) ** 2).sum(axis=2).argmin(axis=1)
    assert len(np.unique(nearest)) == len(before) == len(after)
    after = after.take(nearest)
    before = turned_as(after, before)
    opacity = [1 / (1 + np.exp(-g.opacity_logits.astype(np.float64))) for g in (before, after)]
    turned = 1 - abs((unit(before.quaternions) * unit(after.quaternions)).sum(axis=1))
    away = [getattr(before, name) - getattr(after, name) for name in ("means", "log_scales", "colors")]
    largest = [float(abs(a).max()) for a in away]
    return largest[0], largest[1], float(turned.max()), float(abs(opacity[0] - opacity[1]).max()), largest[2]


@suffix
def test_every_ending_is_documented(known):
    table = (Path(__file__).parents[1] / "docs" / "formats.md").read_text("utf-8")
    assert f"\n| `{known.suffix}` |" in table
    assert f" {known.suffix}" in " ".join((command.help or "").split())


@suffix
@pytest.mark.parametrize("up", ["none", "x", "-y"])
def test_what_is_written_is_read_again(known, up, tmp_path):
    before, path = cloud(), tmp_path / f"a{known.suffix}"
    options = PlyOptions(up=up, screen_size=300, rule="spark", unit_distance=2.5, unit_distance_label="given")
    path.write_bytes(encoded(known, before, options, path.name))
    assert path.read_bytes() == encoded(known, before, options, path.name) or known.suffix in (".usdc", ".usdz")
    gaussians, header = read_splats(path)
    found = errors(before, in_unit_frame(gaussians, header))
    assert all(a <= b for a, b in zip(found, ROUNDED[known.suffix], strict=True)), found
    assert (header.screen_size, header.rule, header.unit_distance) == (300, "spark", 2.5)
    assert header.up == ("z" if up == "none" and known.suffix == ".html" else up)


@suffix
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_are_kept_each_in_its_place(known, degree):
    base = splats_of(cloud(300), PlyOptions(comments=False))
    count = {1: 3, 2: 8, 3: 15}[degree]
    rest = np.random.default_rng(degree).uniform(-0.9, 0.9, (300, count, 3)).astype(np.float32)
    before = Splats(base.means, base.log_scales, base.quaternions, base.logits, base.f_dc, rest)
    after = known.read(known.write(before, "a"), "a")
    order = ((after.means[None] - before.means[:, None]) ** 2).sum(axis=2).argmin(axis=1)
    assert abs(after.f_rest[order] - rest).max() <= STEP[known.suffix]
    assert columns_of(ply_bytes(before), "a").f_rest.tobytes() == rest.tobytes()


@suffix
def test_no_one_and_unbounded_gaussians(known):
    empty = cloud(2).take(np.zeros(0, int))
    refused(DataError, "no Gaussians to write; expected at least one", encoded, known, empty, PlyOptions(), "a")
    for count in (1, 3):
        splats = splats_of(cloud(count + 1).take(np.arange(count)), PlyOptions(comments=False))
        bad = np.full((1, 3), np.nan, np.float32)
        other = replace(splats.take(np.arange(count)[[*range(count), 0]]), means=np.concatenate([splats.means, bad]))
        with pytest.warns(UserWarning, match="1 "):
            drawn = gaussians_of(other, "a")[0]  # a row of another program's file
        after = known.read(encoded(known, drawn, PlyOptions(comments=False), "a"), "a")
        assert len(after) == count
        assert max(errors(drawn, gaussians_of(after, "a")[0])[:1]) < 2e-3


@suffix
def test_damaged_files_are_one_line(known, tmp_path):
    content = encoded(known, cloud(100), PlyOptions(), "a")
    path = tmp_path / f"a{known.suffix}"
    for damaged in (b"", b"ply\n", content[: len(content) // 2], bytes(len(content)), b"<!doctype html>", b"glTF" * 10):
        path.write_bytes(damaged)
        with pytest.raises(DataError) as error:
            read_splats(path)
        assert "\n" not in str(error.value)
        assert path.name in str(error.value)


@pytest.mark.parametrize(
    ("ending", "module"),
    [
        (".spz", "gsply"), (".compressed.ply", "gsply"), (".html", "gsply"), (".usdc", "pxr"),
        (".v4.spz", "numcodecs.zstd"),
    ],
)  # fmt: skip
def test_a_library_that_is_missing_is_named_before_the_work(ending, module, tmp_path, vvgt, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setitem(sys.modules, f"{module}.Usd", None)
    result = vvgt("convert", "example:frog", "-o", tmp_path / f"a{ending}")
    assert result.code == 1
    assert re.search("pip install 'gsply>=.*'usd-core>=[^']*'$", result.error.strip())
    assert "read" not in result.err.replace(result.error, "")  # no stage ran
    assert not list(tmp_path.iterdir())


def test_an_old_openusd_is_reported(monkeypatch):
    monkeypatch.setattr(pytest.importorskip("pxr.Usd"), "GetVersion", lambda: (0, 25, 11))
    with pytest.raises(
        DataError, match=r"OpenUSD 25\.11 does not support ParticleField3DGaussianSplat.*usd-core>=26\.3"
    ):
        ready("a.usdc")


@pytest.mark.parametrize("name", ["a.obj", "a", "a.spz.gz", "a.splat"])
def test_unknown_endings_are_refused(name, tmp_path, vvgt):
    result = vvgt.fails(2, "convert", "example:blob:8", "-o", tmp_path / name)
    assert ".spz" in result
    assert ".html" in result


def test_a_size_limit_is_of_a_ply(tmp_path, vvgt):
    assert "--max-gaussians" in vvgt.fails(
        2, "convert", "example:blob:8", "-o", tmp_path / "a.spz", "--max-megabytes", 1
    )


def test_positions_that_spz_cannot_hold(tmp_path):
    far = cloud(10)
    far = Gaussians(1e8 * far.means, far.log_scales, far.quaternions, far.opacity_logits, far.colors)
    refused(DataError, "expected less than", encoded, format_of("a.spz"), far, PlyOptions(), "a.spz")


def test_files_of_other_programs_have_no_comments(tmp_path):
    plain = gzip.compress(gzip.decompress(encoded(format_of("a.spz"), cloud(50), PlyOptions(up="x"), "a.spz")))
    (tmp_path / "b.spz").write_bytes(plain)
    header = read_splats(tmp_path / "b.spz")[1]
    assert (header.version, header.up) == (None, "none")


def test_a_compressed_ply_is_known_under_any_name(tmp_path):
    (tmp_path / "a.ply").write_bytes(encoded(FORMATS[0], cloud(50), PlyOptions(), "a"))
    assert len(read_splats(tmp_path / "a.ply")[0]) == 50


def test_glb_is_what_the_specification_asks_for():
    content = encoded(format_of("a.glb"), cloud(33), PlyOptions(), "a.glb")
    magic, version, length, size, kind = struct.unpack_from("<4s4I", content)
    assert (magic, version, length, kind) == (b"glTF", 2, len(content), 0x4E4F534A)
    assert size % 4 == 0
    document = json.loads(content[20 : 20 + size])
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert set(primitive["extensions"]["KHR_gaussian_splatting"]) >= {"kernel", "colorSpace"}
    for index, accessor in enumerate(document["accessors"]):
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        packed = index == primitive["attributes"]["COLOR_0"]
        assert (accessor["componentType"], accessor.get("normalized", False)) == (
            (5123, True) if packed else (5126, False)
        )
        assert view["byteLength"] == (2 if packed else 4) * width * accessor["count"] == view["byteLength"] // 33 * 33
        assert view["byteLength"] // 33 % 4 == view["byteOffset"] % 4 == 0
    assert sum(view["byteLength"] for view in document["bufferViews"]) == document["buffers"][0]["byteLength"]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_glb_holds_the_data_turned_as_gltf_has_them(degree):
    """Degree l has the coefficients 0 to 2 l, in the order of the columns of a `.ply`; the root node turns nothing."""
    plain = cloud(5)
    terms = np.random.default_rng(1).normal(size=(5, (degree + 1) ** 2 - 1, 3)).astype(np.float32)
    before = replace(plain, harmonics=terms if degree else None)
    content = encoded(format_of("a.glb"), before, PlyOptions(), "a.glb")
    (size,) = struct.unpack_from("<I", content, 12)
    document, binary = json.loads(content[20 : 20 + size]), content[28 + size :]
    assert document["nodes"] == [{"name": "Splats", "mesh": 0}]
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    found = {name.split(":")[-1]: index for name, index in attributes.items()}
    names = [f"SH_DEGREE_{band}_COEF_{m}" for band in range(degree + 1) for m in range(2 * band + 1)]
    assert sorted(name for name in found if "SH_" in name) == sorted(names)

    def column(name: str, kind: str = "<f4") -> np.ndarray:
        view = document["bufferViews"][document["accessors"][found[name]]["bufferView"]]
        values = np.frombuffer(binary, kind, view["byteLength"] // np.dtype(kind).itemsize, view["byteOffset"])
        return values.reshape(5, -1)

    expected = turned_by(before, np.diag([-1.0, -1, 1]))  # solved on directions, for any rotation
    np.testing.assert_allclose(column("POSITION"), expected.means, atol=1e-6)
    same = (column("ROTATION")[:, [3, 0, 1, 2]] * unit(expected.quaternions)).sum(axis=1)
    np.testing.assert_allclose(abs(same), 1, atol=1e-6)
    for m, name in enumerate(names[1:]):
        np.testing.assert_allclose(column(name), expected.harmonics[:, m], atol=1e-5)
    light = column("COLOR_0", "<u2") / 65535
    shown = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(shown[:, :3], np.clip(plain.colors, 0, 1), atol=1e-4)
    np.testing.assert_allclose(light[:, 3], column("OPACITY")[:, 0], atol=1e-5)


def test_a_usd_stage_is_turned_upright():
    usd = pytest.importorskip("pxr.Usd")
    from pxr import Sdf, UsdGeom

    layer = Sdf.Layer.CreateAnonymous(".usdc")
    assert not Path(layer.realPath or "/nonexistent").exists()
    content = encoded(format_of("a.usdc"), cloud(20), PlyOptions(), "a.usdc")
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "a.usdc").write_bytes(content)
        stage = usd.Stage.Open(f"{folder}/a.usdc")
        prim = stage.GetDefaultPrim()
        assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
        up = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0).TransformDir((0, -1, 0))
        assert tuple(round(v, 6) for v in up) == (0, 1, 0)  # PLY -y is up


@pytest.mark.parametrize(("rule", "order"), [("spark", "cameraDistance"), ("inria", "zDepth"), (None, "zDepth")])
def test_a_usd_prim_says_how_it_is_drawn_and_is_valid(rule, order, tmp_path):
    validation = pytest.importorskip("pxr.UsdValidation")  # in usd-core from 25.11 on
    from pxr import Usd

    (tmp_path / "a.usdz").write_bytes(
        encoded(format_of("a.usdz"), cloud(20), PlyOptions(rule=rule, screen_size=9 if rule else None), "a")
    )
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    prim = stage.GetDefaultPrim()
    hints = [prim.GetAttribute(f"{name}ModeHint") for name in ("sorting", "projection")]
    assert [(hint.Get(), hint.HasAuthoredValue()) for hint in hints] == [(order, True), ("perspective", True)]
    assert Usd.ColorSpaceAPI.ComputeColorSpaceName(prim, None) == "srgb_rec709_scene"
    registry = validation.ValidationRegistry()
    said = validation.ValidationContext(registry.GetOrLoadAllValidators()).Validate(stage)
    assert [error.GetMessage() for error in said] == []


def test_convert_reports_the_error_of_the_format(tmp_path, vvgt):
    little = ("--max-gaussians", 300, "--screen", 64, "--steps", 24, "--tf", "viridis", "--report", tmp_path / "r.json")
    result = vvgt.ok("convert", "example:marschner-lobb:16", *little, "-o", tmp_path / "a.spz")
    found = re.search(r"PSNR ([\d.]+) dB, a \.ply would have ([\d.]+): the format costs (-?[\d.]+) dB", result.err)
    after, before, cost = map(float, found.groups())
    assert cost == pytest.approx(before - after, abs=0.011)
    assert 0 < before < 60
    assert json.loads((tmp_path / "r.json").read_text())["bytes"] == (tmp_path / "a.spz").stat().st_size
    scored = vvgt.ok("evaluate", tmp_path / "a.spz", "--volume", "example:marschner-lobb:16", "--tf", "viridis",
                     "--json", "--no-conditions", "--step", 0.5)  # fmt: skip
    assert json.loads(scored.out)["size"] == 64


def test_view_writes_formats_and_reports_their_error(tmp_path, vvgt):
    write_ply(tmp_path / "a.ply", cloud(), PlyOptions(screen_size=64))
    for ending, least in ((".html", 35), (".spz", 30), (".glb", 80), (".usdc", 80), (".ply", None)):
        result = vvgt.ok("view", tmp_path / "a.ply", "-o", tmp_path / f"b{ending}")
        found = re.search(r"([\d.]+|inf) dB from the Gaussians before writing, 3 views of 64 px", result.err)
        assert (found is None) == (least is None)
        assert least is None or float(found[1]) > least, result.err
        assert json.loads(vvgt("info", tmp_path / f"b{ending}", "--json").out)["gaussians"] == 700
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
    for name in ("a.ply", "b.spz", "b.html"):
        folder = tmp_path / f"{name}-views"
        vvgt.ok("render", tmp_path / name, "--orbit", 1, "--size", 64, "-o", folder)
    pictures = [read_png(tmp_path / f"{name}-views" / "orbit_000.png") for name in ("a.ply", "b.spz", "b.html")]
    assert psnr(pictures[0], pictures[1]) > 30
    assert psnr(pictures[0], pictures[2]) > 35


def test_the_page_is_one_small_file(tmp_path):
    rng = np.random.default_rng(0)
    many = 100_000
    scene = Gaussians(
        rng.uniform(-1, 1, (many, 3)), rng.uniform(-6, -3, (many, 3)), rng.normal(size=(many, 4)),
        rng.normal(size=many),
        rng.uniform(0, 1, (many, 3)),
    )  # fmt: skip
    content = encoded(format_of("a.html"), scene, PlyOptions(), "</script><b>.html")
    assert len(content) < 5e6
    text = content.decode()
    assert "</script><b>" not in text
    assert not re.findall(r"""(?:src|href)=["']?(?!data:)\w""", text)  # nothing is fetched
    (tmp_path / "b.html").write_text("<!doctype html><title>another</title>")
    refused(DataError, "a page without Gaussians", read_splats, tmp_path / "b.html")


def test_the_licences_of_what_the_page_holds_are_beside_it():
    page = Path(__file__).parent.parent / "vvgt_cli" / "gaussians" / "formats" / "page"
    wanted = json.loads((page / "package.json").read_text())["dependencies"]
    text = (page / "LICENSES.txt").read_text()
    for name in ("@playcanvas/supersplat-viewer", "playcanvas"):
        assert f"{name} {wanted[name]}\n" in text
    assert text.count("Permission is hereby granted") == 2
    assert (page / "viewer.js.gz").stat().st_size < 2e6


@pytest.fixture(scope="module")
def transform() -> list[str]:
    """splat-transform as a command."""
    found = shutil.which("splat-transform")
    if found is None:
        pytest.skip("splat-transform is not on the path (npm install -g @playcanvas/splat-transform@3.7.0)")
    return [found, "-q", "-g", "cpu", "-w"]


@pytest.mark.parametrize("ending", [".compressed.ply", ".spz", ".v4.spz", ".sog"])
def test_splat_transform_reads_what_is_written(ending, transform, tmp_path):
    path, middling = tmp_path / f"a{ending}", cloud()  # of 8-bit opacity 0 and 1 it makes infinite logits
    middling = replace(middling, opacity_logits=np.clip(middling.opacity_logits, -4, 4))
    path.write_bytes(encoded(format_of(path), middling, PlyOptions(up="x"), path.name))
    subprocess.run([*transform, path, tmp_path / "b.ply"], check=True, capture_output=True)
    theirs, ours = read_ply(tmp_path / "b.ply")[0], read_splats(path)[0]
    found = errors(ours, theirs)
    assert max(found) < 2e-3, found


def test_glb_holds_what_splat_transform_writes(transform, tmp_path):
    """The other writer of the extension, which turns the data as ours does."""
    before = cloud()
    write_ply(tmp_path / "a.ply", before, PlyOptions())
    subprocess.run([*transform, tmp_path / "a.ply", tmp_path / "b.glb"], check=True, capture_output=True)
    assert max(errors(before, read_splats(tmp_path / "b.glb")[0])) < 1e-5


def test_spz_4_of_splat_transform_is_read(transform, tmp_path):
    before = replace(cloud(), opacity_logits=np.linspace(-3, 3, 700))
    write_ply(tmp_path / "a.ply", before, PlyOptions())
    subprocess.run([*transform, tmp_path / "a.ply", tmp_path / "b.spz"], check=True, capture_output=True)
    assert (tmp_path / "b.spz").read_bytes()[:8] == b"NGSP\4\0\0\0"
    found = errors(before, read_splats(tmp_path / "b.spz")[0])
    assert all(a <= b for a, b in zip(found, (2.5e-4, 0.0313, 1e-5, 2.1e-3, 4e-3), strict=True)), found


def test_records_of_spz_4(tmp_path):
    known = format_of("a.v4.spz")
    content = known.write(splats_of(cloud(60), PlyOptions(up="x", rule="compensated", screen_size=100)), "a")
    assert content[14] & 1  # antialiased
    options = PlyOptions(rule="compensated", screen_size=9)
    assert gzip.decompress(encoded(format_of("a.spz"), cloud(60), options, "a"))[14]
    axes = content.index(struct.pack("<II", 0xADBE0003, 4))
    assert content[axes + 8] == 6  # right, down, front

    def given(old, new):
        table = struct.unpack_from("<I", content, 16)[0] + len(new) - len(old)
        changed = content[:16] + struct.pack("<I", table) + content[20:].replace(old, new, 1)
        return gaussians_of(known.read(changed, "a"), "a")[1].up

    record = content[axes : axes + 12]
    other = struct.pack("<II", 0x12340001, 3) + b"abc"
    assert given(record, other + record) == "x"  # skipped
    assert given(record, b"") == "x"
    refused(DataError, "axes of kind 04", given, record, record[:8] + b"\4\0\0\0")
    refused(DataError, "a record of", given, record, record[:4] + b"\xff\xff\0\0")


def test_hostile_spz_are_one_line_before_memory_is_taken():
    known, content = (
        format_of("a.v4.spz"),
        bytearray(struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 4 * 10**9, 0, 12, 0, 5, 32)),
    )
    content += b"".join(struct.pack("<QQ", 0, width * 4 * 10**9) for width in (9, 1, 3, 3, 4))
    refused(DataError, r"4,000,000,000 Gaussians: needs .* of memory", known.read, bytes(content), "a.spz")
    with pytest.raises(DataError, match=r"a\.spz: cannot be read as an \.spz"):
        known.read(b"\x1f\x8b\x08\x10" + b"a" * 40, "a.spz")  # a comment without its end


def test_a_stream_of_spz_4_that_ends_early_is_one_line():
    zstd, known = pytest.importorskip("numcodecs.zstd"), format_of("a.v4.spz")
    content = known.write(splats_of(cloud(60), PlyOptions(comments=False)), "a")
    table = struct.unpack_from("<I", content, 16)[0]
    (size, whole), short = struct.unpack_from("<QQ", content, table), bytes(zstd.compress(bytes(200), 1))
    end = len(content) - sum(struct.unpack_from("<Q", content, table + 16 * k)[0] for k in range(1, content[15]))
    changed = content[:table] + struct.pack("<QQ", len(short), whole) + content[table + 16 : end - size] + short
    refused(DataError, r"stream 0: truncated; expected 540 bytes", known.read, changed + content[end:], "a.spz")


@pytest.mark.parametrize("ending", [".spz", ".v4.spz"])
def test_harmonics_beyond_what_spz_holds_are_cut_off_not_wrapped(ending):
    known, base = format_of(f"a{ending}"), splats_of(cloud(60), PlyOptions(comments=False))
    rest = np.random.default_rng(0).uniform(-3, 3, (60, 8, 3)).astype(np.float32)
    found = known.read(known.write(replace(base, f_rest=rest), "a"), "a").f_rest
    assert abs(found - np.clip(rest, -1, 127 / 128)).max() <= 1 / 256 + 1e-6


def test_spz_4_of_degree_4_and_with_reserved_bytes_is_read():
    zstd, known = pytest.importorskip("numcodecs.zstd"), format_of("a.v4.spz")
    rest = np.random.default_rng(0).uniform(-0.9, 0.9, (60, 15, 3)).astype(np.float32)
    content = known.write(replace(splats_of(cloud(60), PlyOptions(comments=False)), f_rest=rest), "a")
    table = struct.unpack_from("<I", content, 16)[0]
    size = struct.unpack_from("<Q", content, table + 80)[0]
    bytes_of = np.frombuffer(zstd.decompress(content[-size:]), "u1").reshape(60, 45)
    more = bytes(zstd.compress(np.pad(bytes_of, ((0, 0), (0, 27)), constant_values=7).tobytes(), 1))
    front = content[:12] + b"\4" + content[13:20] + b"\xff" * 12 + content[32 : table + 80]
    changed = front + struct.pack("<QQ", len(more), 60 * 72) + content[table + 96 : -size] + more
    with pytest.warns(UserWarning, match="^a: harmonics of degree 4 are left out$"):
        after = known.read(changed, "a")
    before = known.read(content, "a")
    assert after.f_rest.tobytes() == before.f_rest.tobytes()
    assert after.means.tobytes() == before.means.tobytes()


@pytest.mark.parametrize(("at", "value"), [(4, 5), (12, 5), (15, 1), (16, 200), (19, 255), (60, 255)])
def test_damaged_headers_of_spz_4_are_one_line(at, value, tmp_path):
    known = format_of("a.v4.spz")
    content = bytearray(known.write(splats_of(cloud(60), PlyOptions(comments=False)), "a"))
    content[at] = value
    with pytest.raises(DataError) as error:
        known.read(bytes(content), "a.spz")
    assert "a.spz" in str(error.value)
    assert "\n" not in str(error.value)
