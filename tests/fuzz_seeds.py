"""Seeds of tests/fuzz.py: small whole files of every format that the package reads by itself."""

import bz2
import gzip
import io
import json
import tarfile
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from fuzz import Seed
from fuzz_splats import others, ply, sog

from vvgt_cli.volume import ReadOptions, read_volume

FIXTURES = Path(__file__).parent / "fixtures"
VALUES = np.random.default_rng(7).integers(0, 200, (3, 4, 5)).astype(np.int16)
FLOATS = np.random.default_rng(8).standard_normal((3, 4, 5)).astype(np.float32)


def volume_reader(**options: Any) -> Callable[[Path], None]:
    """Read a volume and look at its first and last slices."""

    def read(path: Path) -> None:
        volume = read_volume(str(path), ReadOptions(**options))
        for z in (0, -1):
            np.asarray(volume.data[z:] if options.get("stored") else volume.data[z])

    return read


READ = volume_reader()


def raw() -> list[Seed]:
    return [
        Seed("v_5x4x3_int16.raw", VALUES.tobytes(), READ),
        Seed("w_5x4x3_int16.raw.gz", gzip.compress(VALUES.tobytes()), READ),
        Seed("x.raw.gz", VALUES.tobytes(), volume_reader(dims=(5, 4, 3), dtype="int16"), pack=gzip.compress),
    ]


def nrrd() -> list[Seed]:
    def head(encoding: str, more: str = "") -> bytes:
        text = (
            "NRRD0005\n# a comment\ntype: short\ndimension: 3\nspace: left-posterior-superior\nsizes: 5 4 3\n"
            "space directions: (1,0,0) (0,2,0) (0,0,3)\nspace origin: (1,2,3)\nendian: little\n"
            f"encoding: {encoding}\n{more}\n"
        )
        return text.encode()

    data = VALUES.tobytes()
    numbers = " ".join(map(str, VALUES.ravel())).encode()
    slices = {f"s{z}.raw": plane.tobytes() for z, plane in enumerate(VALUES)}
    vectors = (
        b"NRRD0004\ntype: float\ndimension: 4\nsizes: 3 5 4 3\nkinds: vector domain domain domain\n"
        b"spacings: nan 1 2 3\nendian: big\nencoding: raw\n\n"
    )
    return [
        Seed("a.nrrd", head("raw") + data, READ),
        Seed("b.nrrd", head("gzip") + gzip.compress(data), READ),
        Seed("c.nrrd", head("bzip2") + bz2.compress(data), READ),
        Seed("d.nrrd", head("text") + numbers, READ),
        Seed("e.nhdr", head("raw", "byte skip: 2\nline skip: 0\ndata file: v.raw\n"), READ, {"v.raw": b"xx" + data}),
        Seed("f.nrrd", vectors + np.repeat(FLOATS, 3).astype(">f4").tobytes(), volume_reader(component="magnitude")),
        Seed("g.nhdr", head("raw", "data file: LIST\ns0.raw\ns1.raw\ns2.raw")[:-1], READ, slices),
        Seed("h.nhdr", head("raw", "data file: s%d.raw 0 2 1\n"), READ, slices),
        Seed(
            "i.seq.nrrd",
            vectors.replace(b"vector", b"list") + np.repeat(FLOATS, 3).astype(">f4").tobytes(),
            volume_reader(time=1),
        ),
    ]


def metaimage() -> list[Seed]:
    def head(name: str, **more: str) -> bytes:
        fields = {
            "ObjectType": "Image", "NDims": "3", "BinaryData": "True", "BinaryDataByteOrderMSB": "False",
            "CompressedData": "False", "TransformMatrix": "1 0 0 0 1 0 0 0 1", "Offset": "1 2 3",
            "ElementSpacing": "0.5 1 2", "DimSize": "5 4 3", "ElementType": "MET_SHORT",
        } | more  # fmt: skip
        return "".join(f"{k} = {v}\n" for k, v in fields.items()).encode() + f"ElementDataFile = {name}\n".encode()

    data = VALUES.tobytes()
    packed = zlib.compress(data)
    size = str(len(packed))
    text = " ".join(map(str, VALUES.ravel())).encode()
    series = head("LOCAL", NDims="4", DimSize="5 4 1 3", ElementSpacing="1 1 1 1", Offset="0 0 0 0", HeaderSize="-1")
    return [
        Seed("a.mha", head("LOCAL") + data, READ),
        Seed("b.mha", head("LOCAL", CompressedData="True", CompressedDataSize=size) + packed, READ),
        Seed("c.mha", head("LOCAL", BinaryData="False") + text, READ),
        Seed("d.mhd", head("v.raw", HeaderSize="2"), READ, {"v.raw": b"xx" + data}),
        Seed("e.mha", series + data, volume_reader(component=1)),
    ]


