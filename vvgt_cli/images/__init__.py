"""Images: reading and writing EXR and PNG, compositing and comparison."""

from vvgt_cli.images.compose import captioned, coarser, contact_sheet, over, side_by_side
from vvgt_cli.images.files import as_png, png_bytes, read_exr, read_png, write_exr, write_png

__all__ = ["as_png", "captioned", "coarser", "contact_sheet", "over", "png_bytes", "read_exr"]
__all__ += ["read_png", "side_by_side", "write_exr", "write_png"]
