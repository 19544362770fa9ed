"""Transfer functions: read, put on the data, drawn, or chosen from the histogram."""

from vvgt_cli.transfer.colormap import ColorMap
from vvgt_cli.transfer.function import TransferFunction
from vvgt_cli.transfer.histogram import from_histogram
from vvgt_cli.transfer.opacity import PiecewiseOpacity
from vvgt_cli.transfer.readers import read_transfer_function
from vvgt_cli.transfer.resolve import check_visible, resolve, unit_distance
from vvgt_cli.transfer.show import draw

__all__ = [
    "ColorMap",
    "PiecewiseOpacity",
    "TransferFunction",
    "check_visible",
    "draw",
    "from_histogram",
    "read_transfer_function",
    "resolve",
    "unit_distance",
]
