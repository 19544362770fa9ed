"""Reading by the table of `readers`: formats are found by content first, then by name."""

from __future__ import annotations

import os
import re
import warnings
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from vvgt_cli.errors import DataError, SeveralSteps, UsageError, VvgtError
from vvgt_cli.files import seekable
from vvgt_cli.volume.blocks import read_head
from vvgt_cli.volume.bodies import without_other_bodies
from vvgt_cli.volume.components import listed
from vvgt_cli.volume.headers import MARK
from vvgt_cli.volume.libraries import library_errors
from vvgt_cli.volume.medical import MASKS
from vvgt_cli.volume.options import ReadOptions, crop, masked, parse_crop
from vvgt_cli.volume.plain import RAW
from vvgt_cli.volume.plain.raw import parse_name, read_stdin
from vvgt_cli.volume.readers import HEAD_BYTES, READERS, SCHEMES, STEPPED, Reader, is_glob, register_plugins
from vvgt_cli.volume.space import in_space, laid
from vvgt_cli.volume.tiff import SLICES
from vvgt_cli.volume.types import Volume

LOOKED_AT = 2000  # files of a folder
LISTED = "NIfTI, NRRD, DICOM, TIFF, VTK, HDF5 or another format of docs/formats.md"
MAX_LEVELS = 64  # resolutions of a file
PREVIEWS = 10  # pictures for each volume beside them, up to which they do not make a folder one of slices


def read_volume(source: str, options: ReadOptions | None = None) -> Volume:
    """Read a volume from a file, from standard input (``-``, raw bytes) or from a registered scheme.

    The ``source`` is a path, ``PATH:/inner/path`` for formats that hold several arrays, ``-`` or ``scheme:rest``.

    Returns:
        The volume, cropped and masked; memory-mapped where the format stores plain values. Where its file states an
        anatomical space, it is in the one that the options name, else in RAS.

    Raises:
        DataError: no such file, an unknown format, a damaged file, sizes that do not fit.
        UsageError: options that the format does not take, or a choice (array, component, dims) that is missing.
    """
    options = options or ReadOptions()
    if options.time is not None and (source == "-" or source.partition(":")[0] in SCHEMES.keys() - STEPPED):
        raise UsageError(f"{source}: one volume, no time steps; leave out --time {options.time}")
    if (options.crop, options.mask, options.keep_largest) != (None, None, None):
        options = replace(options, packed=False)
    volume = _read(source, options)
    if options.suv is not None and volume.modality != "PT":
        what = f"no PET, but {volume.modality}" if volume.modality else "no DICOM PET"
        raise UsageError(f"{source}: {what}; leave out --suv {options.suv}")
    return cut(in_space(volume, options.space), options)


def cut(volume: Volume, options: ReadOptions) -> Volume:
    """Apply the options' crop, mask and largest body to a volume.

    Raises:
        DataError: a mask of another size or place.
        UsageError: a crop outside of the volume.
    """
    box = None if options.crop is None else parse_crop(options.crop)
    how = ReadOptions(stored=options.stored)
    mask = read_volume(options.mask, how) if isinstance(options.mask, str) else options.mask
    turned = None if mask is None else laid(mask, volume)
    placed, mask = turned is not None, turned or mask
    if mask is not None and box is not None and mask.dims == volume.dims:
        mask = crop(mask, box)
    volume = volume if box is None else crop(volume, box)
    if mask is not None and placed and mask.dims == volume.dims:
        if options.spacing is not None:  # which is both volumes'
            mask = replace(mask, spacing=volume.spacing, origin=volume.origin)
        mask.check_grid(f"--mask {mask.name}", volume, volume.name, "resample it onto that grid, or mend its header")
    volume = volume if mask is None else masked(volume, mask, options.stored)
    if options.keep_largest is None:
        return volume
    return masked(volume, without_other_bodies(volume, options.keep_largest), options.stored)


def _read(source: str, options: ReadOptions) -> Volume:
    """Read a volume in its format's own space."""
    if source == "-":
        return read_stdin(options)
    scheme, colon, rest = source.partition(":")
    if colon and scheme in SCHEMES:
        with library_errors(source, "a volume"):
            return SCHEMES[scheme](rest, options)
    path, options = _inner(source, options)
    if (kept := seekable(path)) != path:
        return _from_pipe(kept, path, source, options)
    with library_errors(source, "slices"):
        slices = _slices(source, options)
    if slices is not None:
        return slices
    reader = _folder(path, source) if os.path.isdir(path) else _find(path, _head(path, source), options)
    _check_options(reader, source, options)
    with library_errors(source, reader.name):
        return reader.read(path, options)


