"""A small simulation that Catalyst watches: dye that is carried round and spreads, a slab of it on each MPI rank.

    mpirun -n 2 python3 catalyst_simulation.py SCRIPT STEPS VOXELS [WHOLE.vti]

It prints the mean seconds a step of its own and of the script; WHOLE.vti is the last step, of all ranks.
"""

import sys
import time

import numpy as np
from mpi4py import MPI
from paraview.catalyst import bridge
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

script, steps, n = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
comm = MPI.COMM_WORLD
along = np.linspace(-1, 1, n)
last = n - 1
low, high = (round((comm.rank + k) * last / comm.size) for k in (0, 1))


def dye(step: int, low: int, high: int) -> np.ndarray:
    """Values (high - low + 1, n, n) of slices low to high: twelve drops on a wavy ring."""
    z, y, x = along[low : high + 1, None, None], along[:, None], along
    turned, spread = 0.2 * step, 0.04 + 0.003 * step
    values = np.zeros((high - low + 1, n, n))
    for begin in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        angle, height = turned + begin, 0.3 * np.sin(3 * turned + begin)
        away = (x - 0.5 * np.cos(angle)) ** 2 + (y - 0.5 * np.sin(angle)) ** 2 + (z - height) ** 2
        values += np.exp(-away / spread) / 2.5
    return values.astype(np.float32)


def image_of(values: np.ndarray, low: int, high: int) -> vtkImageData:
    """The slices low to high as an image."""
    image = vtkImageData()
    image.SetExtent(0, last, 0, last, low, high)
    image.SetSpacing(*[2 / last] * 3)
    image.SetOrigin(-1, -1, -1)
    array = numpy_to_vtk(values.ravel(), deep=True)
    array.SetName("dye")
    image.GetPointData().SetScalars(array)
    return image


bridge.initialize()
bridge.add_pipeline(script, 2)
seconds = np.zeros(2)
for step in range(steps):
    begun = time.perf_counter()
    slab = dye(step, low, high)
    comm.Barrier()
    computed = time.perf_counter()
    bridge.coprocess(step / 10, step, image_of(slab, low, high), "input", [0, last, 0, last, 0, last])
    comm.Barrier()
    seconds += computed - begun, time.perf_counter() - computed
if comm.rank == 0:
    own, script_s = seconds / steps
    print(f"simulation {own:.3f} s a step, script {script_s:.3f} s a step, {comm.size} ranks", flush=True)
    if len(sys.argv) > 4:
        writer = vtkXMLImageDataWriter()
        writer.SetFileName(sys.argv[4])
        writer.SetInputData(image_of(dye(steps - 1, 0, last), 0, last))
        writer.Write()
bridge.finalize()
