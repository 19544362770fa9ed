"""A Catalyst script: a file of Gaussians for each time step of a simulation (docs/programs.md).

It is given to the simulation as it is, and takes its settings from the environment: VVGT_OUTPUT, a file with a
placeholder for the step ("dye_{:04d}.ply"), VVGT_TF, a function, VVGT_GAUSSIANS and VVGT_EVERY, the steps between two
files. The simulation's channel is called "input", or VVGT_CHANNEL.

Tried: ParaView 5.11's Catalyst (Debian)
Enable:
    Give the simulation this script, as its own documentation says: {file}
    export VVGT_OUTPUT='out_{{:04d}}.ply' VVGT_TF=tf.json
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from paraview.simple import TrivialProducer

ROOT = str(Path(__file__).resolve().parents[2])

sys.path.append(ROOT)  # behind ParaView's own packages, and for these modules alone
try:
    from vvgt_cli.integrations.command import Kept, tell
    from vvgt_cli.integrations.paraview_job import Job
finally:
    sys.path.remove(ROOT)

producer = TrivialProducer(registrationName=os.environ.get("VVGT_CHANNEL", "input"))


def _settings() -> tuple[str, int, dict[str, Any]] | None:
    """Return the file's name, the steps between two files, and options; None, and a line that says why, for none."""
    name = os.environ.get("VVGT_OUTPUT", "step_{:06d}.ply")
    function = os.environ.get("VVGT_TF", "")
    try:
        count, every = int(os.environ.get("VVGT_GAUSSIANS", "100000")), int(os.environ.get("VVGT_EVERY", "1"))
        if every < 1 or name.format(0) == name.format(1):
            raise ValueError("expected 1 or more steps, and a place for the step in the file's name, as a_{:06d}.ply")
    except (ValueError, LookupError) as error:
        tell(f"VVGT_OUTPUT={name}, VVGT_EVERY, VVGT_GAUSSIANS: {error}; no file is written", failed=True)
        return None
    return name, every, {"Gaussians": count, "Steps": 0, "Live": 0, "Light": 0, "Function": function}


SETTINGS, VVGT = _settings(), Kept()


def catalyst_execute(info: Any) -> None:
    """Write the file of a time step; each rank hands over its own block."""
    if SETTINGS is None or info.timestep % SETTINGS[1]:
        return
    producer.UpdatePipeline(info.time)
    source = producer.SMProxy.GetClientSideObject()
    name, job = SETTINGS[0].format(info.timestep), None
    try:
        job = Job(name, SETTINGS[2], source, VVGT)
        job.save(source.GetOutputDataObject(0), info.time)
        job.convert()
    except (RuntimeError, OSError, ValueError, KeyError) as error:  # the simulation goes on
        tell(f"{name}: {error}", failed=True)
    if job is not None:
        job.end()
