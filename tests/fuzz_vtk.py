"""Seeds of tests/fuzz.py for what VTK reads in a process of its own: meshes, indexes, and other programs' files.

Here that process is a fork that answers many requests, for speed: what it cannot survive is one line of error, as it
is in the program, and the next request has a new one.
"""

import json
import math
import os
import resource
import select
import signal
import sys
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from fuzz import SECONDS, Seed
from fuzz_seeds import volume_reader
from vtkmodules import vtkIOXML
from vtkmodules.vtkIOLegacy import vtkDataSetWriter

sys.path.insert(0, str(Path(__file__).parent.parent))

from tests import vtk_files as files
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.vtk import child as vtk_child

Make = Callable[[Path], Path]
DIMS = (8, 6, 4)
IDLE = 5  # s that it may sleep without any processor time: the program's child a minute
EACH = 200  # requests to a fork: what readers lose of memory goes with it


class _Worker:
    """A fork that answers requests of `vtk_child`, bounded in processor time for each, until one brings it down."""

    def __init__(self) -> None:
        self.owner, self.answered = os.getpid(), 0
        inward, to = os.pipe()
        back, outward = os.pipe()
        self.pid = os.fork()
        if not self.pid:
            os.close(to)
            os.close(back)
            try:
                _answer_all(inward, outward)
            finally:  # whatever happens, it does not go on as a second fuzzer
                os._exit(1)
        os.close(inward)
        os.close(outward)
        self.to, self.back = os.fdopen(to, "wb"), os.fdopen(back, "rb")

    def answers(self) -> bool:
        """Whether it answers or ends, and does not sleep in a lock for `IDLE` seconds."""
        slept, last = 0, ""
        while slept < IDLE:
            if select.select([self.back], [], [], 1)[0]:
                return True
            words = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
            now = " ".join([words[0], *words[11:13]])  # its state, and its processor time
            slept = slept + 1 if now == last and now[0] == "S" else 0
            last = now
        return False

    def end(self) -> int:
        """Its exit status, once it has none to answer."""
        self.to.close()
        self.back.close()
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


def _answer_all(inward: int, outward: int) -> None:
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with os.fdopen(inward, "rb") as requests, os.fdopen(outward, "wb") as stream:
        for line in requests:
            used = resource.getrusage(resource.RUSAGE_SELF)
            soft = math.ceil(used.ru_utime + used.ru_stime + SECONDS)
            resource.setrlimit(resource.RLIMIT_CPU, (soft, resource.RLIM_INFINITY))
            vtk_child.send(stream, *vtk_child.answer(json.loads(line)))
            stream.flush()
    os._exit(0)


_workers: list[_Worker] = []  # one, or none


def run_fork(request: dict[str, Any]) -> tuple[tuple[dict[str, Any], np.ndarray] | None, int]:
    """As `vtk_child.run`, by a fork that is bounded alike and answers `EACH` requests, if it lives."""
    if _workers and _workers[0].owner != os.getpid():  # another process's
        del _workers[0]
    if not _workers:
        _workers.append(_Worker())
    worker = _workers[0]
    worker.to.write(json.dumps(request).encode() + b"\n")
    worker.to.flush()
    if not worker.answers():  # it sleeps: the program's child is killed for that, too
        os.kill(worker.pid, signal.SIGKILL)
    found = vtk_child.received(worker.back)
    worker.answered += 1
    if found is not None and worker.answered < EACH:
        return found, 0
    del _workers[0]
    return found, worker.end()


def seeds_of(make: Make, changed: tuple[str, ...], **options: Any) -> list[Seed]:
    """Seeds of what ``make`` writes: each of the files named is changed, the others stay."""
    with tempfile.TemporaryDirectory() as folder:
        opened = make(Path(folder)).relative_to(folder)
        content = {str(p.relative_to(folder)): p.read_bytes() for p in Path(folder).rglob("*") if p.is_file()}

    def read(path: Path, name: str) -> None:
        root = path
        for _ in Path(name).parts:
            root = root.parent
        volume = read_volume(str(root / opened), ReadOptions(**options))
        for z in (0, -1):
            np.asarray(volume.data[z])

    return [
        Seed(name, content[name], lambda path, name=name: read(path, name), content | {name: b""}) for name in changed
    ]


