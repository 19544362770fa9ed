"""ParaView's plugin: File > Save Data offers "Gaussian splats" (docs/programs.md).

Load it by Tools > Manage Plugins, from where it lies. It starts the ``vvgt`` command with files, because the kernels of
vvgt seldom run in ParaView's Python.

Tried: ParaView 5.11 (Debian)
Enable:
    Tools > Manage Plugins > Load New: {file}, and check "Auto Load".
    If vvgt is not in PATH, set the environment variable VVGT to its path before ParaView starts.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from paraview.util.vtkAlgorithm import VTKPythonAlgorithmBase, smdomain, smproperty, smproxy

ENDINGS = ["html", "ply", "spz", "sog", "glb", "usdc", "usdz"]  # of a .ply, ParaView takes surfaces for itself
ROOT = str(Path(__file__).resolve().parents[2])

sys.path.append(ROOT)  # behind ParaView's own packages, and for these modules alone
try:
    from vvgt_cli.defaults import MAX_GAUSSIANS, STEPS
    from vvgt_cli.integrations.command import Kept, tell
    from vvgt_cli.integrations.paraview_job import Job
    from vvgt_cli.integrations.paraview_ranks import Ranks
finally:
    sys.path.remove(ROOT)


def _pipeline() -> Any:
    """Return the class that holds the keys of requests."""
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline

    return vtkStreamingDemandDrivenPipeline


DATA = ["vtkImageData", "vtkRectilinearGrid", "vtkStructuredGrid", "vtkUnstructuredGrid", "vtkCompositeDataSet"]


@smproxy.writer(extensions=ENDINGS, file_description="Gaussian splats", support_reload=False, supports_parallel="1")
@smproperty.input(name="Input", port_index=0)
@smdomain.datatype(dataTypes=DATA, composite_data_supported=True)
class GaussianSplatWriter(VTKPythonAlgorithmBase):
    """A writer that converts its input as the active view draws it."""

    def __init__(self) -> None:
        """Set what ParaView shows as defaults."""
        super().__init__(nInputPorts=1, nOutputPorts=0, inputType="vtkDataObject")
        self.options: dict[str, Any] = dict.fromkeys(("Live", "Light", "AllSteps"), 0)
        self.options |= {"Gaussians": MAX_GAUSSIANS, "Steps": STEPS, "Function": ""}
        self.name, self.step, self.times = "", 0, list[float]()
        self.job: Job | None = None
        self.vvgt = Kept()

    @smproperty.stringvector(name="FileName", panel_visibility="never")
    @smdomain.filelist()
    def SetFileName(self, name: str) -> None:
        """Set the file, whose ending is the format."""
        self.name = name
        self.Modified()

    @smproperty.intvector(name="MaximumGaussians", default_values=MAX_GAUSSIANS)
    def SetMaximumGaussians(self, count: int) -> None:
        """Set --max-gaussians."""
        self._set("Gaussians", count)

    @smproperty.intvector(name="Steps", default_values=STEPS)
    def SetSteps(self, count: int) -> None:
        """Set --steps."""
        self._set("Steps", count)

    @smproperty.xml("""<IntVectorProperty name="Live" command="SetLive" default_values="0" number_of_elements="1">
        <BooleanDomain name="bool"/></IntVectorProperty>""")
    def SetLive(self, live: int) -> None:
        """Set --live."""
        self._set("Live", live)

    @smproperty.xml("""<IntVectorProperty name="Light" command="SetLight" default_values="0" number_of_elements="1">
        <EnumerationDomain name="enum"><Entry value="0" text="as drawn"/><Entry value="1" text="none"/>
        <Entry value="2" text="headlight"/></EnumerationDomain></IntVectorProperty>""")
    def SetLight(self, light: int) -> None:
        """Set the number of a light: as drawn, none, headlight."""
        self._set("Light", light)

    @smproperty.stringvector(name="Function", default_values="")
    def SetFunction(self, path: str) -> None:
        """Set --tf, a file or name, in place of the view's function; needed where there is no view."""
        self._set("Function", path or "")

    @smproperty.xml("""<IntVectorProperty name="WriteTimeSteps" command="SetWriteTimeSteps" default_values="0"
        number_of_elements="1"><BooleanDomain name="bool"/></IntVectorProperty>""")
    def SetWriteTimeSteps(self, every: int) -> None:
        """Set whether all time steps are written."""
        self._set("AllSteps", every)

    def _set(self, name: str, value: Any) -> None:
        self.options[name] = value
        self.Modified()

    def Write(self) -> None:
        """Write the file; called by ParaView."""
        self.Modified()
        self.Update()

    def RequestInformation(self, request: Any, inputs: Any, outputs: Any) -> int:
        """Take the input's time steps, if all are asked for."""
        info, pipeline = inputs[0].GetInformationObject(0), _pipeline()
        every = info.Get(pipeline.TIME_STEPS()) if info.Has(pipeline.TIME_STEPS()) else ()
        self.times = list(every) if self.options["AllSteps"] and len(every) > 1 else []
        return 1

    def RequestUpdateExtent(self, request: Any, inputs: Any, outputs: Any) -> int:
        """Ask for the next time step, and for this rank's piece."""
        info, pipeline, ranks = inputs[0].GetInformationObject(0), _pipeline(), Ranks()
        if self.times:
            info.Set(pipeline.UPDATE_TIME_STEP(), self.times[self.step])
        info.Set(pipeline.UPDATE_NUMBER_OF_PIECES(), ranks.count)
        info.Set(pipeline.UPDATE_PIECE_NUMBER(), ranks.rank)
        return 1

    def RequestData(self, request: Any, inputs: Any, outputs: Any) -> int:
        """Save one time step; convert behind the last."""
        from vtkmodules.vtkCommonDataModel import vtkDataObject

        pipeline = _pipeline()
        try:
            if self.step == 0:
                self.job = None
                self.job = Job(self.name, self.options, self.GetInputAlgorithm(0, 0), self.vvgt)
            assert self.job is not None
            data = vtkDataObject.GetData(inputs[0].GetInformationObject(0))
            self.job.save(data, self.times[self.step] if self.times else 0.0)
            self.step += 1
            if self.step < len(self.times):
                request.Set(pipeline.CONTINUE_EXECUTING(), 1)
                return 1
            self.job.convert()
        except (RuntimeError, OSError, ValueError, KeyError) as error:
            tell(str(error), failed=True)
        request.Remove(pipeline.CONTINUE_EXECUTING())
        self.step = 0
        if self.job is not None:
            self.job.end()
        self.vvgt.close()
        return 1
