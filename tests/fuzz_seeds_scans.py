"""Seeds of tests/fuzz.py: formats of neuroimaging, density maps and molecules."""

import bz2
import gzip
import io
import tempfile
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from fuzz import Seed
from fuzz_seeds import FLOATS, READ, VALUES, volume_reader


def nifti() -> list[Seed]:
    import nibabel as nib

    affine = np.diag([1.0, 2, 3, 1])
    first = nib.Nifti1Image(VALUES.T, affine)
    first.header.set_slope_inter(2, 1)
    second = nib.Nifti2Image(np.stack([FLOATS.T] * 2, axis=3), affine)
    pair = nib.Nifti1Pair(VALUES.T, affine)
    maps = pair.make_file_map({"header": io.BytesIO(), "image": io.BytesIO()})
    pair.to_file_map(maps)
    header, image = (maps[k].fileobj.getvalue() for k in ("header", "image"))
    return [
        Seed("a.nii", first.to_bytes(), READ),
        Seed("b.nii.gz", first.to_bytes(), READ, pack=gzip.compress),
        Seed("c.nii", second.to_bytes(), volume_reader(component=1)),
        Seed("d.hdr", header, READ, {"d.img": image}),
    ]


def analyze() -> list[Seed]:
    import nibabel as nib

    image = nib.Spm2AnalyzeImage(VALUES.T, None)
    image.header.set_slope_inter(2, 0)
    maps = image.make_file_map({"header": io.BytesIO(), "image": io.BytesIO()})
    image.to_file_map(maps)
    header, values = (maps[k].fileobj.getvalue() for k in ("header", "image"))
    return [Seed("a.hdr", header, READ, {"a.img": values}), Seed("b.img", values, READ, {"b.hdr": header})]


def mgh() -> list[Seed]:
    import nibabel as nib

    one, two = (nib.MGHImage(data, np.diag([1, 2, 3, 1])) for data in (VALUES.T, np.stack([FLOATS.T] * 2, axis=3)))
    return [
        Seed("a.mgh", one.to_bytes(), READ),
        Seed("b.mgz", one.to_bytes(), READ, pack=gzip.compress),
        Seed("c.mgh", two.to_bytes(), volume_reader(time=1)),
    ]


def mrc() -> list[Seed]:
    import mrcfile

    def content(values: np.ndarray, **words: Any) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            with mrcfile.new(f"{folder}/v.mrc", values) as file:
                file.voxel_size = 1.5
                for name, value in words.items():
                    setattr(file.header, name, value)
            return Path(f"{folder}/v.mrc").read_bytes()

    skewed = content(FLOATS, mapc=3, mapr=1, maps=2, cellb=(70, 80, 110), nxstart=3)
    return [
        Seed("a.mrc", content(VALUES), READ),
        Seed("b.map", skewed, READ),
        Seed("c.map.gz", skewed, READ, pack=gzip.compress),
        Seed("d.mrc.bz2", content(VALUES.astype(np.int8)), READ, pack=bz2.compress),
        Seed("e.mrc", content(np.stack([FLOATS] * 2)), volume_reader(time=1)),
    ]


def minc() -> list[Seed]:
    import nibabel

    folder = Path(nibabel.__file__).parent / "tests" / "data"
    names: tuple[tuple[str, Any], ...] = (("minc1_1_scale.mnc", READ), ("minc1_4d.mnc", volume_reader(time=1)))
    names += (("minc2_1_scale.mnc", READ), ("minc2_4d.mnc", volume_reader(time=1, stored=True)))
    return [Seed(name, (folder / name).read_bytes(), read) for name, read in names]


def text_grids() -> list[Seed]:
    from test_volume_maps import ATOMS, CUBE, DX, END, GRID, text

    cube = CUBE.format(atoms=2, nval="", n=[3, 4, 5]) + ATOMS + text(GRID[..., 0])
    orbitals = CUBE.format(atoms=-2, nval="", n=[3, 4, 5]) + ATOMS + " 2 21\n22\n" + text(GRID)
    binary = DX.format(kind="float", form="lsb ").encode() + GRID[..., 0].tobytes() + END.encode()
    return [
        Seed("a.cube", cube.encode(), READ),
        Seed("b.cube", orbitals.encode(), volume_reader(component=1)),
        Seed("c.dx", (DX.format(kind="double", form="") + text(GRID[..., 0]) + END).encode(), READ),
        Seed("d.dx", binary, READ),
    ]


def vasp() -> list[Seed]:
    from test_volume_vasp import chgcar

    values = np.arange(24, dtype=float).reshape(4, 3, 2)
    return [
        Seed("CHGCAR", chgcar([values]).encode(), READ),
        Seed("CHGCAR_spin", chgcar([values, -values], scale="-30").encode(), volume_reader(component=1)),
        Seed("LOCPOT", chgcar([values], elements="").encode(), READ),
    ]