def indexes() -> list[Seed]:
    return [
        *seeds_of(lambda f: files.parallel_image(f, files.wavelet(6), 4, DataMode=0), ("v.pvti", "v_1.vti")),
        *seeds_of(files.collection, ("v.pvd", "s0_0.vti"), array="ramp", time=0),
        *seeds_of(lambda f: files.collection(f, "vtu"), ("v.pvd", "s1_0.vtu"), array="cells", time=1, dims=DIMS),
        *seeds_of(lambda f: files.series(f, "vtk"), ("v.vtk.series",), array="ramp", time=1),
        *seeds_of(lambda f: files.pieces(f, "pvts"), ("v.pvts", "part1.vts"), array="ramp", dims=DIMS),
        *seeds_of(lambda f: files.pieces(f, "pvtr"), ("v.pvtr",), array="cells", dims=DIMS),
        *seeds_of(files.multiblock, ("v.vtm", "v/v_0.vtu"), array="ramp", dims=DIMS),
        *seeds_of(files.amr, ("v.vthb", "v/v_1.vti")),
    ]


def meshes() -> list[Seed]:
    """Single grids and meshes, XML and legacy, in every coding."""

    def legacy(name: str, mesh: Any, binary: bool, version: int) -> Make:
        def write(folder: Path) -> Path:
            writer = vtkDataSetWriter()
            writer.SetFileVersion(version)
            (writer.SetFileTypeToBinary if binary else writer.SetFileTypeToASCII)()
            return files.write(writer, mesh, folder / name)

        return write

    def xml(name: str, mesh: Any, mode: int) -> Make:
        def write(folder: Path) -> Path:
            writer = getattr(vtkIOXML, f"vtkXML{mesh.GetClassName()[3:]}Writer")()
            writer.SetDataMode(mode)
            return files.write(writer, mesh, folder / name)

        return write

    image, mesh = files.image(), files.hexahedra()
    kinds = {"vtr": image.cast_to_rectilinear_grid(), "vts": image.cast_to_structured_grid(), "vtu": mesh}
    seeds = []
    for mode in range(3):
        for suffix, data in kinds.items():
            array = ("ramp", "cells")[mode % 2]
            seeds += seeds_of(xml(f"v{mode}.{suffix}", data, mode), (f"v{mode}.{suffix}",), array=array, dims=DIMS)
    for k, data in enumerate(kinds.values()):
        for n, (binary, version) in enumerate(((False, 51), (True, 51), (False, 42), (True, 42))):
            name = f"v{k}{n}.vtk"
            seeds += seeds_of(legacy(name, data, binary, version), (name,), array=("ramp", "cells")[n % 2], dims=DIMS)
    return seeds


def parts_of_openfoam(folder: Path) -> Path:
    """A case whose second time lies in its processor folders."""
    from tests.test_volume_openfoam import case, decomposed

    decomposed(folder, {"0.5": 0.0, "2": 1.0})
    return case(folder, {"0.5": 0.0})


def programs() -> list[Seed]:
    return [
        *seeds_of(files.hdf_image, ("v.vtkhdf",), array="ramp"),
        *seeds_of(files.hdf_mesh, ("v.vtkhdf",), array="ramp", dims=DIMS),
        *seeds_of(files.hdf_amr, ("v.vtkhdf",)),
        *seeds_of(files.hdf_steps, ("v.vtkhdf",), time=1),
        *seeds_of(files.exodus, ("v.exo",), array="ramp", dims=DIMS),
        *seeds_of(files.xdmf3, ("v.xdmf", "v.h5"), time=1),
        *seeds_of(files.ensight, ("v.case", "v.geo", "v.ramp.01"), array="ramp", time=1, dims=DIMS),
        *seeds_of(files.cgns, ("v.cgns",), array="ramp", dims=DIMS),
        *seeds_of(files.plot3d, ("v.p3d", "v.xyz", "v.f"), dims=DIMS),
        *seeds_of(
            files.openfoam, ("system/controlDict", "constant/polyMesh/owner", "constant/polyMesh/faces", "0.5/cells"),
            time=0, dims=DIMS,
        ),
        *seeds_of(parts_of_openfoam, ("processor0/2/cells", "processor1/constant/polyMesh/owner"), time=1, dims=DIMS),
    ]  # fmt: skip


def grib() -> list[Seed]:
    """Levels and times, GRIB 1 and 2; nothing without ecCodes."""
    import grib_files as written

    seeds = []
    for edition in (1, 2):
        pairs = [(p, h) for h in (0, 6) for p in (900, 1000)]
        messages = [
            written.message(written.field(p, h), edition, shortName="t", level=p, stepRange=h) for p, h in pairs
        ]
        with tempfile.TemporaryDirectory() as folder:
            written.write(Path(folder) / "v.grib", *messages)
            data = (Path(folder) / "v.grib").read_bytes()
        seeds.append(Seed(f"v{edition}.grib", data, volume_reader(time=1, spacing=(1, 1, 1))))
    return seeds


def readers() -> dict[str, list[Seed]]:
    """Seeds by reader."""
    vtk_child.run = run_fork
    found = {"VTK mesh": meshes(), "VTK index": indexes(), "programs by VTK": programs()}
    return found | ({"GRIB": grib()} if find_spec("eccodes") else {})
