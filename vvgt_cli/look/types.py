"""`TransferFunction`: scalar (data value) to colour and opacity per unit distance."""

from __future__ import annotations

from typing import Protocol

import numpy as np


class Named(Protocol):
    """Whatever gives a scene its colours."""

    @property
    def name(self) -> str:
        """For reports."""
        ...


class TransferFunctionLike(Named, Protocol):
    """What the optics need of a transfer function; `TransferFunction` is the one implementation."""

    def opacity(self, x: np.ndarray) -> np.ndarray:
        """Opacity in [0, 1] per unit distance at data values x (n,), float64 -> (n,)."""
        ...

    def color(self, x: np.ndarray) -> np.ndarray:
        """RGB in [0, 1] at data values x (n,), float64 -> (n, 3)."""
        ...

    def node_range(self) -> tuple[float, float]:
        """Smallest and largest node position, data values; beyond it the function is constant."""
        ...
