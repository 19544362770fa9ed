"""Gaussians of other programs: rows that cannot be drawn, compressed files of SuperSplat 1, `.splat` and `.ksplat`."""

import io
import json
import warnings
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli as library
from tests.refused import refused
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply, write_ply
from vvgt_cli.gaussians.formats import encoded, format_of, read_splats

NAMES = ["x", "y", "z", *(f"f_dc_{k}" for k in range(3)), "opacity", *(f"scale_{k}" for k in range(3))]
NAMES += [f"rot_{k}" for k in range(4)]
RANGES = [f"{end}_{of}{axis}" for of in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
COLORS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
SH_C0 = 0.28209479177387814
GOOD = np.random.default_rng(2).normal([0] * 7 + [-3] * 3 + [0] * 4, size=(40, 14)).astype("<f4")
# row, column, value: seven rows with what other programs write; row 6 alone can be drawn, as opaque
BAD = (
    (0, 7, -np.inf), (1, 9, np.inf), (2, 0, np.nan), (3, 6, -np.inf), (4, 6, np.nan), (5, 4, np.inf), (6, 6, np.inf),
)  # fmt: skip


def ply(rows: np.ndarray, comment: str = "") -> bytes:
    head = ["ply", "format binary_little_endian 1.0", *([comment] if comment else []), f"element vertex {len(rows)}"]
    return "\n".join([*head, *(f"property float {n}" for n in NAMES), "end_header", ""]).encode() + rows.tobytes()


def damaged() -> np.ndarray:
    rows = GOOD.copy()
    for row, column, value in BAD:
        rows[row, column] = value
    rows[7, 10:] = 0
    return rows


def same(one: Gaussians, other: Gaussians) -> bool:
    arrays = zip(one.arrays().values(), other.arrays().values(), strict=True)
    return all(np.array_equal(a, b) for a, b in arrays)


def test_rows_that_cannot_be_drawn_are_skipped_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(ply(damaged()))
    message = r"of 40 Gaussians 7 skipped \(.*\), 1 read as opaque \(opacity inf\)"
    for read in (read_splats, library.read_ply, open_gaussians):
        with pytest.warns(UserWarning, match=message):
            found, _ = read(str(path))
        np.testing.assert_array_equal(found.means, GOOD[[6, *range(8, 40)], :3])
        assert 1 - 1e-6 < 1 / (1 + np.exp(-found.opacity_logits[0].astype(float))) < 1
    with pytest.warns(UserWarning, match=message):
        open_gaussians(io.BytesIO(path.read_bytes()))
    path.write_bytes(ply(GOOD))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_splats(path)[0]) == 40


def test_a_file_of_vvgt_with_such_rows_is_damaged(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"Gaussians.means: 1 of 40 rows are not finite"):
        read_ply(io.BytesIO(ply(damaged(), "comment vvgt 0.1.0")))


