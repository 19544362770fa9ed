"""File formats of other programs for Gaussians, and the page that shows them."""

from vvgt_cli.gaussians.formats.choose import (
    ENDINGS,
    SUFFIXES,
    Format,
    encoded,
    format_of,
    is_page,
    is_splats,
    read_columns,
    read_splats,
    ready,
)

__all__ = ["ENDINGS", "SUFFIXES", "Format", "encoded", "format_of", "is_page"]
__all__ += ["is_splats", "read_columns", "read_splats", "ready"]
