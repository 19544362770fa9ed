"""Gaussians for others: the formats of other programs, a page that shows them, and its server."""

from vvgt_cli.gaussians.formats.choose import (
    SUFFIXES,
    Format,
    encoded,
    format_of,
    is_splats,
    read_columns,
    read_splats,
    ready,
)

__all__ = ["SUFFIXES", "Format", "encoded", "format_of", "is_splats", "read_columns", "read_splats", "ready"]
