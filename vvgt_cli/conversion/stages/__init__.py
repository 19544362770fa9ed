"""The stages of a conversion and their costs; `vvgt_cli.conversion.plan` chooses among them."""

from vvgt_cli.conversion.stages.cells import BackProjection, CellsByError, Network
from vvgt_cli.conversion.stages.closed_form import ClosedFormStage
from vvgt_cli.conversion.stages.refinement import Refinement
from vvgt_cli.conversion.stages.scores import TestViews, ViewingConditions
from vvgt_cli.conversion.stages.views import CheckViews, TrainingViews

__all__ = ["BackProjection", "CellsByError", "CheckViews", "ClosedFormStage", "Network"]
__all__ += ["Refinement", "TestViews", "TrainingViews", "ViewingConditions"]