def inviwo() -> list[Seed]:
    text = (
        b"RawFile: v.raw\nResolution: 5 4 3\nFormat: INT16\nByteOffset: 2\nBasisVector1: 1 0 0\nBasisVector2: 0 2 0\n"
        b"BasisVector3: 0 0 3\nOffset: 1 2 3\nDataRange: 0 200\nValueRange: 0 1\n"
    )
    series = b"ObjectFileName: v.raw\nResolution: 5 4 1\nFormat: SHORT\nSequences: 3\nSliceThickness: 1 1 2\n"
    beside = {"v.raw": b"xx" + VALUES.tobytes()}
    return [Seed("a.dat", text, READ, beside), Seed("b.dat", series, volume_reader(component=2), beside)]


def vgi() -> list[Seed]:
    text = (
        b"{volume1}\n[representation]\nsize = 5 4 3\n[file1]\nSkipHeader = 2\nFileFormat = raw\nSize = 5 4 3\n"
        b"Mirror = 0 0 1\nName = v.raw\nDatatype = signed integer\nBitsPerElement = 16\n"
        b"{volumeprimitive1}\n[geometry]\nresolution = 1 2 3\nunit = mm\n[volume]\nvolume = volume1\n"
    )
    return [Seed("a.vgi", text, READ, {"v.raw": b"xx" + VALUES.tobytes()})]


def slc() -> list[Seed]:
    head = b"11111\n5 4 3 8\n1.0 2.0 3.0\n1 0 0\n%d\n2 2 X" + bytes(12)
    values = VALUES.astype(np.uint8)
    planes = b""
    for plane in values:
        runs = bytes([128 + 18]) + plane.ravel()[:18].tobytes() + bytes([2, int(plane.ravel()[-1]), 0])
        planes += b"%d X" % len(runs) + runs
    return [Seed("a.slc", head % 0 + values.tobytes(), READ), Seed("b.slc", head % 1 + planes, READ)]


def tiff() -> list[Seed]:
    import OpenImageIO as oiio

    seeds = []
    for name, values, how in (
        ("a.tif", VALUES.astype(np.uint16), "zip"),
        ("b.tif", FLOATS, "none"),
        ("c.tif", VALUES.astype(np.uint8), "packbits"),
    ):
        with tempfile.TemporaryDirectory() as folder:
            path = f"{folder}/{name}"
            spec = oiio.ImageSpec(5, 4, 1, str(values.dtype))
            spec.attribute("compression", how)
            out = oiio.ImageOutput.create(path)
            out.open(path, [spec] * 3)
            for z, page in enumerate(values):
                if z:
                    out.open(path, spec, "AppendSubimage")
                out.write_image(np.ascontiguousarray(page[..., None]))
            out.close()
            seeds.append(Seed(name, Path(path).read_bytes(), READ))
    return seeds + _tiff_images()


def _tiff_images() -> list[Seed]:
    """OME-TIFF, ImageJ's and tifffile's own, plain and compressed, little and big, of channels and time steps."""
    import tifffile

    values = np.random.default_rng(9).integers(0, 200, (2, 2, 3, 4, 5)).astype(np.uint16)
    ome = {"axes": "TCZYX", "PhysicalSizeX": 0.2, "PhysicalSizeZ": 1.5, "Channel": {"Name": ["a", "b"]}}
    imagej = {"axes": "TZCYX", "spacing": 2.5, "unit": "um"}
    chosen, stored = volume_reader(component=1, time=1), volume_reader(component=1, time=1, stored=True)
    seeds = []
    for name, axes, read, how in (
        ("d.ome.tif", (0, 1, 2, 3, 4), volume_reader(component="b", time=1), {"ome": True, "metadata": ome}),
        ("e.ome.tif", (0, 1, 2, 3, 4), chosen, {"ome": True, "metadata": ome, "compression": "zlib", "bigtiff": True}),
        ("f.tif", (0, 2, 1, 3, 4), chosen, {"imagej": True, "metadata": imagej, "resolution": (5, 4)}),
        ("g.tif", (0, 2, 1, 3, 4), chosen, {"imagej": True, "metadata": imagej, "compression": "lzma"}),
        ("h.tif", (0, 1, 2, 3, 4), chosen, {"metadata": {"axes": "TCZYX"}, "byteorder": ">"}),
        ("i.tif", (0, 2, 1, 3, 4), chosen, {"imagej": True, "metadata": imagej, "truncate": True, "byteorder": ">"}),
        (
            "j.tif",
            (0, 2, 1, 3, 4),
            stored,
            {"imagej": True, "metadata": imagej, "truncate": True, "resolution": (72, 72)},
        ),
        ("k.tif", (0, 1, 2, 3, 4), chosen, {"metadata": {"axes": "TCZYX"}, "truncate": True}),
    ):
        out = io.BytesIO()
        tifffile.imwrite(out, values.transpose(axes), **{"byteorder": "<", **how})  # type: ignore[arg-type]
        seeds.append(Seed(name, out.getvalue(), read))
    return seeds