def test_every_command_takes_them_and_check_reports_them(vvgt, tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(ply(damaged()))
    message = "of 40 Gaussians 7 skipped"
    with pytest.warns(UserWarning, match=message):
        assert json.loads(vvgt("info", path, "--json").out)["gaussians"] == 33
    for line in (
        ("render", path, "-o", tmp_path / "r", "--size", 32, "--orbit", 1),
        ("view", path, "-o", tmp_path / "v.html"),
    ):
        with pytest.warns(UserWarning, match=message):
            done = vvgt(*line)
        assert done.code == 0, done.err
    done = vvgt("check", path, "--json")
    values = {o["name"]: o["value"] for o in json.loads(done.out)["outcomes"] if o["stage"] == "file"}
    told = {
        name: values[f"{name} that are not finite"]
        for name in ("centres", "sizes", "opacities", "rotations", "colours")
    }
    assert told == {"centres": 1, "sizes": 2, "opacities": 3, "rotations": 1, "colours": 1}


def test_nothing_but_such_rows(vvgt, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(ply(np.full_like(GOOD, np.nan)))
    with (
        pytest.warns(UserWarning, match="of 40 Gaussians 40 skipped"),
        pytest.raises(DataError, match="holds no Gaussians"),
    ):
        open_gaussians(str(tmp_path / "a.ply"))


# ---- .splat


def splat(rows: np.ndarray) -> bytes:
    """As convert.py of antimatter15/splat writes it."""
    content = b""
    for row in rows.astype(np.float64):
        color = [*(0.5 + SH_C0 * row[3:6]), 1 / (1 + np.exp(-row[6]))]
        turn = row[10:14] / np.linalg.norm(row[10:14]) * 128 + 128
        content += np.float32([*row[:3], *np.exp(row[7:10])]).tobytes()
        content += bytes(np.clip(np.multiply(color, 255), 0, 255).astype(np.uint8)) + bytes(
            turn.clip(0, 255).astype(np.uint8)
        )
    return content


def test_splat(vvgt, tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(splat(GOOD))
    found, expected = read_splats(path)[0], read_ply(io.BytesIO(ply(GOOD)))[0]
    np.testing.assert_array_equal(found.means, expected.means)
    np.testing.assert_allclose(found.log_scales, expected.log_scales, atol=1e-6)
    np.testing.assert_allclose(found.colors, expected.colors.clip(0, 1), atol=1 / 255)
    turns = expected.quaternions / np.linalg.norm(expected.quaternions, axis=1, keepdims=True)
    assert abs((found.quaternions * turns).sum(axis=1)).min() > 0.9998
    opacity = [1 / (1 + np.exp(-g.opacity_logits.astype(float))) for g in (found, expected)]
    np.testing.assert_allclose(*opacity, atol=1 / 255)
    assert json.loads(vvgt("info", path, "--json").out)["format"] == ".splat"
    vvgt.ok("render", path, "-o", tmp_path / "r", "--size", 32, "--orbit", 1)
    flat = GOOD.copy()
    flat[3, 7] = -np.inf
    path.write_bytes(splat(flat))
    with pytest.warns(UserWarning, match=r"of 40 Gaussians 1 skipped \(a value not finite, or rotation 0\)$"):
        assert len(read_splats(path)[0]) == 39


def test_what_is_no_splat_and_what_is_not_written(vvgt, tmp_path: Path) -> None:
    for content in (b"", splat(GOOD)[:-1]):
        (tmp_path / "a.splat").write_bytes(content)
        refused(DataError, r"expected a .splat of 32 bytes a Gaussian", read_splats, tmp_path / "a.splat")
    (tmp_path / "a.ksplat").write_bytes(bytes(4096))
    for command in ("info", "check", "view"):
        assert "a.ksplat out.ply" in vvgt(command, tmp_path / "a.ksplat").error
    (tmp_path / "a.ply").write_bytes(ply(GOOD))
    vvgt.fails(2, "optimize", tmp_path / "a.ply", "--volume", "example:blob:16", "-o", tmp_path / "b.splat")
    assert not (tmp_path / "b.splat").exists()


# ---- .compressed.ply


def compressed(
    ranges: list[str], packed: list[str] = PACKED, elements: str = "chunk vertex", sh: int = 0, newline: str = "\n",
    count: int = 300, chunks: int = 2, form: str = "binary_little_endian 1.0",
) -> bytes:  # fmt: skip
    """A file of random bits, in any order of elements and columns."""
    rng = np.random.default_rng(5)
    words, bytes_ = rng.integers(0, 2**32, (count, 4), "u4"), rng.integers(0, 256, (count, 45), "u1")
    values = {
        name: (2 if "max" in name else -1) + 0.01 * k + 0.1 * np.arange(chunks)
        for k, name in enumerate(RANGES + COLORS)
    }
    parts = {
        "chunk": (chunks, "float", ranges, np.stack([values[name] for name in ranges], 1).astype("<f4")),
        "vertex": (count, "uint", packed, words[:, [PACKED.index(name) for name in packed]].astype("<u4")),
        "sh": (count, "uchar", [f"f_rest_{k}" for k in range(sh)], bytes_[:, :sh]),
    }
    head, body = ["ply", f"format {form}", "comment Generated by SuperSplat 1.8.3"], b""
    for element in elements.split():
        number, kind, names, table = parts[element]
        head += [f"element {element} {number}", *(f"property {kind} {name}" for name in names)]
        body += np.ascontiguousarray(table).tobytes()
    return newline.join([*head, "end_header", ""]).encode() + body


def read(tmp_path: Path, content: bytes, name: str = "a.compressed.ply") -> Gaussians:
    (tmp_path / name).write_bytes(content)
    return read_splats(tmp_path / name)[0]


def test_chunks_of_supersplat_1_have_colours_from_0_to_1(vvgt, tmp_path: Path) -> None:
    content = compressed(RANGES)
    found = read(tmp_path, content, "b.ply")
    bits = np.frombuffer(content[-300 * 16 :], "<u4").reshape(300, 4)
    channels = [(bits[:, 3] >> shift & 255) / 255 for shift in (24, 16, 8)]
    np.testing.assert_allclose(found.colors, np.stack(channels, axis=1), atol=1e-6)
    place = (bits[:, 0] >> 21) / 2047
    low, high = (np.repeat([v, v + 0.1], 256)[:300] for v in (-1, 2 + 0.03))
    np.testing.assert_allclose(found.means[:, 0], low + (high - low) * place, atol=1e-5)
    assert json.loads(vvgt("info", tmp_path / "b.ply", "--json").out)["gaussians"] == 300


@pytest.mark.parametrize("ranges", [RANGES, RANGES + COLORS], ids=["12", "18"])
def test_columns_are_found_by_name(tmp_path: Path, ranges: list[str]) -> None:
    expected = read(tmp_path, compressed(ranges))
    assert same(expected, read(tmp_path, compressed(ranges[::-1], PACKED[::-1])))
    assert same(expected, read(tmp_path, compressed(ranges, elements="vertex chunk")))
    assert same(expected, read(tmp_path, compressed(ranges, newline="\r\n")))
    for sh, degree in ((9, 1), (24, 2), (45, 3)):
        shaded = read(tmp_path, compressed(ranges, elements="chunk vertex sh", sh=sh))
        assert shaded.degree == degree
        assert same(shaded, read(tmp_path, compressed(ranges, elements="sh vertex chunk", sh=sh)))


def test_our_own_compressed_files_keep_their_comments(tmp_path: Path) -> None:
    stream = io.BytesIO()
    gaussians = read_ply(io.BytesIO(ply(GOOD)))[0]
    write_ply(stream, gaussians, PlyOptions())
    content = encoded(format_of("a.compressed.ply"), gaussians, PlyOptions(screen_size=321, rule="spark"), "a")
    (tmp_path / "a.compressed.ply").write_bytes(content)
    _, header = read_splats(tmp_path / "a.compressed.ply")
    assert (header.screen_size, header.rule) == (321, "spark")
    assert header.version is not None
