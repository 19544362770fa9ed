"""Transfer functions, label tables and lights: read, mapped to the data, drawn, or chosen from the histogram."""

from vvgt_cli.look.function import PER_VOXEL, ColorMap, Named, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.histogram import from_histogram
from vvgt_cli.look.labels import AUTO, NO_LABELS, Label, LabelTable, check_labels, hex_color, labels_legend
from vvgt_cli.look.lighting import MATTE, MAX_LIGHT, NONE, Lighting, LightOptions, parse_lighting
from vvgt_cli.look.readers import read_transfer_function
from vvgt_cli.look.resolve import check_visible, resolve, unit_distance
from vvgt_cli.look.show import draw

__all__ = ["AUTO", "MATTE", "MAX_LIGHT", "NONE", "NO_LABELS", "PER_VOXEL", "ColorMap", "Label", "LabelTable"]
__all__ += ["LightOptions", "Lighting", "Named", "PiecewiseOpacity", "TransferFunction"]
__all__ += ["check_labels", "check_visible", "draw", "from_histogram", "hex_color", "labels_legend"]
__all__ += ["parse_lighting", "read_transfer_function", "resolve", "unit_distance"]