def vtk_legacy() -> list[Seed]:
    head = (
        b"# vtk DataFile Version 4.2\na title\n%s\nDATASET STRUCTURED_POINTS\nDIMENSIONS 5 4 3\nSPACING 1 2 3\n"
        b"ORIGIN 1 2 3\nPOINT_DATA 60\nSCALARS values short 1\nLOOKUP_TABLE default\n"
    )
    numbers = b" ".join(b"%d" % v for v in VALUES.ravel())
    more = b"\nMETADATA\nINFORMATION 0\n\nFIELD FieldData 1\nother 1 60 float\n"
    floats = FLOATS.astype(">f4").tobytes()
    return [
        Seed("a.vtk", head % b"ASCII" + numbers + b"\n", READ),
        Seed("b.vtk", head % b"BINARY" + VALUES.astype(">i2").tobytes() + more + floats + b"\n", READ),
        Seed("c.vtk", head % b"ASCII" + numbers + more + b"1 2 3 " * 20, volume_reader(array="other")),
    ]


def vti() -> list[Seed]:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    image = vtkImageData()
    image.SetDimensions(5, 4, 3)
    image.SetSpacing(1, 2, 3)
    array = numpy_to_vtk(VALUES.ravel())
    array.SetName("values")
    image.GetPointData().SetScalars(array)
    seeds = []
    for name, mode, compressor in (
        ("a.vti", "Ascii", "None"),
        ("b.vti", "Binary", "ZLib"),
        ("c.vti", "Appended", "LZ4"),
        ("d.vti", "Appended", "None"),
        ("e.vti", "Appended", "ZLib"),
        ("f.vti", "Appended", "LZMA"),
    ):
        writer = vtkXMLImageDataWriter()
        writer.SetInputData(image)
        writer.WriteToOutputStringOn()
        getattr(writer, f"SetDataModeTo{mode}")()
        getattr(writer, f"SetCompressorTypeTo{compressor}")()
        writer.SetEncodeAppendedData(compressor == "LZ4")
        writer.Write()
        written = writer.GetOutputString()  # text where it is text, else bytes
        content = written.encode() if isinstance(written, str) else written
        seeds.append(Seed(name, content, READ))
        if mode == "Appended":
            seeds.append(Seed(name.replace(".", "2."), content, volume_reader(stored=True)))
    return seeds


def vdb() -> list[Seed]:
    with tarfile.open(FIXTURES / "vdb" / "grids.tar.xz") as archive:
        files = {n: archive.extractfile(f"./{n}.vdb").read() for n in ("version222", "version223", "tiles", "many")}  # type: ignore[union-attr]
    return [
        Seed("a.vdb", files["version222"], volume_reader(array="float")),
        Seed("b.vdb", files["version222"], volume_reader(array="bool")),
        Seed("c.vdb", files["version223"], volume_reader(component="magnitude")),
        Seed("d.vdb", files["tiles"], volume_reader(array="root")),
        Seed("e.vdb", files["tiles"], volume_reader(array="tiles")),
        Seed("f.vdb", files["many"], volume_reader(array="shared")),
        Seed("g.vdb", files["many"], volume_reader(array="mask")),
    ]


def numpy_files() -> list[Seed]:
    plain, several, packed, placed = (io.BytesIO() for _ in range(4))
    np.save(plain, VALUES)
    np.savez(several, first=VALUES, second=FLOATS)
    np.savez_compressed(packed, values=np.asfortranarray(FLOATS))
    np.savez(placed, values=FLOATS, x=np.arange(5.0), y=np.arange(4), zs=np.arange(3), positions=FLOATS[:, 0, :3])
    return [
        Seed("a.npy", plain.getvalue(), READ),
        Seed("b.npz", several.getvalue(), volume_reader(array="second")),
        Seed("c.npz", packed.getvalue(), READ),
        Seed("d.npz", placed.getvalue(), READ),
    ]


