"""A `vvgt` accessor on every xarray.DataArray: `da.vvgt.convert("viridis")`; arrays of Dask stay lazy.

Tried: xarray 2026.9
Enable:
    import vvgt_cli.integrations.xarray
"""

from __future__ import annotations

from typing import Any

import xarray

import vvgt_cli as vvgt


@xarray.register_dataarray_accessor("vvgt")  # type: ignore[no-untyped-call]
class Accessor:
    """The library's functions of a volume (docs/python.md), for the array that they are called on."""

    def __init__(self, array: xarray.DataArray) -> None:
        """Take the array, which is not read."""
        self._array = array

    def convert(self, look: Any = None, **options: Any) -> Any:
        """Convert the array; see `vvgt_cli.convert`. A ``time`` axis needs ``time=N``."""
        return vvgt.convert(self._array, look, **options)

    def render_views(self, look: Any = None, output: Any = None, **options: Any) -> Any:
        """Render calibrated views of the array; see `vvgt_cli.render_views`."""
        return vvgt.render_views(self._array, look, output, **options)

    def session(self, **reading: Any) -> vvgt.Session:
        """Return a session, which reads the array once for several looks; see `vvgt_cli.Session`."""
        return vvgt.Session(self._array, **reading)
