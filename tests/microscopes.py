"""Files of microscopes, written by hand where no program at hand writes them (LIF, ND2), else by its library."""

import io
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

NAMES = ("DAPI", "GFP")
COLORS = ((1.0, 0.0, 0.0), (0.0, 1.0, 1.0))  # that the files name
SPACING = (0.2, 0.3, 1.5)  # micrometres


def cells(times: int = 1, channels: int = 2, dtype: str = "uint16") -> np.ndarray:
    """(t, c, z, y, x): a linear field of the world, 1 + 2 x + 30 y + 500 z at voxel centres, plus 1000 c + 3000 t."""
    t, c, z, y, x = np.meshgrid(*map(np.arange, (times, channels, 5, 6, 8)), indexing="ij")
    sx, sy, sz = SPACING
    values = 1 + 2 * x * sx + 30 * y * sy + 500 * z * sz + 1000 * c + 3000 * t
    return np.round(values).astype(dtype)


def lif(
    images: Sequence[tuple[str, np.ndarray]], spacing: Sequence[float] = SPACING, origin: Sequence[float] = (0, 0, 0),
    interleaved: bool = False,
) -> bytes:  # fmt: skip
    """A LIF file, version 2: header, XML in UTF-16, and a memory block an image; values are (t, c, z, y, x)."""
    elements, blocks = "", b""
    for number, (name, values) in enumerate(images):
        item = values.itemsize
        stored = np.moveaxis(values, 1, -1) if interleaved else values
        dims, step = "", item * (values.shape[1] if interleaved else 1)
        sizes = values[:, : 1 if interleaved else None].shape[::-1]
        order = (("1", sizes[0]), ("2", sizes[1]), ("3", sizes[2]), ("c", sizes[3]), ("4", sizes[4]))
        channel_step = 0
        for kind, size in order:
            if kind == "c":
                channel_step = step
            elif size > 1 or kind in "12":
                length = 0.0 if kind == "4" else (size - 1) * spacing[int(kind) - 1] * 1e-6
                first = 0.0 if kind == "4" else origin[int(kind) - 1] * 1e-6
                unit = "s" if kind == "4" else "m"
                dims += (
                    f'<DimensionDescription DimID="{kind}" NumberOfElements="{size}" Origin="{first!r}" '
                    f'Length="{length!r}" Unit="{unit}" BitInc="0" BytesInc="{step}"/>'
                )
            step *= size
        channels = "".join(
            f'<ChannelDescription DataType="0" ChannelTag="0" Resolution="{8 * item}" NameOfMeasuredQuantity="" '
            f'Min="0" Max="1" Unit="" LUTName="{("Red", "Cyan", "Gray")[c % 3]}" IsLUTInverted="0" '
            f'BytesInc="{c * channel_step}" BitInc="0"><ChannelProperty><Key>DyeName</Key><Value>{NAMES[c % 2]}</Value>'
            "</ChannelProperty></ChannelDescription>"
            for c in range(values.shape[1])
        )
        elements += (
            f'<Element Name="{name}" UniqueID="{number}"><Data><Image><ImageDescription><Channels>{channels}</Channels>'
            f"<Dimensions>{dims}</Dimensions></ImageDescription></Image></Data>"
            f'<Memory Size="{values.nbytes}" MemoryBlockID="MemBlock_{number}"/></Element>'
        )
        title = f"MemBlock_{number}"
        head = struct.pack("<IIBQBI", 0x70, 0, 0x2A, values.nbytes, 0x2A, len(title))
        blocks += head + title.encode("utf-16-le") + stored.tobytes()
    xml = (
        '<LMSDataContainerHeader Version="2"><Element Name="all"><Children>'
        f"{elements}</Children></Element></LMSDataContainerHeader>"
    )
    return struct.pack("<IIBI", 0x70, 2 * len(xml) + 5, 0x2A, len(xml)) + xml.encode("utf-16-le") + blocks


def _lite(values: dict[str, Any]) -> bytes:
    """Nikon's "lite variant": type, length of the name, name in UTF-16, value."""
    out = b""
    for name, value in values.items():
        text = (name + "\0").encode("utf-16-le")
        kind, data = {
            bool: (1, lambda v: struct.pack("<B", v)),
            int: (3, lambda v: struct.pack("<I", v)),
            float: (6, lambda v: struct.pack("<d", v)),
            str: (8, lambda v: (v + "\0").encode("utf-16-le")),
            dict: (11, None),
        }[type(value)]
        head = struct.pack("<BB", kind, len(name) + 1) + text
        if data is None:
            inner = _lite(value)
            out += head + struct.pack("<IQ", len(value), len(head) + 12 + len(inner)) + inner + bytes(8 * len(value))
        else:
            out += head + data(value)
    return out


