"""Warm starts of a conversion: from the previous frame of a series, or from the same volume under another look."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vvgt_cli.conversion.plan import Plan
    from vvgt_cli.conversion.request import ConvertRequest, FitOptions
    from vvgt_cli.conversion.stage import Work
    from vvgt_cli.field.field import ViewRenderer
    from vvgt_cli.field.workload import Workload


class WarmStart(ABC):
    """Gaussians of an earlier conversion, tried before the closed form."""

    @abstractmethod
    def try_start(self, work: Work, plan: Plan, request: ConvertRequest) -> bool:
        """Derive the Gaussians of ``work`` from the earlier ones, and return whether they are as good as new ones.

        If they are not, ``work`` is reset.
        """

    def renderer(self, views: ViewRenderer) -> ViewRenderer | None:
        """Return the renderer to convert by, which caches pictures of ``views``; None for no other."""
        return None

    def keep(self, work: Work, plan: Plan) -> None:  # noqa: B027
        """Store a conversion that did not start from another."""

    def facts(self) -> dict[str, Any]:
        """Return entries of the index for the last conversion."""
        return {}

    def memory(self, plan: Plan, fit: FitOptions) -> tuple[int, Callable[[Workload], float]]:
        """Return the bytes of pictures that it will keep, and a function of a workload for those of Gaussians."""
        return 0, lambda _: 0.0
