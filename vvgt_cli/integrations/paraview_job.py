"""One file that ParaView's plugin writes: the data as VTK files, and the commands of ``vvgt`` on them.

With several MPI ranks each saves its piece, and for a .ply computes its share of the closed form, which the first one
merges. They meet in a hidden folder beside the file, ``.NAME.vvgt-parts``, which all must see.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from typing import Any

from vvgt_cli.integrations.command import Kept, tell
from vvgt_cli.integrations.paraview_ranks import Ranks, failure
from vvgt_cli.integrations.paraview_view import look
from vvgt_cli.integrations.vtk_files import index_of, series_of, voxels_of, write
from vvgt_cli.integrations.vtk_scene import placed

BLOCKS = 4  # of the volume for each rank, at least, of at most 256 voxels along an edge


class Job:
    """A file to write; see the module.

    Args:
        name: the file.
        options: of the plugin.
        source: vtkAlgorithm whose output is written, and whose look in the active view is taken.
        vvgt: runs the commands.

    Raises:
        RuntimeError: this rank or another has failed; nothing is left behind.
    """

    def __init__(self, name: str, options: dict[str, Any], source: Any, vvgt: Kept) -> None:
        """Take the look, by the first rank for all."""
        from vtkmodules.vtkCommonMath import vtkMatrix4x4

        self.ranks, self.vvgt = Ranks(), vvgt
        self.count, self.rank, self.meet = self.ranks.count, self.ranks.rank, self.ranks.meet
        self.name, self.options, self.saved = os.path.abspath(name), options, list[tuple[str, float]]()
        above, base = os.path.split(self.name)
        self.folder, self.made = os.path.join(above, f".{base}.vvgt-parts"), False
        self.matrix = vtkMatrix4x4()
        try:
            self.meet(failure(self._begin, source) if self.rank == 0 else "")
            self.meet(failure(self._take))
        except RuntimeError:
            self.end()
            raise

    def _begin(self, source: Any) -> None:
        """Make the folder, and write the look into it; a folder that a killed job left is replaced."""
        left = os.listdir(self.folder) if os.path.isdir(self.folder) else ["look.json"]
        if left and "look.json" not in left:
            raise RuntimeError(f"{self.folder}: is not of vvgt; expected no such folder (remove or rename it)")
        shutil.rmtree(self.folder, ignore_errors=True)
        os.mkdir(self.folder)
        self.made = True
        words, numbers, notes = look(source, self.options, self._path("function.json"))
        if self.options["Live"] and self._in_shares():
            notes.append("Live (a .ply of several ranks)")
        self._write("look.json", json.dumps((words, numbers)))
        if notes:
            tell(f"not taken: {'; '.join(dict.fromkeys(notes))}")

    def _take(self) -> None:
        self.words, numbers = self._read("look.json")
        self.matrix.DeepCopy(numbers or [float(k % 5 == 0) for k in range(16)])

    def _in_shares(self) -> bool:
        return self.count > 1 and self.name.endswith(".ply") and ".compressed." not in self.name

    def _path(self, name: str) -> str:
        return os.path.join(self.folder, name)

    def _read(self, name: str) -> Any:
        with open(self._path(name), encoding="utf-8") as file:
            return json.load(file)

    def _write(self, name: str, text: str) -> None:
        with open(self._path(name), "w", encoding="utf-8") as file:
            file.write(text)

    def save(self, data: Any, time: float) -> None:
        """Save a time step, or this rank's piece of it."""
        stem = f"step_{len(self.saved):05d}"
        if self.count == 1:
            self.saved.append((write(placed(data, self.matrix), self._path(stem)), time))
            return
        self.meet(failure(self._piece, data, f"{stem}_{self.rank}"))
        self.meet(failure(self._index, data, stem))
        self.saved.append((self._path(f"{stem}.pvti"), time))

    def _piece(self, data: Any, stem: str) -> None:
        if not data.IsA("vtkImageData"):
            raise RuntimeError(f"a {data.GetClassName()} in {self.count} ranks; expected an image, or one rank")
        write(placed(data, self.matrix), self._path(stem))
        self._write(f"{stem}.json", json.dumps(data.GetExtent()))

    def _index(self, data: Any, stem: str) -> None:
        extents = [self._read(f"{stem}_{rank}.json") for rank in range(self.count)]
        self.voxels = voxels_of(extents)
        if self.rank == 0:
            self._write(f"{stem}.pvti", index_of(placed(data, self.matrix), stem, extents))

    def convert(self) -> None:
        """Run the command on what was saved; raise its error as a RuntimeError."""
        stem, dot, ending = os.path.basename(self.name).partition(".")
        name = os.path.join(os.path.dirname(self.name), stem + "_{:04d}" + dot + ending)
        limits = ["--max-gaussians", str(self.options["Gaussians"]), *self.words]
        if self._in_shares():
            for k, (path, _) in enumerate(self.saved):
                self._shares(path, limits, name.format(k) if len(self.saved) > 1 else self.name)
            return
        limits += ["--steps", str(self.options["Steps"]), "--overwrite", *["--live"] * bool(self.options["Live"])]
        source, target = self.saved[0][0], self.name
        if len(self.saved) > 1:
            source, target = self._path("series.pvd"), self.name if ending.endswith("html") else name
            self.meet(failure(self._write, "series.pvd", series_of(self.saved)) if self.rank == 0 else "")
        self.meet(failure(self.vvgt.run, ["convert", source, "-o", target, *limits]) if self.rank == 0 else "")

    def _shares(self, path: str, words: list[str], target: str) -> None:
        """Compute this rank's share of the closed form, in passes that need each other's results; merge them."""
        blocks = path + ".blocks"
        edge = 2 ** max(4, min(8, int(math.log2(self.voxels / (BLOCKS * self.count)) / 3)))
        share = ["--shard", f"{self.rank + 1}/{self.count}", "--blocks", str(edge), "--quiet"]
        for _ in range(2 if "--tf" in words else 3):
            self.meet(failure(self.vvgt.run, ["init", path, "-o", blocks, *words, *share]))
        self.meet(failure(self.vvgt.run, ["merge", blocks, "-o", target, "--overwrite"]) if self.rank == 0 else "")

    def end(self) -> None:
        """Remove the folder that this job made."""
        self.ranks.wait()
        if self.made:
            shutil.rmtree(self.folder, ignore_errors=True)
