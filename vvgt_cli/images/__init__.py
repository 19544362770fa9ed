"""Images: reading and writing EXR and PNG, compositing and comparison."""

from vvgt_cli.images.compose import contact_sheet, over, side_by_side
from vvgt_cli.images.exr import read_exr, write_exr
from vvgt_cli.images.png import png_bytes, read_png, write_png

__all__ = ["contact_sheet", "over", "png_bytes", "read_exr", "read_png", "side_by_side", "write_exr", "write_png"]