def _from_pipe(kept: Path, path: Path, source: str, options: ReadOptions) -> Volume:
    """Read the volume that came through the pipe ``path`` and was saved in ``kept``."""
    try:
        return replace(_read(str(kept), options), name=path.name)
    except VvgtError as error:
        error.args = (re.sub(rf"(?:{kept}|^{kept.name})(?=: )", lambda _: source, str(error)),)
        raise


def time_steps(source: str, options: ReadOptions) -> list[tuple[float, str] | None]:
    """List time and unit of each step where ``options`` choose none, None without times; errors are `read_volume`'s."""
    try:
        volume = read_volume(source, options)
    except SeveralSteps as error:
        if not error.times:
            return [None] * error.steps
        return [(float(time), error.unit) for time in error.times]
    return [volume.time]


def contents(source: str, options: ReadOptions) -> dict[str, Any]:
    """List a file's steps, arrays and blocks with the option of each, for some formats only, or raise DataError."""
    path, options = _inner(source, options)
    if not os.path.isfile(path):
        return {}
    reader = _find(path, _head(path, source), options)
    return {} if reader.contents is None else reader.contents(path, options)


def level_shapes(source: str, options: ReadOptions) -> list[tuple[int, ...]]:
    """List the shapes (z, y, x) of a source's resolutions, finest first; none where there are none, or none is read."""
    path, shapes = Path(source), list[tuple[int, ...]]()
    if source.partition(":")[0] not in STEPPED:
        path, options = _inner(source, options)
        source = str(path)
        holding = (r for r in READERS if r.levels and r.holds is not None and r.holds(path))
        reader = next(holding, None) if path.is_dir() else None
        if path.is_file():
            reader = _find(path, _head(path, source), options)
        if reader is None or not reader.levels:
            return []
    first = ReadOptions(array=options.array, component=0, time=options.time or 0, spacing=options.spacing, stored=True)
    with suppress(VvgtError), warnings.catch_warnings():  # said where it is read
        warnings.simplefilter("ignore")
        while len(shapes) < MAX_LEVELS:
            shapes.append(read_volume(source, replace(first, level=len(shapes))).data.shape)
    return shapes


def _inner(source: str, options: ReadOptions) -> tuple[Path, ReadOptions]:
    """Split ``PATH:/inner/path`` into the path, and the options with the inner path as their array."""
    head, _, inner = source.rpartition(":/")
    if not head or os.path.exists(source) or not os.path.exists(head):
        return Path(source), options
    if options.array is not None:
        raise UsageError(f"{source}: --array {options.array} and :/{inner} choose both; leave out one")
    return Path(head), replace(options, array="/" + inner)


def _slices(source: str, options: ReadOptions) -> Volume | None:
    """Read a glob of slices or masks; None where the source is none."""
    if not is_glob(source):
        return None
    if MASKS.holds is not None and MASKS.holds(Path(source)):
        return MASKS.read(Path(source), options)
    from vvgt_cli.volume.tiff.slices import read_glob

    volume = read_glob(source, options)
    if volume is not None:
        _check_options(SLICES, source, options)
    return volume


def _folder(path: Path, source: str) -> Reader:
    """Find the reader of a folder; none where more of its files are volumes of other formats."""
    lying = _volumes_in(path)
    for reader in READERS:
        if reader.holds is not None and reader.holds(path):
            mine = (reader.name, *reader.within)
            own = sum(len(lying.get(kind, [])) / (PREVIEWS if kind == "picture" else 1) for kind in mine)
            others = sum(len(names) for kind, names in lying.items() if kind not in (*mine, "picture"))
            if reader.whole or own >= others:
                return reader
    if register_plugins():
        return _folder(path, source)
    if lying:
        listing = "; ".join(f"{len(names)} {kind} ({listed(names, ', ', 3)})" for kind, names in lying.items())
        raise DataError(f"{source}: a folder; expected one volume, found {listing}: give one of the files")
    kinds = ", ".join(reader.name for reader in READERS if reader.holds is not None)
    raise DataError(f"{source}: a folder; expected a volume file ({LISTED}) or a folder of {kinds}")


def _volumes_in(path: Path) -> dict[str, list[str]]:
    """Group the volume files in a folder (not in its folders) by format, known by their names or else their content."""
    files: dict[str, list[str]] = {}
    for name in sorted(entry.name for entry in islice(os.scandir(path), LOOKED_AT) if entry.is_file()):
        reader = _by_name(path / name)
        if reader is None:
            try:
                with open(path / name, "rb") as file:
                    head = file.read(HEAD_BYTES)
            except OSError:
                continue
            reader = next((r for r in READERS if r.holds is not None and head and r.sniff and r.sniff(head)), None)
        if reader is not None:
            files.setdefault(reader.name, []).append(name)
    return files