def amira_files() -> list[Seed]:
    from test_volume_amira import BOX, amira, run_lengths

    data, moved = VALUES.tobytes(), f"TransformationMatrix 0 1 0 0 -1 0 0 0 0 0 1 0 100 0 7 1\n{BOX}"
    little, chosen = "AmiraMesh BINARY-LITTLE-ENDIAN 2.1", volume_reader(array="V")
    text = " ".join(map(str, VALUES.ravel())).encode()
    return [
        Seed("a.am", amira(little, [("byte M", "", bytes(60)), ("short V", "", data)]), chosen),
        Seed("b.am", amira(little, [("short V", "HxZip", zlib.compress(data))], moved), READ),
        Seed("c.am", amira("Avizo BINARY 2.1", [("short V", "HxByteRLE", run_lengths(data))]), READ),
        Seed(
            "d.am",
            amira("AmiraMesh 3D ASCII 2.0", [("short[2] V", "", text + b" " + text)]),
            volume_reader(component=1),
        ),
    ]


def pairs() -> dict[str, list[Seed]]:
    """AFNI's and Philips' pairs, by the headers that come with nibabel."""
    from test_volume_nibabel import head_of, par_of

    par, rec = par_of("variant_v4_2_header.PAR"), np.arange(27 * 64, dtype="<u2").tobytes()
    head, brik = head_of("scaled+tlrc.HEAD", "47 54 43", "5 4 3"), VALUES.astype("<i2").tobytes()
    times = head_of("example4d+orig.HEAD", "33 41 25", "5 4 3")
    return {
        "Philips PAR/REC": [
            Seed("a.PAR", par, volume_reader(time=1), {"a.REC": rec}),
            Seed("b.REC", rec, volume_reader(time=0, stored=True), {"b.PAR": par}),
        ],
        "AFNI": [
            Seed("a+tlrc.HEAD", head, READ, {"a+tlrc.BRIK": brik}),
            Seed("b+orig.HEAD", times, volume_reader(time=2, stored=True), {"b+orig.BRIK": brik * 3}),
            Seed("c+tlrc.BRIK.gz", brik, READ, {"c+tlrc.HEAD": head}, pack=gzip.compress),
        ],
    }


def zipped_zarr() -> list[Seed]:
    from test_volume_zarr_zip import zipped

    read = volume_reader(time=1)
    with tempfile.TemporaryDirectory() as folder:
        names = [zipped(Path(folder) / str(v), v, "v.zarr.zip", "", packed=v == 3) for v in (2, 3)]
        return [Seed(f"{k}.zarr.zip", Path(name).read_bytes(), read) for k, name in enumerate(names)]


def pictures() -> list[Seed]:
    """PNG, BMP and JPEG, alone and as a slice between two others, and a log beside slices."""
    from PIL import Image
    from test_volume_pictures import NIKON, skyscan

    def content(image: Any, kind: str) -> bytes:
        out = io.BytesIO()
        image.save(out, kind)
        return out.getvalue()

    def folder(path: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            READ(path.parent)
            volume_reader(stored=True)(path.parent)

    planes = VALUES.astype(np.uint8)
    grey = [content(Image.fromarray(plane), "png") for plane in planes]
    palette = Image.fromarray(planes[1]).convert("P")
    beside = {"x1.png": grey[0], "x3.png": grey[2]}
    return [
        Seed("a.png", grey[0], READ),
        Seed("b.png", content(Image.fromarray(VALUES[0].astype(np.uint16)), "png"), READ),
        Seed("c.png", content(Image.fromarray(np.dstack([*planes])), "png"), volume_reader(component=1)),
        Seed("d.bmp", content(palette, "bmp"), READ),
        Seed("e.jpg", content(Image.fromarray(planes[1]), "jpeg"), READ),
        Seed("x2.png", grey[1], folder, beside),
        Seed("x.log", skyscan(width=5).replace("Height (pixels)=5", "Height (pixels)=4").encode(), folder, beside),
        Seed("x.xtekct", NIKON.replace("X=7", "X=5").replace("Y=5", "Y=4").encode(), folder, beside),
    ]


def scans() -> dict[str, list[Seed]]:
    """Seeds by reader."""
    return {
        "NIfTI": nifti(), "Analyze": analyze(), "MGH": mgh(), "MRC": mrc(), "cube and OpenDX": text_grids(),
        "VASP": vasp(), "AmiraMesh": amira_files(), **pairs(), "zipped Zarr": zipped_zarr(), "MINC": minc(),
        "pictures": pictures(),
    }  # fmt: skip