def transfer() -> list[Seed]:
    from test_look_formats import ITF, XML, mrml, vp, vp_json

    from vvgt_cli.look import read_transfer_function
    from vvgt_cli.look.readers.names import FILE as NAMED

    def read(path: Path) -> None:
        read_transfer_function(str(path)).node_range()

    preset = {
        "ColorSpace": "Diverging", "Name": "Preset", "NanColor": [1, 1, 0],
        "RGBPoints": [0, 0.2, 0.3, 0.8, 50, 0.9, 0.9, 0.9, 100, 0.7, 0, 0.1],
        "Points": [0, 0, 0.5, 0, 40, 0.1, 0.3, 0.2, 100, 1, 0.5, 0],
    }  # fmt: skip
    minimal = {
        "name": "two", "range": [0, 10], "color_space": "RGB", "opacity_unit_distance": 2,
        "points": [{"x": 0, "rgb": [0, 0, 0], "opacity": 0}, {"x": 1, "rgb": [1, 0.5, 0], "opacity": 0.75}],
    }  # fmt: skip
    return [
        Seed("a.json", json.dumps([preset]).encode(), read),
        Seed("b.json", json.dumps(minimal, indent=1).encode(), read),
        Seed("c.xml", XML.format(space="Lab").encode(), read),
        Seed("d.itf", ITF.format(lo=0, hi=0.9, type=0).encode(), read),
        Seed("e.vp", vp().encode(), read),
        Seed("f.vp.json", json.dumps(vp_json()).encode(), read),
        Seed("named.json", json.dumps(json.loads(NAMED.read_text())[0]["function"], indent=1).encode(), read),
        Seed("presets.xml", mrml().encode(), lambda path: read(Path(f"{path}#CT-AAA"))),
    ]


def colormaps() -> list[Seed]:
    from test_look_colormaps import CLUT, COLORS, NIIVUE, nih

    from vvgt_cli.look import read_transfer_function

    read = lambda path: read_transfer_function(str(path)).color(np.array([0.0, 0.5, 1.0, np.nan]))  # noqa: E731
    text = "\n".join(" ".join(map(str, row)) for row in COLORS.tolist())
    files = {"a.json": json.dumps(NIIVUE).encode(), "b.clut": CLUT.format(lo=0, hi=9).encode(), "c.lut": text.encode()}
    files |= {"d.lut": nih(COLORS[:9]), "e.lut": COLORS.T.tobytes()}
    return [Seed(name, content, read) for name, content in files.items()]


def label_tables() -> list[Seed]:
    from test_labels import CATEGORICAL, DECATHLON, FREESURFER, JSON, NAMES, NNUNET, SEGMENTS, SLICER, SNAP
    from test_look_tables import BIDS, FASTSURFER, ROWS, SLICER_CSV

    from vvgt_cli.look.label_files import read_labels

    read = lambda path: read_labels(str(path)).color(np.array([0.0, 1.0, 3.0, np.nan]))  # noqa: E731

    return [
        Seed("a.ctbl", SLICER.encode(), read),
        Seed("LUT.txt", FREESURFER.encode(), read),
        Seed("a.label", SNAP.encode(), read),
        Seed("a.json", JSON.encode(), read),
        Seed("a.seg.nrrd", SEGMENTS.encode() + bytes(8), read),
        Seed("b.txt", ROWS.format(a=255, b=128, c=0).encode(), read),
        Seed("a.csv", SLICER_CSV.encode(), read),
        Seed("b.csv", SLICER_CSV.replace("lung,", "lung").replace(",", ";").encode("utf-8-sig"), read),
        Seed("dseg.tsv", BIDS.encode(), read),
        Seed("f.tsv", FASTSURFER.encode(), read),
        *(Seed("b.json", json.dumps(one).encode(), read) for one in (NNUNET, DECATHLON, {"total": NAMES}, CATEGORICAL)),
    ]


