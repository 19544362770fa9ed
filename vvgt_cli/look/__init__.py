"""Transfer functions, label tables and lights: read, mapped to the data, drawn, or chosen from the histogram."""

from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.histogram import from_histogram
from vvgt_cli.look.readers import read_transfer_function
from vvgt_cli.look.resolve import check_visible, resolve, unit_distance
from vvgt_cli.look.show import draw

__all__ = ["ColorMap", "PiecewiseOpacity", "TransferFunction", "check_visible", "draw", "from_histogram"]
__all__ += ["read_transfer_function", "resolve", "unit_distance"]
