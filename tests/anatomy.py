"""Volumes at known places: three balls and an F, on grids of any orientation, written in formats that have one."""

from pathlib import Path

import nibabel as nib
import numpy as np
import SimpleITK as sitk
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

DIMS = (22, 18, 15)  # x, y, z
ZOOMS = (1.5, 2.0, 2.5)
TO_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
TF = (
    '{"points": [{"x": 0, "rgb": [1, 0, 0], "opacity": 0}, {"x": 900, "rgb": [1, 0, 0], "opacity": 0.5}],'
    '"opacity_unit_distance": 2}'
)


def turned(a: float, b: float, c: float) -> np.ndarray:
    """(3, 3) rotation about x, then y, then z."""
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]]) @ ry @ rx


def place(axes: np.ndarray, middle: tuple[float, ...] = (12.0, -34.0, 56.0)) -> np.ndarray:
    """Affine of a grid of `DIMS` voxels with these axes (columns, times `ZOOMS`) about a middle; float32 values."""
    affine = np.eye(4)
    affine[:3, :3] = axes * ZOOMS
    affine[:3, 3] = np.array(middle) - affine[:3, :3] @ (np.array(DIMS) - 1) / 2
    return affine.astype(np.float32).astype(np.float64)


AXIAL = np.eye(3)
SAGITTAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # i to posterior, j to inferior, k to right
CORONAL = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])  # i to left, j to superior, k to anterior
OBLIQUE = turned(0.3, -0.45, 0.8)
RIGHT_HANDED = {"axial": AXIAL, "sagittal": SAGITTAL, "coronal": CORONAL, "oblique": OBLIQUE}
LEFT_HANDED = {"left": AXIAL * (-1, 1, 1), "sagittal left": SAGITTAL * (1, 1, -1), "oblique left": OBLIQUE * (1, -1, 1)}
GRIDS = RIGHT_HANDED | LEFT_HANDED


def world_grid(affine: np.ndarray) -> np.ndarray:
    """(nz, ny, nx, 3) world positions of the voxel centres."""
    k, j, i = np.mgrid[: DIMS[2], : DIMS[1], : DIMS[0]]
    return np.stack([i, j, k], -1) @ affine[:3, :3].T + affine[:3, 3]


CENTRES = np.array([[6.0, -38.0, 50.0], [16.0, -30.0, 52.0], [9.0, -35.0, 62.0]])  # of the balls, RAS mm
RADIUS = 4.0


def balls(affine: np.ndarray) -> np.ndarray:
    """(nz, ny, nx) int16: three balls with soft edges, at `CENTRES` of the world."""
    away = np.linalg.norm(world_grid(affine)[..., None, :] - CENTRES, axis=-1).min(axis=-1)
    return np.round(900 * np.clip((RADIUS + 1.5 - away) / 3, 0, 1)).astype("<i2")


LETTER = np.array([[1, 1, 1, 1], [1, 0, 0, 0], [1, 1, 1, 0], [1, 0, 0, 0], [1, 0, 0, 0]])  # rows from the top: an F


def letter(affine: np.ndarray, middle: tuple[float, ...] = (12.0, -34.0, 56.0)) -> np.ndarray:
    """(nz, ny, nx) int16: an F that reads right from the front (from anterior), head up; 16 x 20 mm, 8 mm deep."""
    x, y, z = np.moveaxis(world_grid(affine) - middle, -1, 0)
    column = np.floor((8 - x) / 4).astype(int)  # a patient's left is on the right of who faces him
    row = np.floor((10 - z) / 4).astype(int)
    inside = (column >= 0) & (column < 4) & (row >= 0) & (row < 5) & (np.abs(y) < 4)
    return np.where(inside, 900 * LETTER[row.clip(0, 4), column.clip(0, 3)], 0).astype("<i2")


def nifti(path: Path, data: np.ndarray, affine: np.ndarray, form: str = "sform") -> Path:
    """Written by nibabel with one of the two forms."""
    image = nib.Nifti1Image(np.ascontiguousarray(data.transpose(2, 1, 0)), None)
    image.header.set_zooms(np.linalg.norm(affine[:3, :3], axis=0))
    getattr(image, f"set_{form}")(affine, code=1)
    image.set_sform(affine if form == "sform" else None, code=int(form == "sform"))
    image.to_filename(path.with_suffix(".nii"))
    return path.with_suffix(".nii")