def label_headers() -> list[Seed]:
    """Tables in the headers of label maps: whole files, and the tables alone."""
    import test_masks as made

    from vvgt_cli.look.label_files import labels_of
    from vvgt_cli.volume.medical.mgh import table_entries
    from vvgt_cli.volume.segments import segments_in, segments_of_xml

    def files(path: Path) -> list[Seed]:
        read = lambda path: labels_of(read_volume(str(path)).segments or (), "x")  # noqa: E731
        packed = {name: gzip.decompress(Path(make(path)).read_bytes()) for name, make in made.PACKED.items()}
        seeds = [Seed(name, data, read, pack=gzip.compress) for name, data in packed.items()]
        made.ome(path, place="a")
        store = {p.relative_to(path / "x.zarr" / "a").as_posix(): p for p in (path / "x.zarr" / "a").rglob("*")}
        inside = {name: p.read_bytes() for name, p in store.items() if p.is_file()}
        attributes = inside.pop(".zattrs")
        seeds.append(Seed(".zattrs", attributes, lambda path: read(path.parent), inside))
        return [*seeds, Seed("x.am", Path(made.am(path)).read_bytes(), read)]

    def alone(path: Path) -> None:
        data = path.read_bytes()
        parse = segments_of_xml if path.suffix == ".xml" else table_entries
        labels_of(segments_in(lambda: parse(data), "x"), "x")

    with tempfile.TemporaryDirectory() as folder:
        return [*files(Path(folder)), Seed("x.xml", made.CARET.encode(), alone), Seed("x.bin", made.TABLE[8:], alone)]


def cameras() -> list[Seed]:
    from vvgt_cli.cameras import default_views
    from vvgt_cli.cameras.files import blender_json, read_frames, transforms_json

    views = default_views("check", size=40)
    return [
        Seed("a.json", transforms_json(views).encode(), read_frames),
        Seed("b.json", blender_json(views, [f"./{v.name}" for v in views]).encode(), lambda p: read_frames(p, 40)),
    ]


def model_card() -> list[Seed]:
    from onnx_models import write_model

    from vvgt_cli.network.runtime import Model

    with tempfile.TemporaryDirectory() as folder:
        files = {path.name: path.read_bytes() for path in write_model(Path(folder) / "tiny").iterdir()}
    card = files.pop("card.json")
    return [Seed("card.json", card, lambda path: Model.open(path.parent, threads=1), files)]


def checkpoint() -> list[Seed]:
    from test_optimize_checkpoint import CAMERAS, cloud

    from vvgt_cli.refine import OptimizeOptions, OptimizeRecord
    from vvgt_cli.refine.checkpoint import Checks, resume, save
    from vvgt_cli.refine.loop import begin

    def fresh(method: str) -> tuple[Any, Checks, OptimizeRecord]:
        record, state = OptimizeRecord(), begin(cloud(8), CAMERAS, OptimizeOptions.of(method, max_gaussians=16))
        return state, Checks(state, None, record), record

    seeds = []
    for method in ("axes", "3dgs"):
        state, judge, record = fresh(method)
        judge.kept = {name: array for name, array in state.saved().items() if name.startswith("array_")}
        with tempfile.TemporaryDirectory() as folder:
            save(f"{folder}/run.npz", "key", state, judge, record, {"step": 3})
            data = Path(f"{folder}/run.npz").read_bytes()
        seeds.append(Seed("run.npz", data, lambda path, method=method: resume(str(path), "key", *fresh(method))))
    return seeds


def manifest() -> list[Seed]:
    from vvgt_cli.conversion.manifest import Manifest, read_run_manifest

    document = {
        "format": "vvgt-views", "schema": 1, "hash": "ab" * 32, "settings": {"size": 40, "half": False},
        "files": {"train/a.png": {"bytes": 10, "sha256": "cd" * 32}},
    }  # fmt: skip

    def read(path: Path) -> None:
        read_run_manifest(path)
        Manifest(path.parent, {"size": 40}).refresh()

    return [Seed("manifest.json", json.dumps(document).encode(), read)]


def readers() -> dict[str, list[Seed]]:
    """Seeds by reader."""
    from fuzz_seeds_hospital import hospital
    from fuzz_seeds_scans import scans

    return {
        "raw": raw(), "NRRD": nrrd(), "MetaImage": metaimage(), "Inviwo": inviwo(), "VGStudio": vgi(), **scans(),
        **hospital(),
        "SLC": slc(), "TIFF": tiff(), "VTK legacy": vtk_legacy(), "VTK XML": vti(), "OpenVDB": vdb(),
        "NumPy": numpy_files(), "transfer function": transfer(), "colour map": colormaps(),
        "label table": label_tables(), "label header": label_headers(), "Gaussians": ply(),
        "Gaussians of others": others(), "SOG": sog(),
        "view set": cameras(), "model card": model_card(), "manifest of views": manifest(),
        "checkpoint": checkpoint(),
    }  # fmt: skip
