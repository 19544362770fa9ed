"""The stages of a conversion and their costs, one file each; `vvgt_cli.conversion.plan` chooses among them."""

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
