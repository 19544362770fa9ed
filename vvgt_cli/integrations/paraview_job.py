"""One file that ParaView's plugin writes: the data as VTK files, and the commands of ``vvgt`` on them.

With several MPI ranks each saves its piece, and for a .ply computes its share of the closed form, which the first one
merges. They meet in a folder beside the file, which all must see.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from typing import Any

from vvgt_cli.integrations.command import run, tell
from vvgt_cli.integrations.paraview_view import look
from vvgt_cli.integrations.vtk_files import index_of, series_of, voxels_of, write
from vvgt_cli.integrations.vtk_scene import placed

BLOCKS = 4  # of the volume for each rank, at least, of at most 256 voxels along an edge


def failure(words: list[str]) -> str:
    """Run the command; return its error, "" where it did what it should."""
    try:
        run(words)
    except RuntimeError as error:
        return str(error)
    return ""


class Job:
    """A file to write; see the module.

    Args:
        name: the file.
        options: of the plugin.
        source: vtkAlgorithm whose output is written, and whose look in the active view is taken.

    Raises:
        RuntimeError: another rank has failed.
    """

    def __init__(self, name: str, options: dict[str, Any], source: Any) -> None:
        """Take the look, by the first rank for all."""
        from vtkmodules.vtkCommonMath import vtkMatrix4x4
        from vtkmodules.vtkParallelCore import vtkMultiProcessController

        self.ranks = vtkMultiProcessController.GetGlobalController()
        self.count = self.ranks.GetNumberOfProcesses() if self.ranks else 1
        self.rank = self.ranks.GetLocalProcessId() if self.ranks else 0
        self.name, self.options, self.saved = os.path.abspath(name), options, list[tuple[str, float]]()
        self.folder = self.name + ".parts"
        error = ""
        if self.rank == 0:
            shutil.rmtree(self.folder, ignore_errors=True)
            os.makedirs(self.folder)
            try:
                found = look(source, options, self._path("function.json"))
                with open(self._path("look.json"), "w", encoding="utf-8") as file:
                    json.dump(found, file)
            except Exception as failed:  # the other ranks would wait for ever
                error = f"the view's look: {failed!r}"
        self.meet(error)
        self.words, numbers, notes = self._read("look.json")
        self.matrix = vtkMatrix4x4()
        self.matrix.DeepCopy(numbers or [float(k % 5 == 0) for k in range(16)])
        if self.rank == 0 and notes:
            tell(f"not taken: {'; '.join(dict.fromkeys(notes))}")

    def _path(self, name: str) -> str:
        return os.path.join(self.folder, name)

    def _read(self, name: str) -> Any:
        with open(self._path(name), encoding="utf-8") as file:
            return json.load(file)

    def meet(self, error: str = "") -> None:
        """Wait for all ranks.

        Raises:
            RuntimeError: one of them has an ``error``.
        """
        if error:
            with open(self._path(f"error_{self.rank}"), "w", encoding="utf-8") as file:
                file.write(error)
        if self.count > 1:
            self.ranks.Barrier()
        for rank in range(self.count):
            if os.path.exists(self._path(f"error_{rank}")):
                with open(self._path(f"error_{rank}"), encoding="utf-8") as file:
                    raise RuntimeError(file.read() or error)

    def save(self, data: Any, time: float) -> None:
        """Save a time step, or this rank's piece of it."""
        stem = f"step_{len(self.saved):05d}"
        if self.count == 1:
            self.saved.append((write(placed(data, self.matrix), self._path(stem)), time))
            return
        image = data.IsA("vtkImageData")
        if image:
            moved = placed(data, self.matrix)
            write(moved, self._path(f"{stem}_{self.rank}"))
            with open(self._path(f"{stem}_{self.rank}.json"), "w", encoding="utf-8") as file:
                json.dump(moved.GetExtent(), file)
        self.meet("" if image else f"a {data.GetClassName()} in {self.count} ranks; expected an image, or one rank")
        extents = [self._read(f"{stem}_{rank}.json") for rank in range(self.count)]
        if self.rank == 0:
            with open(self._path(f"{stem}.pvti"), "w", encoding="utf-8") as file:
                file.write(index_of(moved, stem, extents))
        self.meet()
        self.saved.append((self._path(f"{stem}.pvti"), time))
        self.voxels = voxels_of(extents)

    def convert(self) -> None:
        """Run the command on what was saved; raise its error as a RuntimeError."""
        stem, dot, ending = os.path.basename(self.name).partition(".")
        name = os.path.join(os.path.dirname(self.name), stem + "_{:04d}" + dot + ending)
        limits = ["--max-gaussians", str(self.options["Gaussians"]), *self.words]
        if self.count > 1 and self.name.endswith(".ply"):
            for k, (path, _) in enumerate(self.saved):
                self._shares(path, limits, name.format(k) if len(self.saved) > 1 else self.name)
            return
        limits += ["--steps", str(self.options["Steps"]), "--overwrite", *["--live"] * bool(self.options["Live"])]
        source, target = self.saved[0][0], self.name
        if len(self.saved) > 1 and self.rank == 0:
            source, target = self._path("series.pvd"), self.name if ending.endswith("html") else name
            with open(source, "w", encoding="utf-8") as file:
                file.write(series_of(self.saved))
        self.meet(failure(["convert", source, "-o", target, *limits]) if self.rank == 0 else "")

    def _shares(self, path: str, words: list[str], target: str) -> None:
        """Compute this rank's share of the closed form, in passes that need each other's results; merge them."""
        blocks = path + ".blocks"
        edge = 2 ** max(4, min(8, int(math.log2(self.voxels / (BLOCKS * self.count)) / 3)))
        share = ["--shard", f"{self.rank + 1}/{self.count}", "--blocks", str(edge), "--quiet"]
        for _ in range(2 if "--tf" in words else 3):
            self.meet(failure(["init", path, "-o", blocks, *words, *share]))
        self.meet(failure(["merge", blocks, "-o", target, "--overwrite"]) if self.rank == 0 else "")

    def end(self) -> None:
        """Remove the folder."""
        if self.count > 1:
            self.ranks.Barrier()
        if self.rank == 0:
            shutil.rmtree(self.folder, ignore_errors=True)
