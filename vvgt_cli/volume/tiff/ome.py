"""OME-XML of a TIFF file: checked before tifffile follows it, with the files of a set under their present names.

Files name each other by name and UUID (OME model 2016-06, TiffData); the UUID stays when a file is renamed.
"""

from __future__ import annotations

import math
import re
import struct
import warnings
from collections import Counter
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from vvgt_cli.errors import DataError
from vvgt_cli.volume.components import listed
from vvgt_cli.volume.microscopy.image import MAX_XML, safe_xml
from vvgt_cli.volume.tiff import TIFF
from vvgt_cli.volume.tiff.pages import MAX_PAGES, check_pages

_MOST_FILES = 10_000
_UUID = re.compile(r"""<(?:\w+:)?OME\b[^>]*?\bUUID=["']([^"']+)""")


def open_tiff(path: Path) -> Any:
    """Open a TIFF file as a `tifffile.TiffFile` whose OME-XML can be followed; a context.

    The XML of a file that refers to another one for it (BinaryOnly) is that one's.

    Raises:
        DataError: XML that declares entities, is damaged, or names sizes, ranges or files that cannot be.
    """
    import tifffile

    file = tifffile.TiffFile(path)
    if not file.is_ome or not file.ome_metadata:
        return file
    with file:
        root = _parsed(file.ome_metadata, path)
    uuid, reference = root.get("UUID"), next((e for e in root.iter() if ome_tag(e) == "BinaryOnly"), None)
    if reference is not None:
        if not _is_beside(path, name := reference.get("MetadataFile", "")):
            raise DataError(
                f"{path}: its OME-XML is in {name or 'another file'}, which is not beside it; fetch it, too"
            )
        root = _parsed(_description(path.with_name(name)), path)
    _name_files(root, path, uuid)
    return tifffile.TiffFile(path, omexml=ElementTree.tostring(root, "unicode"))


def _parsed(xml: str, path: Path) -> ElementTree.Element:
    """Parse OME-XML and check its elements."""
    root = safe_xml(xml, str(path))
    for element in root.iter():
        _check_element(element, path)
    return root


def _is_beside(path: Path, name: str) -> bool:
    """Tell whether a file lies in the folder of another; raise DataError where its name is of another folder."""
    if Path(name).name != name or "\\" in name:
        raise DataError(f"{path}: OME-XML names the file {name!r}; expected names in its own folder")
    return bool(name) and path.with_name(name).is_file()


def _description(path: Path) -> str:
    """Return the OME-XML of a TIFF file, "" for none, or the text of a file of XML alone."""
    import tifffile

    if not path.name.lower().endswith(TIFF):
        return path.read_bytes()[:MAX_XML].decode("utf-8-sig", "replace")
    check_pages(path)
    with tifffile.TiffFile(path) as file:
        return str(file.ome_metadata or "")


def _name_files(root: ElementTree.Element, path: Path, uuid: str | None) -> None:
    """Change files and UUIDs of planes to the present names of files; ``uuid`` is that of the file at ``path``.

    Raise DataError for files that are missing, or in other folders.
    """
    planes = [element for element in root.iter() if ome_tag(element) == "UUID"]
    pairs = sorted({(plane.text or "", plane.get("FileName", "")) for plane in planes})
    if len(pairs) > _MOST_FILES:
        raise DataError(f"{path}: OME-XML of {len(pairs)} files; expected at most {_MOST_FILES}")
    names = Counter(key for key, _ in pairs)  # of a UUID: of several one is wrong
    uuid = uuid or (pairs[0][0] if len(names) == 1 else None)  # all planes are in one file, which is this one
    alone = not pairs or (len(pairs) == 1 and (uuid in names or _is_beside(path, pairs[0][1])))
    others = {uuid or "": path.name} if alone else _uuids(path.parent)
    present: dict[tuple[str, str], str] = {}
    known = {key: others[key] for key in others if names[key] == 1}
    for key, name in pairs:
        present[key, name] = known.get(key) or (name if _is_beside(path, name) and name not in known.values() else "")
    missing = [
        f"{name} ({key})" if name in known.values() else name or key for key, name in pairs if not present[key, name]
    ]
    if len(pairs) == len(missing) == 1:
        warnings.warn(f"{path}: OME-XML names {missing[0]}, which is not here; its own pages are read", stacklevel=4)
        present[pairs[0]] = path.name
    elif missing:
        which = f"file {missing[0]}, which is" if len(missing) == 1 else f"files {listed(missing, ', ', 3)}, which are"
        raise DataError(f"{path}: OME-XML names the {which} not beside it; fetch the whole set")
    for plane in planes:
        plane.text = file = present[plane.text or "", plane.get("FileName", "")]
        plane.set("FileName", file)
    root.set("UUID", path.name)
    for file in set(present.values()) - {path.name}:
        check_pages(path.with_name(file))


def _uuids(folder: Path) -> dict[str, str]:
    """Return the names of the OME-TIFFs in a folder, by their UUID; one that several files have is left out."""
    names: dict[str, list[str]] = {}
    for file in islice(sorted(folder.iterdir()), _MOST_FILES):
        with suppress(OSError, ValueError, DataError, struct.error):  # damaged, or no TIFF
            if file.name.lower().endswith(TIFF) and (uuid := _UUID.search(_description(file))):
                names.setdefault(uuid[1], []).append(file.name)
    return {uuid: files[0] for uuid, files in names.items() if len(files) == 1}


def _check_element(element: ElementTree.Element, path: Path) -> None:
    tag = ome_tag(element)
    if tag == "Pixels":
        sizes = [int(element.get(f"Size{axis}", 0)) for axis in "XYZCT"]
        if min(sizes) < 1 or math.prod(sizes[2:]) > MAX_PAGES:
            raise DataError(f"{path}: OME-XML of sizes {sizes}; expected at least 1 and at most {MAX_PAGES} planes")
        if sorted(element.get("DimensionOrder", "")) != list("CTXYZ"):
            raise DataError(f"{path}: OME-XML with DimensionOrder {element.get('DimensionOrder')!r}; expected as XYZCT")
    if tag == "TiffData":
        numbers = [int(value) for key, value in element.items() if key in ("IFD", "NumPlanes", "PlaneCount")]
        if any(not 0 <= n <= MAX_PAGES for n in numbers):
            raise DataError(f"{path}: OME-XML with TiffData of {numbers}; expected 0 to {MAX_PAGES}")
    if tag.startswith("Along") and element.get("Start") is not None:
        start, stop, step = (
            float(element.get(key, default)) for key, default in (("Start", 0), ("End", 0), ("Step", 1))
        )
        if not abs(stop - start) <= 1e6 * abs(step):
            raise DataError(f"{path}: OME-XML with {tag} from {start} to {stop} by {step}; expected at most 10^6 steps")


def ome_tag(element: ElementTree.Element) -> str:
    """Return an element's name, without its namespace."""
    return str(element.tag).rpartition("}")[2]