def itk(path: Path, data: np.ndarray, affine: np.ndarray) -> Path:
    """Written by SimpleITK, in the format that the suffix says."""
    lps = TO_LPS @ affine
    lengths = np.linalg.norm(lps[:3, :3], axis=0)
    image = sitk.GetImageFromArray(data)
    image.SetSpacing(lengths.tolist())
    image.SetDirection((lps[:3, :3] / lengths).ravel().tolist())
    image.SetOrigin(lps[:3, 3].tolist())
    sitk.WriteImage(image, str(path))
    return path


def nrrd(path: Path, data: np.ndarray, affine: np.ndarray, space: str) -> Path:
    """Written by hand in right-, left- or nothing-anterior-superior coordinates."""
    signs = {"right-anterior-superior": (1, 1, 1), "left-posterior-superior": (-1, -1, 1), "LAS": (-1, 1, 1)}
    signs |= {"3D-left-handed": (1, 1, -1), "3D-right-handed": (1, 1, 1)}
    own = np.diag(signs[space]) @ affine[:3]
    vectors = " ".join("({})".format(",".join(map(repr, column))) for column in own[:, :3].T.tolist())
    origin = "({})".format(",".join(map(repr, own[:, 3].tolist())))
    header = (
        f"NRRD0005\ntype: short\ndimension: 3\nspace: {space}\nsizes: {' '.join(map(str, data.shape[::-1]))}\n"
        f"space directions: {vectors}\nspace origin: {origin}\nendian: little\nencoding: raw\n\n"
    )
    path.write_bytes(header.encode() + data.tobytes())
    return path


def vti(path: Path, data: np.ndarray, affine: np.ndarray) -> Path:
    """Written by VTK with Direction and Origin."""
    lengths = np.linalg.norm(affine[:3, :3], axis=0)
    image = vtkImageData()
    image.SetDimensions(*data.shape[::-1])
    image.SetSpacing(*lengths)
    image.SetOrigin(*affine[:3, 3])
    image.SetDirectionMatrix(*(affine[:3, :3] / lengths).ravel())
    array = numpy_to_vtk(data.ravel(), deep=True)
    array.SetName("values")
    image.GetPointData().SetScalars(array)
    writer = vtkXMLImageDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(image)
    writer.Write()
    return path


def dicom(folder: Path, data: np.ndarray, affine: np.ndarray) -> Path:
    """A series of slices along the third axis, in files whose names say nothing of their order."""
    folder.mkdir()
    lps = TO_LPS @ affine
    lengths = np.linalg.norm(lps[:3, :3], axis=0)
    series = generate_uid()
    for k, plane in enumerate(data):
        file = Dataset()
        file.file_meta = FileMetaDataset()
        file.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        file.file_meta.MediaStorageSOPClassUID = file.SOPClassUID = CTImageStorage
        file.file_meta.MediaStorageSOPInstanceUID = file.SOPInstanceUID = generate_uid()
        file.Rows, file.Columns, file.SamplesPerPixel, file.PhotometricInterpretation = *plane.shape, 1, "MONOCHROME2"
        file.BitsAllocated, file.BitsStored, file.HighBit, file.PixelRepresentation = 16, 16, 15, 1
        file.SeriesInstanceUID, file.SeriesNumber, file.Modality, file.SliceThickness = series, 1, "CT", 1
        file.ImageOrientationPatient = [f"{v:.12g}"[:16] for v in (lps[:3, :2] / lengths[:2]).T.ravel()]
        file.ImagePositionPatient = [f"{v:.12g}"[:16] for v in lps[:3, :3] @ (0, 0, k) + lps[:3, 3]]
        file.PixelSpacing = [f"{v:.12g}"[:16] for v in lengths[1::-1]]
        file.RescaleSlope, file.RescaleIntercept = 1, 0
        file.PixelData = plane.tobytes()
        file.save_as(folder / f"{(k * 7) % len(data):02d}.dcm", enforce_file_format=True)
    return folder
