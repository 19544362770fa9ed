"""`lod-meta.json` of streamed SOG: the entries that PlayCanvas' engine reads, and those that vvgt adds."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.sog import IMAGES, META
from vvgt_cli.gaussians.formats.splats import Splats, gaussians_of

MANIFEST = "lod-meta.json"
_LARGEST = 1 << 28  # bytes of a manifest
_MOST_LEVELS = 64


def is_streamed(path: str | Path | None) -> bool:
    """Return whether a file name is that of a manifest."""
    return path is not None and Path(path).name == MANIFEST


@contextmanager
def folder_of(output: str | Path | None) -> Iterator[None]:
    """Make the folder of a manifest, not of other files; if the block leaves it empty, remove it again."""
    folder = Path(output or "").absolute().parent
    created = is_streamed(output) and not folder.exists() and folder.parent.is_dir()
    if created:
        folder.mkdir(exist_ok=True)  # another shard may have made it meanwhile
    try:
        yield
    finally:
        if created:
            with suppress(OSError):
                folder.rmdir()


def level_files(path: str | Path) -> list[Path]:
    """List the files that a manifest names and that exist; none where it is missing, damaged or another file."""
    try:
        names = read_manifest(path)["filenames"] if is_streamed(path) else []
    except DataError:
        return []
    files = [Path(path).parent / name for name in names]
    files = [file for meta in files for file in (meta, *(meta.with_name(f"{image}.webp") for image in IMAGES))]
    return [file for file in files if file.is_file()]


def remove_files(files: Iterable[Path]) -> None:
    """Remove files, and folders that they leave empty."""
    for file in files:
        file.unlink(missing_ok=True)
        with suppress(OSError):  # it holds other files
            file.parent.rmdir()


def read_manifest(path: str | Path) -> dict[str, Any]:
    """Read a manifest with what the engine needs (levels, files, nodes in the tree), or raise DataError."""
    path = Path(path)
    try:
        if path.stat().st_size > _LARGEST:
            raise DataError(f"{path}: more than {_LARGEST >> 20} MiB; expected a manifest of streamed SOG")
        manifest = json.loads(path.read_bytes())
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); expected a manifest of streamed SOG") from None
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not JSON ({' '.join(str(error).split())[:200]}); expected streamed SOG") from None
    levels = manifest.get("lodLevels") if isinstance(manifest, dict) else None
    files = manifest.get("filenames") if isinstance(manifest, dict) else None
    if type(levels) is not int or not 0 < levels <= _MOST_LEVELS or not isinstance(files, list):
        raise DataError(f"{path}: no lodLevels from 1 to {_MOST_LEVELS} or no filenames; expected streamed SOG")
    for name in files:
        parts = name.split("/") if isinstance(name, str) else []
        if not parts or parts[-1] != META or any(part in ("", ".", "..") or "\\" in part for part in parts):
            raise DataError(f"{path}: names {name!r:.80}; expected files FOLDER/{META} next to it")
    for node in nodes_of(manifest, path):
        for level, place in node["lods"].items():
            numbers = [place.get(key) if isinstance(place, dict) else None for key in ("file", "offset", "count")]
            whole = [number for number in numbers if type(number) is int and number >= 0]
            if len(whole) < 3 or not level.isdecimal() or int(level) >= levels or whole[0] >= len(files):
                raise DataError(
                    f"{path}: a node has {place!r:.80} in level {level!r:.20}; expected file, offset and count of "
                    f"{levels} levels and {len(files)} files"
                )
    assert isinstance(manifest, dict)
    return manifest


def nodes_of(manifest: dict[str, Any], path: str | Path) -> list[dict[str, Any]]:
    """Return the nodes that have levels, in the order of the tree; raise DataError if it is not valid."""
    nodes, waiting = [], [manifest.get("tree")]
    while waiting:
        node = waiting.pop()
        if isinstance(node, dict) and isinstance(node.get("lods"), dict):
            nodes.append(node)
        elif isinstance(node, dict) and isinstance(node.get("children"), list):
            waiting += reversed(node["children"])
        else:
            raise DataError(f"{path}: its tree has {node!r:.80}; expected nodes with children or lods")
    return nodes


def facts_of(path: str | Path) -> dict[str, Any]:
    """Return the summary for `vvgt info`: Gaussians and nodes per level; bytes, errors, certificate of our own."""
    manifest = read_manifest(path)
    nodes, ours = nodes_of(manifest, path), manifest.get("vvgt")
    facts = ours.get("levels") if isinstance(ours, dict) else None
    levels = []
    for level in range(manifest["lodLevels"]):
        places = [node["lods"][str(level)] for node in nodes if str(level) in node["lods"]]
        row = {"level": level, "nodes": len(places), "gaussians": sum(place["count"] for place in places)}
        if isinstance(facts, list) and level < len(facts) and isinstance(facts[level], dict):
            row |= {key: facts[level].get(key) for key in ("files", "bytes", "rms", "spread")}
        levels.append(row)
    asset, (_, header) = manifest.get("asset"), gaussians_of(placed(manifest)[0], str(path))
    return {
        "written_by": asset.get("generator") if isinstance(asset, dict) else None,
        "files": len(manifest["filenames"]),
        "nodes": len(nodes),
        "levels": levels,
        **({} if header.certificate is None else {"certificate": header.certificate.facts()}),
    }


def placed(manifest: dict[str, Any]) -> tuple[Splats, float]:
    """Return placeholder Gaussians with the file's comments, for the page's initial camera, and the frame's scale."""
    ours = manifest.get("vvgt")
    ours = ours if isinstance(ours, dict) else {}
    scale, lines = ours.get("scale"), ours.get("comments")
    comments = tuple(str(line) for line in lines) if isinstance(lines, list) else ()
    tree = manifest["tree"].get("bound")
    corners = np.array([[-1.0] * 3, [1.0] * 3])
    if not comments and isinstance(tree, dict):
        with suppress(KeyError, TypeError, ValueError):
            corners = np.array([tree["min"], tree["max"]], np.float64).reshape(2, 3)
    empty = np.zeros((2, 3), np.float32)
    turned = np.tile(np.array([1, 0, 0, 0], np.float32), (2, 1))
    splats = Splats(corners.astype(np.float32), empty, turned, empty[:, 0], empty, np.zeros((2, 0, 3)), comments)
    return splats, float(scale) if comments and isinstance(scale, (int, float)) and 0 < scale < 1e6 else 1.0


def corners(manifest: dict[str, Any]) -> np.ndarray:
    """Return the corners (N, 3) of the nodes' boxes, in the coordinates of the files; none if a node has no box."""
    with suppress(KeyError, TypeError, ValueError):
        boxes = [[node["bound"]["min"], node["bound"]["max"]] for node in nodes_of(manifest, MANIFEST)]
        ends = np.array(boxes, np.float64).reshape(-1, 2, 3)
        places: np.ndarray = np.concatenate([ends[:, list(end), range(3)] for end in product((0, 1), repeat=3)])
        return places if np.isfinite(places).all() else places[:0]
    return np.empty((0, 3))
