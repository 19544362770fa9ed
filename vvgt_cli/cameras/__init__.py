"""Cameras and view sets."""

from vvgt_cli.cameras.blocks import BLOCK, FEW, Blocks, drawn_pixels, picked, spread_blocks
from vvgt_cli.cameras.sets import (
    FIELD_OF_VIEW,
    SET_VIEWS,
    SIZE,
    default_views,
    farthest_cameras,
    fibonacci_views,
    look_at,
    orbit_views,
    pixel_width,
)
from vvgt_cli.cameras.types import Camera, camera_in_box, render_in_box

__all__ = ["BLOCK", "FEW", "FIELD_OF_VIEW", "SET_VIEWS", "SIZE", "Blocks", "Camera", "default_views", "drawn_pixels"]
__all__ += ["farthest_cameras", "fibonacci_views", "look_at", "orbit_views", "picked", "pixel_width", "render_in_box"]
__all__ += ["camera_in_box", "spread_blocks"]
