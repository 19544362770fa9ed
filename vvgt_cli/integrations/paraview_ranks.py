"""The MPI ranks of ParaView, which go on or fail together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def failure(work: Callable[..., object], *given: Any) -> str:
    """Do a rank's share of the work; return its error, which must not end the rank, as others would wait for ever."""
    try:
        work(*given)
    except (RuntimeError, OSError) as error:
        return str(error)
    except Exception as error:
        return repr(error)
    return ""


class Ranks:
    """All ranks of this process's group, one where there is no MPI: their ``count``, and the ``rank`` of this one."""

    def __init__(self) -> None:
        """Ask VTK."""
        from vtkmodules.vtkParallelCore import vtkMultiProcessController

        self.controller: Any = vtkMultiProcessController.GetGlobalController()
        self.count = self.controller.GetNumberOfProcesses() if self.controller else 1
        self.rank = self.controller.GetLocalProcessId() if self.controller else 0

    def wait(self) -> None:
        """Wait for all ranks."""
        if self.count > 1:
            self.controller.Barrier()

    def meet(self, error: str = "") -> None:
        """Wait for all ranks; raise RuntimeError if one has an ``error``, this rank's own first."""
        from vtkmodules.vtkCommonCore import vtkIntArray
        from vtkmodules.vtkParallelCore import vtkCommunicator

        mine, most = vtkIntArray(), vtkIntArray()
        mine.InsertNextValue(self.rank + 1 if error else 0)
        most.InsertNextValue(0)
        if self.count > 1:
            self.controller.AllReduce(mine, most, vtkCommunicator.MAX_OP)
        if error or most.GetValue(0):
            raise RuntimeError(error or f"rank {most.GetValue(0) - 1} has failed")
