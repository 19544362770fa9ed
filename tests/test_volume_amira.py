"""AmiraMesh and Avizo files, written by hand as the user's guide has them: geometry, encodings, several streams."""

import zlib
from pathlib import Path

import numpy as np
import pytest

from vvgt_cli.errors import DataError, SeveralArrays, SeveralComponents
from vvgt_cli.volume import ReadOptions, read_volume

VALUES = np.arange(60, dtype=np.uint16).reshape(3, 4, 5) * 700
BOX = "BoundingBox -2 2 10 16 0 10"  # steps of 1, 2 and 5


def run_lengths(data: bytes) -> bytes:
    """Runs of equal bytes, others as they are, as Amira's HxByteRLE has them."""
    out, k = b"", 0
    while k < len(data):
        n = 1
        while n < 127 and data[k + n : k + n + 1] == data[k : k + 1]:
            n += 1
        out += bytes([n]) + data[k : k + 1] if n > 2 else bytes([0x81]) + data[k : k + 1]
        k += n if n > 2 else 1
    return out


def amira(form: str, streams: list[tuple[str, str, bytes]], parameters: str = BOX, define: str = "5 4 3") -> bytes:
    """A file of streams: type and name, encoding, content."""
    text = f"# {form}\n\n# BoundingBox 0 0 0 0 0 0\ndefine Lattice {define}\n\nParameters {{\n    {parameters},\n"
    text += '    Content "5x4x3, uniform coordinates",\n    CoordType "uniform"\n}\n\n'
    for k, (what, coding, content) in enumerate(streams, 1):
        text += f"Lattice {{ {what} }} @{k}" + (f"({coding},{len(content)})" if coding else "") + "\n"
    body = b"".join(b"@%d\n" % k + content + b"\n\n" for k, (_, _, content) in enumerate(streams, 1))
    return text.encode() + b"\n# Data section follows\n" + body


def put(folder: Path, data: bytes) -> str:
    path = folder / "v.am"
    path.write_bytes(data)
    return str(path)


@pytest.mark.parametrize(
    ("form", "content", "coding"),
    [
        ("AmiraMesh BINARY-LITTLE-ENDIAN 2.1", VALUES.astype("<u2").tobytes(), ""),
        ("AmiraMesh 3D BINARY 2.0", VALUES.astype(">u2").tobytes(), ""),
        ("Avizo BINARY-LITTLE-ENDIAN 2.1", zlib.compress(VALUES.astype("<u2").tobytes()), "HxZip"),
        ("AmiraMesh BINARY-LITTLE-ENDIAN 2.1", run_lengths(VALUES.astype("<u2").tobytes()), "HxByteRLE"),
        ("AmiraMesh 3D ASCII 2.0", "\n".join(map(str, VALUES.ravel())).encode(), ""),
    ],
)
@pytest.mark.parametrize("stored", [False, True])
def test_values_and_places(tmp_path: Path, form: str, content: bytes, coding: str, stored: bool) -> None:
    first = ("byte Mask", coding, {"HxZip": zlib.compress, "HxByteRLE": run_lengths}.get(coding, bytes)(b"\n@2\n" * 15))
    if "ASCII" in form:
        first = ("byte Mask", "", b" ".join([b"7"] * 60))
    path = put(tmp_path, amira(form, [first, ("ushort Data", coding, content)]))
    volume = read_volume(path, ReadOptions(array="Data", stored=stored))
    np.testing.assert_array_equal(volume.data, VALUES)
    assert volume.spacing == (1, 2, 5)
    assert volume.origin == (-2, 10, 0)  # the box is that of the centres
    assert isinstance(volume.data, np.memmap) == ("BINARY" in form and not coding)
    with pytest.raises(SeveralArrays) as caught:
        read_volume(path)
    assert caught.value.choices == ["Mask", "Data"]


def test_a_matrix_moves_and_turns_the_box(tmp_path: Path) -> None:
    # row vectors: x runs along y, y along -x; moved by (100, 0, 7)
    moved = f'Units {{\n Coordinates "µm"\n }}\n History {{ BoundingBox 0 1 0 1 0 1 }}\n {BOX}\n'
    moved += "TransformationMatrix 0 1 0 0 -1 0 0 0 0 0 1 0 100 0 7 1"
    path = put(tmp_path, amira("Avizo BINARY-LITTLE-ENDIAN 2.1", [("float V", "", b"\0" * 240)], moved))
    volume = read_volume(path)
    np.testing.assert_allclose(volume.affine @ [4, 3, 2, 1], [100 - 16, 2, 10 + 7, 1])
    np.testing.assert_allclose(volume.affine @ [0, 0, 0, 1], [100 - 10, -2, 7, 1])
    assert volume.unit == "um"


def test_vectors_and_single_slices(tmp_path: Path) -> None:
    vectors = np.arange(60, dtype="<f4").reshape(1, 4, 5, 3)
    path = put(
        tmp_path,
        amira(
            "AmiraMesh BINARY-LITTLE-ENDIAN 2.1",
            [("float[3] V", "", vectors.tobytes())],
            "BoundingBox 0 2 0 3 4 4",
            "5 4 1",
        ),
    )
    with pytest.raises(SeveralComponents):
        read_volume(path)
    volume = read_volume(path, ReadOptions(component=2))
    np.testing.assert_array_equal(volume.data, vectors[..., 2])
    assert volume.spacing == (0.5, 1, 0.5)


def test_what_is_not_known_is_an_error_or_a_message(tmp_path: Path) -> None:
    whole = amira(
        "AmiraMesh BINARY-LITTLE-ENDIAN 2.1", [("ushort V", "", VALUES.tobytes())], 'Units { Coordinates "furlong" }'
    )
    with pytest.warns(UserWarning, match="no BoundingBox"), pytest.warns(UserWarning, match="furlong"):
        assert read_volume(put(tmp_path, whole)).unit == ""
    for old, new, text in (
        (b'"uniform"', b'"curvilinear"', "curvilinear coordinates"),
        (b"ushort V", b"complex V", r"Lattice \(complex\)"),
        (b"} @1", b"} @1(HxDeflate,9)", "HxDeflate"),
        (b"Lattice {", b"Vertices {", r"Vertices \(ushort\)"),
        (b"define Lattice 5", b"define Lattice 6", "needs 144 bytes|need"),
    ):
        with pytest.raises(DataError, match=text):
            read_volume(put(tmp_path, whole.replace(old, new)), ReadOptions(spacing=(1, 1, 1)))
