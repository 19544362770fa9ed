"""Volumes and their readers."""

from vvgt_cli.volume.types import UnitFrame, Volume

__all__ = ["UnitFrame", "Volume"]
