"""Cameras and view sets."""

from vvgt_cli.cameras.sets import default_views, farthest_cameras, fibonacci_views, look_at, orbit_views
from vvgt_cli.cameras.types import Camera

__all__ = ["Camera", "default_views", "farthest_cameras", "fibonacci_views", "look_at", "orbit_views"]
