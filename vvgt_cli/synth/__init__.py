"""Synthetic volumes; importing this package registers them as ``example:`` sources."""

from vvgt_cli.synth.sources import open_volume

__all__ = ["open_volume"]
