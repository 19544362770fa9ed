"""Volumes with known structure; importing this package makes them ``example:`` sources."""

from vvgt_cli.synth.sources import open_volume

__all__ = ["open_volume"]