def _head(path: Path, source: str) -> bytes:
    """Read the first bytes of a file; raise `DataError` where there are none."""
    try:
        with open(path, "rb") as file:
            head = file.read(HEAD_BYTES)
    except FileNotFoundError:
        hint = "" if ":" not in source else f" (schemes: {', '.join(s + ':' for s in SCHEMES)})"
        hint = " (it is a link to a file that is not there; of git-annex: git annex get)" if path.is_symlink() else hint
        raise DataError(f"{source}: no such file; expected a volume file, - or example:NAME{hint}") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{source}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    named = _by_name(path)
    if not head and not (named and named.nameable):
        raise DataError(f"{source}: the file is empty; expected a volume")
    return head.removeprefix(MARK)


def _recognised(path: Path, head: bytes) -> tuple[Reader | None, bytes]:
    """Find the first reader that recognises a file's content; return it and the first bytes, unpacked from gzip."""
    if head[:2] == b"\x1f\x8b":
        try:
            head, _ = read_head(path, HEAD_BYTES)
        except DataError:
            return None, head
    return next((r for r in READERS if r.sniff is not None and r.sniff(head)), None), head


def is_recognised(head: bytes) -> bool:
    """Tell whether a file that begins so has the format of some reader."""
    return any(reader.sniff is not None and reader.sniff(head) for reader in READERS)


def _by_name(path: Path) -> Reader | None:
    name = path.name.lower()
    fits = [(len(s), r) for r in READERS for s in r.suffixes if name.endswith(s)]
    return max(fits, key=lambda fit: fit[0])[1] if fits else None


def _find(path: Path, head: bytes, options: ReadOptions) -> Reader:
    """Find the reader of a file, or raise `DataError` with what else to do with it."""
    named = _by_name(path)
    reader, inner = _recognised(path, head)
    if reader is not None and named is not None and reader.name in named.within:
        reader = named
    raw_layout = options.dtype or parse_name(path.name) or (options.dims and not (reader and reader.resamples))
    if reader is not None and reader is not named and raw_layout:
        return RAW  # a raw volume may begin with any bytes; where its layout is stated, believe that
    if reader is not None:
        if inner != head and not any(suffix.endswith("gz") for suffix in reader.suffixes):
            raise DataError(f"{path}: a gzip-compressed {reader.name} file; unpack it first (gunzip)")
        return reader
    if options.dims and (options.dtype or named is None or not named.resamples):
        return RAW
    by_name = named is not None and (named.by_name or named.nameable)
    if not by_name and register_plugins():
        return _find(path, head, options)
    if known := way_out(path, inner, by_name=named is None):
        raise DataError(f"{path}: {known}")
    if named is not None and by_name:
        return named
    if named is not None:
        raise DataError(
            f"{path}: named like a {named.name} file, but its content is of no known format; expected a whole "
            f"{named.name} file, or raw values with --dims X Y Z --dtype TYPE"
        )
    raise DataError(f"{path}: of no known format; expected {LISTED}, or raw values with --dims X Y Z --dtype TYPE")


def _check_options(reader: Reader, source: str, options: ReadOptions) -> None:
    needless = [flag for flag in options.raw_flags if flag.strip("-").replace("-", "_") not in reader.takes]
    if needless:
        raise UsageError(
            f"{source}: {reader.name}, which states its own layout; leave out {' '.join(needless)} (--spacing is "
            "taken; to read its bytes as raw values, pipe them in, with - as the source)"
        )
    if options.time is not None and "time" not in reader.takes:
        raise UsageError(
            f"{source}: a {reader.name} file, which has no known time steps; leave out --time {options.time} (along a "
            "fourth axis of any kind --component N chooses)"
        )
    if options.array is not None and "array" not in reader.takes:
        raise UsageError(
            f"{source}: a {reader.name} file, which has one array without a name; leave out --array {options.array}"
        )


_MAT = (
    "in Python: numpy.save('{stem}.npy', scipy.io.loadmat('{name}')['VARIABLE']); in MATLAB: save -v7.3, which is HDF5"
)
_BIO = "convert it with Bio-Formats: bfconvert '{name}' '{stem}.ome.tiff'"
_VIEW = "open it in ParaView and save it as .vtu or .vtm"

