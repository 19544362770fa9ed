"""A `vvgt` accessor on every xarray.DataArray: `da.vvgt.convert("viridis")`; arrays of Dask stay lazy.

Tried: xarray 2026.9
Enable:
    import vvgt_cli.integrations.xarray
"""

from __future__ import annotations

from typing import Any

import xarray

from vvgt_cli.library.functions import convert, render_views
from vvgt_cli.library.session import Session


@xarray.register_dataarray_accessor("vvgt")  # type: ignore[no-untyped-call]
class Accessor:
    """The library's functions of a volume (docs/python.md), for the array that they are called on."""

    def __init__(self, array: xarray.DataArray) -> None:
        """Take the array, which is not read."""
        self._array = array

    def convert(self, look: Any = None, goal: Any = None, **options: Any) -> Any:
        """Convert the array; see `vvgt_cli.convert`. A ``time`` axis needs ``time=N``."""
        return convert(self._array, look, goal, **options)

    def render_views(self, output: Any, **options: Any) -> Any:
        """Render calibrated views of the array; see `vvgt_cli.render_views`."""
        return render_views(self._array, output, **options)

    def session(self, **reading: Any) -> Session:
        """Return a session, which reads the array once for several looks; see `vvgt_cli.Session`."""
        return Session(self._array, **reading)
