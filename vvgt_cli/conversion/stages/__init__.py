"""The stages, a file each with what it costs. A new one is a file here and a line in `vvgt_cli.conversion.plan`."""

from vvgt_cli.conversion.stages.back_projection import BackProjection
from vvgt_cli.conversion.stages.cells import CellsByError
from vvgt_cli.conversion.stages.closed_form import ClosedFormStage
from vvgt_cli.conversion.stages.network import Network
from vvgt_cli.conversion.stages.refinement import Refinement
from vvgt_cli.conversion.stages.scores import TestViews, ViewingConditions
from vvgt_cli.conversion.stages.views import CheckViews, TrainingViews

__all__ = [
    "BackProjection",
    "CellsByError",
    "CheckViews",
    "ClosedFormStage",
    "Network",
    "Refinement",
    "TestViews",
    "TrainingViews",
    "ViewingConditions",
]
