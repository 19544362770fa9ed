"""Seeds of tests/fuzz.py: DICOM, and conventions on top of HDF5 and Zarr."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
from fuzz import Seed
from fuzz_seeds import READ, VALUES, volume_reader
from pydicom.dataset import Dataset
from pydicom.uid import ImplicitVRLittleEndian


def in_folder(**options: object):
    """Read the folder of a file."""
    read = volume_reader(**options)
    return lambda path: read(path.parent)


def dicom() -> list[Seed]:
    from tests.test_volume_hospital import STACK, image, mosaic, nuclear

    def content(file: Dataset, preamble: bool = True) -> bytes:
        stream = io.BytesIO()
        if preamble:
            file.save_as(stream, enforce_file_format=True)
        else:
            bare = Dataset()
            bare.update({e.tag: e for e in file})
            bare.save_as(stream, implicit_vr=True, little_endian=True)
        return stream.getvalue()

    table = Dataset()
    table.LUTDescriptor, table.ModalityLUTType = [200, 0, 16], "US"
    table.add_new("LUTData", "OW", np.arange(200).astype("<u2").tobytes())
    twice = [image(STACK[k % 4], (0, 0, 2 * (k % 4)), InstanceNumber=k, EchoTime=5.0 * (k // 4)) for k in range(8)]
    beside = {f"{k}.dcm": content(file) for k, file in enumerate(twice) if k}
    bare = image(STACK[0], (0, 0, 0))
    bare.file_meta.TransferSyntaxUID = ImplicitVRLittleEndian
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, one in beside.items():
            archive.writestr(name, one)
    return [
        Seed("a.dcm", content(mosaic(4, 1.0)), READ),
        Seed("b", content(bare, preamble=False), READ),
        Seed("c.dcm", content(nuclear(8, SliceVector=[1, 2, 3, 4] * 2, TimeSlotVector=[1] * 4 + [2] * 4)),
             volume_reader(time=1)),
        Seed("d.dcm", content(image(STACK[0], (0, 0, 0), ModalityLUTSequence=[table], PixelRepresentation=0)), READ),
        Seed("e/0.dcm", content(twice[0]), in_folder(time=1), {f"e/{name}": one for name, one in beside.items()}),
        Seed("f.zip", packed.getvalue(), volume_reader(array="EchoTime 5 ms")),
    ]  # fmt: skip


def hdf5_conventions() -> list[Seed]:
    import tempfile

    import h5py

    from tests.test_volume_geometry import openpmd

    with tempfile.TemporaryDirectory() as folder:
        mesh = Path(openpmd(Path(folder) / "a.h5")).read_bytes()
        with h5py.File(f"{folder}/b.h5", "w") as file:
            group = file.create_group("entry")
            group.attrs.update({"NX_class": "NXdata", "axes": ["z", "y", "x"]})
            group["v"] = VALUES
            for name, n in zip("zyx", VALUES.shape, strict=True):
                group[name] = 0.5 * np.arange(n)
        nexus = Path(f"{folder}/b.h5").read_bytes()
    return [Seed("a.h5", mesh, READ), Seed("b.h5", nexus, READ)]


def ome_zarr() -> list[Seed]:
    attributes = {"multiscales": [{"version": "0.2", "datasets": [{"path": "0"}]}]}
    array = {
        "zarr_format": 2, "shape": [2, 1, *VALUES.shape], "chunks": [1, 1, *VALUES.shape], "dtype": "<i2",
        "compressor": None, "fill_value": 0, "order": "C", "filters": None, "dimension_separator": ".",
    }  # fmt: skip
    files = {
        "v.zarr/.zgroup": b'{"zarr_format": 2}', "v.zarr/0/.zarray": json.dumps(array).encode(),
        "v.zarr/0/0.0.0.0.0": VALUES.tobytes(), "v.zarr/0/1.0.0.0.0": VALUES.tobytes(),
    }  # fmt: skip
    return [Seed("v.zarr/.zattrs", json.dumps(attributes).encode(), in_folder(time=1), files)]


def vtkjs() -> list[Seed]:
    import tempfile

    from tests.test_volume_vtkjs import write

    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "v")
        files = {f"v/{p.relative_to(f'{folder}/v')}": p.read_bytes() for p in Path(folder).rglob("*") if p.is_file()}
    return [Seed("v/index.json", files.pop("v/index.json"), in_folder(array="v"), files)]


def hospital() -> dict[str, list[Seed]]:
    """Seeds by reader."""
    return {"DICOM": dicom(), "HDF5 conventions": hdf5_conventions(), "OME-Zarr": ome_zarr(), "vtk.js": vtkjs()}
