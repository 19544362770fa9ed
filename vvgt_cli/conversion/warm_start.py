"""What a conversion starts from: the frame before it in a series, or the same volume under another look."""

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
        """Make the Gaussians of ``work`` from the earlier ones, and return whether they are as good as new ones.

        Where they are not, ``work`` is as it was.
        """

    def views(self, views: ViewRenderer) -> ViewRenderer:
        """Return the views to convert by, which may remember what they draw."""
        return views

    def keep(self, work: Work, plan: Plan) -> None:  # noqa: B027
        """Remember a conversion that did not start from another."""

    def facts(self) -> dict[str, Any]:
        """Return what an index says of the last conversion."""
        return {}

    def memory(self, plan: Plan, fit: FitOptions) -> tuple[int, Callable[[Workload], float]]:
        """Return the bytes that it will keep: of pictures, and, given a workload, of Gaussians."""
        return 0, lambda _: 0.0
