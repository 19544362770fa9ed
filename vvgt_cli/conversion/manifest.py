"""The manifest of a folder of views or frames: its run, and the files that are complete."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.digests import digest
from vvgt_cli.files import read_text
from vvgt_cli.gaussians.formats.streamed import level_files, remove_files
from vvgt_cli.gaussians.outputs import write_text

SCHEMA = 1
COMMANDS = {"views": "vvgt render-views", "frames": "vvgt convert"}  # by content of the folder
NAME = re.compile(r"manifest(-\d+-of-\d+)?\.json")
DIGESTS = {"volume": "another volume", "function": "another transfer function", "cameras": "other cameras"}
FRESH = "choose another folder, or give --overwrite to start again"


@dataclass(frozen=True)
class Shard:
    """Shard ``index`` (from 1) of ``count`` of a job array."""

    index: int = 1
    count: int = 1

    def holds(self, number: int) -> bool:
        """Return whether view ``number`` (from 0) belongs to this shard."""
        return number % self.count == self.index - 1

    @property
    def manifest(self) -> str:
        """Return the name of this shard's manifest; each shard writes its own."""
        return "manifest.json" if self.count == 1 else f"manifest-{self.index}-of-{self.count}.json"


def parse_shard(text: str) -> Shard:
    """Parse ``I/N``, I from 1 to N, or raise UsageError."""
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UsageError(f"--shard {text}: expected I/N with I from 1 to N, as 3/8")
    return Shard(int(match[1]), int(match[2]))


def file_digest(path: Path) -> str:
    """Return the sha256 of a file, of levels with the files that their manifest names, hexadecimal."""
    sha256 = hashlib.sha256()
    for each in (path, *level_files(path)):
        with each.open("rb") as file:
            hashlib.file_digest(file, lambda: sha256)
    return sha256.hexdigest()


@dataclass
class Manifest:
    """A record of the files that a run has written into a folder.

    Attributes:
        folder: folder of the views of one function, or of the frames of a series.
        settings: everything that the files depend on, plain values.
        shard: shard of this manifest.
        files: relative path -> {"bytes", "sha256"} of each complete file, other shards' included.
        recorded: those of ``files`` that this shard records.
        what: content of the folder, a key of `COMMANDS`.
    """

    folder: Path
    settings: dict[str, Any]
    shard: Shard = field(default_factory=Shard)
    files: dict[str, dict[str, Any]] = field(default_factory=dict)
    recorded: dict[str, dict[str, Any]] = field(default_factory=dict)
    what: str = "views"

    @property
    def hash(self) -> str:
        """Return the sha256 of the settings."""
        return digest(json.dumps(self.settings, sort_keys=True))

    def open(self, planned: Iterable[str], overwrite: bool) -> None:
        """Read the manifests of an earlier run with the same settings, or check that no files are in the way.

        Args:
            planned: relative paths of the files that will be written.
            overwrite: remove the files of an earlier run, whatever its settings.

        Raises:
            UsageError: the folder holds files of another run, or files that no manifest lists.
            DataError: a manifest is invalid.
        """
        manifests = self._manifests()
        if overwrite:
            self._clear(manifests)
        for path in [] if overwrite else manifests:
            document = read_run_manifest(path, self.what)
            if document["hash"] != self.hash:
                raise UsageError(
                    f"{self.folder}: {difference(document['settings'], self.settings, self.what)}; {FRESH}"
                )
            self.files |= document["files"]
            if path.name == self.shard.manifest:
                self.recorded = document["files"]
        self.files |= self.recorded
        if not manifests and not overwrite:
            for name in planned:
                if (self.folder / name).exists():
                    raise UsageError(f"{self.folder}: {name} exists, and no manifest; {FRESH}")

    def refresh(self) -> None:
        """Read what other shards have recorded meanwhile."""
        for path in self._manifests():
            if path.name != self.shard.manifest:
                self.files |= read_run_manifest(path, self.what)["files"]

    def _manifests(self) -> list[Path]:
        if not self.folder.is_dir():
            return []
        return sorted(path for path in self.folder.iterdir() if NAME.fullmatch(path.name))

    def _clear(self, manifests: list[Path]) -> None:
        for path in manifests:
            try:
                written = read_run_manifest(path, self.what)["files"]
            except DataError:  # not our manifest: only this file is replaced
                written = {}
            for name in written:
                remove_files([*level_files(self.folder / name), self.folder / name])
            path.unlink()

    def complete(self, name: str, content: bool = True) -> bool:
        """Return whether a file exists as recorded, by its size and, with ``content``, by its hash."""
        record, path = self.files.get(name), self.folder / name
        if record is None or not path.is_file() or path.stat().st_size != record["bytes"]:
            return False
        return not content or file_digest(path) == record["sha256"]

    def record(self, names: Iterable[str] = (), facts: Mapping[str, dict[str, Any]] = MappingProxyType({})) -> None:
        """Record files as complete, with further ``facts`` of some, and write the manifest."""
        for name in names:
            path = self.folder / name
            known = {"bytes": path.stat().st_size, "sha256": file_digest(path), **facts.get(name, {})}
            self.files[name] = self.recorded[name] = known
        document = {
            "format": f"vvgt-{self.what}", "schema": SCHEMA, "hash": self.hash, "settings": self.settings,
            "files": self.recorded,
        }  # fmt: skip
        write_text(self.folder / self.shard.manifest, json.dumps(document, indent=1) + "\n", overwrite=True)


def read_run_manifest(path: Path, what: str = "views") -> dict[str, Any]:
    """Read the manifest of a folder of ``what`` (a key of `COMMANDS`).

    Raise DataError if it is none, or leads outside.
    """
    try:
        document = json.loads(read_text(path))
        entries = [(PurePosixPath(name), entry["bytes"], entry["sha256"]) for name, entry in document["files"].items()]
        known = (document["format"], document["schema"]) == (f"vvgt-{what}", SCHEMA)
        known = known and isinstance(document["hash"], str) and isinstance(document["settings"], dict)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        known, entries = False, []
    if not known or any(name.is_absolute() or ".." in name.parts for name, _, _ in entries):
        raise DataError(f"{path}: not a manifest of '{COMMANDS[what]}' (schema {SCHEMA}); {FRESH}")
    return document


def difference(there: dict[str, Any], here: dict[str, Any], what: str = "views") -> str:
    """Return a line with the differences between two runs."""
    differences = []
    for key in dict.fromkeys([*here, *there]):
        a, b = there.get(key), here.get(key)
        if a != b:
            differences.append(DIGESTS.get(key) or f"{key.replace('_', ' ')} {_shown(a)} there, {_shown(b)} here")
    return f"holds {what} of another run: " + (", ".join(differences) or "its manifest was edited")


def _shown(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
