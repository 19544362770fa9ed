"""The stability suite: stiff and extreme cases through every stage, for `vvgt check` and for the tests alike."""

from __future__ import annotations

import importlib
import math
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass

MODULES = (
    "reading",
    "functions",
    "raycast",
    "light",
    "mapping",
    "grids",
    "forward",
    "backward",
    "descent",
    "harmonics",
    "files",
    "network",
    "whole",
    "ways",
)


class BrokenError(Exception):
    """What was expected of a case did not come true."""


@dataclass(frozen=True)
class Figure:
    """A number that a case measured, and the largest that passes."""

    what: str
    value: float
    limit: float


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        stage: which part of the program it goes through.
        name: what is extreme about it, one line.
        run: does it; raises where something other than the figure is wrong.
    """

    stage: str
    name: str
    run: Callable[[], Figure]


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Attributes:
        stage, name: of the case.
        passed: the figure is within its limit and nothing was raised.
        what, value, limit: the figure; empty and None where none was reached.
        problem: one line; empty where it passed.
        seconds: wall time.
    """

    stage: str
    name: str
    passed: bool
    what: str
    value: float | None
    limit: float | None
    problem: str
    seconds: float


def require(condition: object, text: str) -> None:
    """Raise `BrokenError` unless ``condition`` holds."""
    if not condition:
        raise BrokenError(text)


def all_cases() -> Iterator[Case]:
    """Every case, stage by stage, always in the same order."""
    for name in MODULES:
        yield from importlib.import_module(f"vvgt_cli.checks.{name}").cases()


def run_case(case: Case) -> Outcome:
    """Run a case; whatever it raises is its problem."""
    begin = time.perf_counter()
    figure, problem = None, ""
    try:
        figure = case.run()
        if not figure.value <= figure.limit:  # NaN is no pass either
            problem = f"{figure.what} {figure.value:.3g}, at most {figure.limit:.3g} expected"
    except BrokenError as error:
        problem = str(error)
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        problem = f"{type(error).__name__}: {error} ({place.filename.rpartition('/')[2]}:{place.lineno})"
    seconds = time.perf_counter() - begin
    if figure is None:
        return Outcome(case.stage, case.name, False, "", None, None, problem, seconds)
    value = figure.value if math.isfinite(figure.value) else None
    return Outcome(case.stage, case.name, not problem, figure.what, value, figure.limit, problem, seconds)


__all__ = ["BrokenError", "Case", "Figure", "Outcome", "all_cases", "require", "run_case"]
