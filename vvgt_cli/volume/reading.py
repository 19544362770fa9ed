"""What readers of formats use, to be imported from one place."""

from __future__ import annotations

from vvgt_cli.volume.blocks import check_memory, count, data_file, load_block, size_text
from vvgt_cli.volume.components import ArrayInfo, choose, choose_array, listed, magnitude, select_component
from vvgt_cli.volume.headers import MAX_HEADER, HeaderFields, printable, text_of, type_of
from vvgt_cli.volume.libraries import library_errors, need, read_part
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import volume_name
from vvgt_cli.volume.segments import Segment, segments_in
from vvgt_cli.volume.space import metres, one_unit, placed, unit_rows
from vvgt_cli.volume.stored import Slices, Stored
from vvgt_cli.volume.types import DENSITY, FLAT, IDENTITY, Volume, float_dtype, triple, without

__all__ = ["ReadOptions", "Slices", "Stored", "Volume", "check_memory", "count", "data_file", "load_block", "size_text"]
__all__ += ["ArrayInfo", "choose", "choose_array", "listed", "magnitude", "select_component"]
__all__ += ["MAX_HEADER", "HeaderFields", "library_errors", "need", "printable", "read_part", "text_of", "type_of"]
__all__ += ["Segment", "metres", "one_unit", "placed", "segments_in", "unit_rows", "volume_name"]
__all__ += ["DENSITY", "FLAT", "IDENTITY", "float_dtype", "triple", "without"]