def nd2(values: np.ndarray, packed: bool = False, spacing: Sequence[float] = SPACING) -> bytes:
    """An ND2 file, version 3.0, of values (t, c, z, y, x): chunks, and a map of them at the end."""
    times, channels, slices, ny, nx = values.shape
    planes = {
        f"a{c}": {"sDescription": NAMES[c % 2], "uiColor": (0x0000FF, 0xFFFF00)[c % 2], "uiCompCount": 1,
                  "pFluorescentProbe": {"uiCount": 0}, "pFilterPath": {"uiCount": 0}}
        for c in range(channels)
    }  # fmt: skip
    loop: dict[str, Any] = {
        "eType": 4, "uLoopPars": {"uiCount": slices, "dZLow": 0.0, "dZHigh": spacing[2] * (slices - 1),
                                  "dZStep": spacing[2], "dZHome": 0.0, "iType": 0},
    }  # fmt: skip
    if times > 1:
        pars = {"uiCount": times, "dStart": 0.0, "dPeriod": 1.0, "dDuration": 1.0 * times}
        loop = {"eType": 1, "uLoopPars": pars, "ppNextLevelEx": {"i0": loop}}
    bits = 8 * values.itemsize
    facts = {
        b"ImageAttributesLV!": {"SLxImageAttributes": {
            "uiWidth": nx, "uiWidthBytes": nx * channels * values.itemsize, "uiHeight": ny, "uiComp": channels,
            "uiBpcInMemory": bits, "uiBpcSignificant": bits, "uiSequenceCount": times * slices,
            "eCompression": 0 if packed else 2}},
        b"ImageMetadataSeqLV|0!": {"SLxPictureMetadata": {
            "bCalibrated": True, "dCalibration": spacing[0],
            "sPicturePlanes": {"uiCount": channels, "sPlaneNew": planes}}},
        b"ImageMetadataLV!": {"SLxExperiment": loop},
    }  # fmt: skip
    chunks = {name: _lite(tree) for name, tree in facts.items()}
    frames = values.transpose(0, 2, 3, 4, 1).reshape(times * slices, -1)  # of a frame the channels are innermost
    chunks |= {
        b"ImageDataSeq|%d!" % k: bytes(8) + (zlib.compress(frame.tobytes()) if packed else frame.tobytes())
        for k, frame in enumerate(frames)
    }
    out, where = io.BytesIO(), b""
    out.write(struct.pack("<IIQ32s64s", 0x0ABECEDA, 32, 64, b"ND2 FILE SIGNATURE CHUNK NAME01!", b"Ver3.0"))
    for name, data in chunks.items():
        where += name + struct.pack("<QQ", out.tell(), len(data))
        out.write(struct.pack("<IIQ", 0x0ABECEDA, 4072, len(data)) + name.ljust(4072, b"\0") + data)
    end = b"ND2 CHUNK MAP SIGNATURE 0000001!" + struct.pack("<Q", out.tell())
    title = b"ND2 FILEMAP SIGNATURE NAME 0001!"
    out.write(struct.pack("<IIQ", 0x0ABECEDA, len(title), len(where) + len(end)) + title + where + end)
    return out.getvalue()


def write_ims(path: Path, values: np.ndarray, levels: int = 2) -> None:
    """An Imaris file of values (t, c, z, y, x), in padded chunks; every level has half the voxels along x and y."""
    import h5py

    def text(group: Any, **attributes: object) -> None:
        for key, value in attributes.items():
            group.attrs[key] = np.array([c.encode() for c in str(value)], "S1")

    with h5py.File(path, "w") as file:
        for level in range(levels):
            part = values[..., :: 1 << level, :: 1 << level]
            for t, c in np.ndindex(*values.shape[:2]):
                group = file.create_group(f"DataSet/ResolutionLevel {level}/TimePoint {t}/Channel {c}")
                nz, ny, nx = part.shape[2:]
                text(group, ImageSizeX=nx, ImageSizeY=ny, ImageSizeZ=nz)
                padded = np.zeros([-(-n // 4) * 4 for n in (nz, ny, nx)], values.dtype)
                padded[:nz, :ny, :nx] = part[t, c]
                group.create_dataset("Data", data=padded, chunks=(4, 4, 4), compression="gzip")
        image = file.create_group("DataSetInfo/Image")
        text(image, Unit="um", X=values.shape[4], Y=values.shape[3], Z=values.shape[2])
        for axis, (step, size) in enumerate(zip(SPACING, values.shape[:1:-1], strict=True)):
            text(image, **{f"ExtMin{axis}": -step / 2, f"ExtMax{axis}": step * (size - 0.5)})
        for c in range(values.shape[1]):
            color = " ".join(f"{v:.3f}" for v in COLORS[c % 2])
            text(file.create_group(f"DataSetInfo/Channel {c}"), Name=NAMES[c % 2], Color=color, ColorMode="BaseColor")


def write_czi(
    path: Path, values: np.ndarray, compression: str = "uncompressed:", tiles: bool = False, scenes: int = 1
) -> None:
    """A CZI file of values (t, c, z, y, x), by libCZI; in tiles of a mosaic, in scenes beside each other."""
    from pylibCZIrw import czi

    red, cyan = (
        czi.ChannelDisplaySettingsDataClass(
            True, czi.TintingMode.Color, czi.Rgb8Color(*(np.uint8(255 * v) for v in rgb)), 0.0, 1.0
        )
        for rgb in COLORS
    )
    times, channels, slices, _ny, nx = values.shape
    with czi.create_czi(str(path), exist_ok=True, compression_options=compression) as file:
        for scene, t, c, z in np.ndindex(scenes, times, channels, slices):
            plane = {"T": t, "C": c, "Z": z}
            for x0, x1 in ((0, 3), (3, nx)) if tiles else ((0, nx),):
                part = np.ascontiguousarray(values[t, c, z, :, x0:x1, None]) + values.dtype.type(scene)
                file.write(
                    part, plane=plane, location=(1000 * scene + 7 + x0, 5), **({"scene": scene} if scenes > 1 else {})
                )
        x, y, z = (s * 1e-6 for s in SPACING)
        names, display = dict(enumerate(NAMES[:channels])), {0: red, 1: cyan} if channels > 1 else {0: red}
        file.write_metadata("cells", channel_names=names, scale_x=x, scale_y=y, scale_z=z, display_settings=display)
