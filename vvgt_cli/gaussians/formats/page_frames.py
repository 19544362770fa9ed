"""Frames of a series within a page: whole, or as differences from the last whole one (`page/patch.mjs`)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np

from vvgt_cli.gaussians.formats.gsply_files import compressed_ply
from vvgt_cli.gaussians.formats.splats import Splats, morton_order

LEAST = 0.2  # smallest share of rows in common with the whole frame
GAP = 16  # equal bytes that are kept within a run, as a new run costs 8 bytes


class StoredFrame(NamedTuple):
    """A frame stored in a page: a `.compressed.ply`, or the difference from that of frame ``whole``."""

    content: bytes
    whole: int | None


def stored_frames(clouds: Sequence[tuple[str, Splats]]) -> list[StoredFrame]:
    """Return all frames (name, columns), those that share rows with the last whole frame as differences."""
    clouds, stored = _of_one_length(clouds), list[StoredFrame]()
    while len(stored) < len(clouds):
        first = len(stored)
        key = clouds[first][1]
        changed = [_changed(key, splats) for _, splats in clouds[first + 1 :]]
        count = next((k for k, rows in enumerate(changed) if rows is None), len(changed))
        ever = np.any([rows for rows in changed[:count] if rows is not None], axis=0) if count else None
        order = None if ever is None else morton_order(key.means)
        if order is not None and ever is not None:
            order = order[np.argsort(ever[order], kind="stable")]  # unchanged Gaussians first
        name, splats = clouds[first]
        base = compressed_ply(splats, name, order)
        stored.append(StoredFrame(base, None))
        for name, splats in clouds[first + 1 : first + 1 + count]:
            stored.append(StoredFrame(patch(base, compressed_ply(splats, name, order)), first))
    return stored


def _of_one_length(clouds: Sequence[tuple[str, Splats]]) -> list[tuple[str, Splats]]:
    """Pad comments to the same length, because some, such as certificates, differ from frame to frame."""
    sizes = [sum(len(f"comment {line}\n".encode()) for line in splats.comments) for _, splats in clouds]
    if len(set(sizes)) < 2:
        return list(clouds)
    return [
        (name, replace(splats, comments=(*splats.comments, " " * (max(sizes) - size))))
        for (name, splats), size in zip(clouds, sizes, strict=True)
    ]


def _changed(key: Splats, splats: Splats) -> np.ndarray | None:
    """Return a mask (K,) of the rows that differ, None if the frames have too little in common."""
    if len(key) != len(splats) or key.f_rest.shape != splats.f_rest.shape:
        return None
    rows = np.zeros(len(key), bool)
    for field in fields(Splats):
        a, b = getattr(key, field.name), getattr(splats, field.name)
        if isinstance(a, np.ndarray):
            rows |= (a != b).reshape(len(rows), -1).any(axis=1)
    return rows if rows.mean() <= 1 - LEAST else None


def patch(base: bytes, content: bytes) -> bytes:
    """Return the difference of ``content`` from ``base`` of the same length: runs, each (place, length, bytes)."""
    a, b = np.frombuffer(base, np.uint8), np.frombuffer(content, np.uint8)
    at = np.flatnonzero(a != b)
    if not len(at):
        return b""
    breaks = np.flatnonzero(np.diff(at) > GAP)
    first, last = at[np.concatenate([[0], breaks + 1])], at[np.concatenate([breaks, [len(at) - 1]])] + 1
    runs = zip(first.tolist(), last.tolist(), strict=True)
    return b"".join(struct.pack("<II", i, j - i) + content[i:j] for i, j in runs)