# how the file begins ("": its name decides), how its name ends, what it is, what to do
ROWS = (
    (rb"ply\r?\n", "", "a .ply (Gaussians, points or a mesh)", "give the volume that it was made from (see also "
     "'vvgt info', 'vvgt render' and 'vvgt evaluate {name} --volume VOLUME')"),
    (rb"NanoVDB", "", "NanoVDB, which is laid out for GPUs", "nanovdb_convert {name} {stem}.vdb (comes with OpenVDB)"),
    (rb"7z\xbc\xaf|\xfd7zXZ|\x28\xb5\x2f\xfd|Rar!", "", "an archive or packed", "unpack it first"),
    (rb"PK\x03\x04|(?s:.{257})ustar", r"^(?!.*\.(zip|ozx|npz)$).*", "an archive", "unpack it first"),
    (rb"version https://git-lfs", "", "a pointer of Git LFS, in place of the file", "git lfs pull --include '{name}'"),
    (rb"(\.\./)*(\.git)?/annex/objects/", "", "a pointer of git-annex, in place of the file", "git annex get '{name}'"),
    (rb"(?i)\s*(<\?xml[^>]*>\s*)?<(!doctype html|html|error>)", "", "an answer of a web server, in place of the file",
     "open it in a browser to see what it says, and load the file again"),
    (rb"mrtrix image", "", "MRtrix", "mrconvert '{name}' '{stem}.nii.gz'"),
    (rb"C[ 0]1|\xc3[\x40\xf0]\xf1", "", "SEG-Y", "in Python: numpy.save('{stem}.npy', segyio.tools.cube('{name}'))"),
    (rb"#std", "", "Nek5000", "open its .nek5000 file in ParaView and save it as .vtu"),
    (rb"SIMPLE  =", "", "FITS", "in Python: numpy.save('{stem}.npy', astropy.io.fits.getdata('{name}'))"),
    (rb"MATLAB 5", "", "a MATLAB file before version 7.3", _MAT),
    (rb"\x0e\x03\x13\x01", "", "HDF4", "h4toh5convert '{name}' '{stem}.h5' (HDF Group's h4h5tools)"),
    (rb"EHFA_HEADER_TAG", "", "an ERDAS image", "gdal_translate -of netCDF '{name}' '{stem}.nc'"),
    (rb"MATRIX7\dv", "", "ECAT 7", "in Python: nibabel.save(nibabel.Nifti1Image.from_image(nibabel.load('{name}')), "
     "'{stem}.nii')"),
    (rb"# AVS", "", "an AVS field", "state what its header says: --dims X Y Z --dtype TYPE --header-bytes N"),
    (rb"ncaa", r"\.vff", "VFF", "3D Slicer with SlicerRT opens it; save it as .nrrd"),
    (rb"#!SZPLT", "", "Tecplot's SZL", "save it as .plt in Tecplot, and that with ParaView as .vtu"),
    (rb"#!TDV|\(0 \"", "", "a Tecplot or Fluent file", _VIEW),
    (b"", r"\.(plt|tec|cas|d3plot|nek5000)(\.gz)?|d3plot", "a file of a simulation program", _VIEW),
    (b"", r"\.(msh|inp|bdf|med|su2)", "a mesh", "meshio convert '{name}' '{stem}.vtu'"),
    (b"", r"\.(stl|obj|off|gltf|glb|3mf)", "a surface, with no values inside", "give the volume that it was made from"),
    (b"", r"\.(oib|oif|oir|vsi|scn|dv|r3d|ics|ids|sld|lsm|zvi|mvd2|mrxs|ndpi|obf|msr)", "a microscope's file", _BIO),
    (b"", r"\.ser", "a series of an electron microscope", "e2proc3d.py '{name}' '{stem}.mrc' (EMAN2)"),
    (b"", r"\.companion\.ome", "OME-XML of TIFF files beside it", "give one of them"),
    (b"", r"\.[qf]", "values of Plot3D", "give the coordinates beside it, '{stem}.xyz'"),
    (b"", r"\.(txm|txrm|xrm)", "Zeiss Xradia", "export it as TIFF, or in Python: dxchange.read_txrm('{name}')"),
    (b"", r"\.dm[34]", "Gatan DigitalMicrograph", "dm2mrc '{name}' '{stem}.mrc' (IMOD)"),
    (b"", r"\.(em|spi|hed)", "EM, SPIDER or IMAGIC", "e2proc3d.py '{name}' '{stem}.mrc' (EMAN2)"),
    (b"", r"\.(dsn6|brix|omap|xplor|cns)", "an electron density", "open it in ChimeraX and: save '{stem}.mrc'"),
    (b"", r"(^|[/\\])2dseq", "Bruker ParaVision", "brkraw tonii STUDY, or Bru2Nii, make NIfTI of the study's folder"),
    (b"", r"(^|[/\\])(fid|ser)", "signals of a scanner before reconstruction", "give the reconstructed images"),
    (b"", r"\.(vol|pca|xtekct)", "a CT scanner's raw values or their description", "give the .vgi beside it, or the "
     "raw file with --dims X Y Z --dtype TYPE --spacing X Y Z as the text file beside it states them"),
)  # fmt: skip


def way_out(path: Path, head: bytes, by_name: bool) -> str | None:
    """Return what a file is and what to do with it, by its first bytes or, ``by_name``, its name; None if unknown."""
    for begins, ends, what, way in ROWS:
        if not re.match(begins, head) or not (begins or by_name) or not re.search(f"(?:{ends})$", path.name, re.I):
            continue
        return f"{what}; expected a format that is read: {way.format(name=path.name, stem=path.stem)}"
    return None
