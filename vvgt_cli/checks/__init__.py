"""Cases of `vvgt check`: a measured figure, its limit, and the outcome."""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass


class CheckError(Exception):
    """A requirement of a case that does not hold."""


@dataclass(frozen=True)
class Figure:
    """A measured number and the largest that passes."""

    what: str
    value: float
    limit: float


@dataclass(frozen=True)
class Case:
    """A case.

    Attributes:
        stage: part of the program or of a file that it tests.
        name: one line.
        run: measures the figure; raises if anything else is wrong.
    """

    stage: str
    name: str
    run: Callable[[], Figure]


@dataclass(frozen=True)
class Outcome:
    """Result of running a case.

    Attributes:
        stage, name: of the case.
        passed: whether the figure is within its limit and nothing was raised.
        what, value, limit: the figure; empty and None if there is none.
        problem: one line; empty if the case passed.
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
    """Raise `CheckError` with ``text`` unless ``condition`` holds."""
    if not condition:
        raise CheckError(text)


def run_case(case: Case) -> Outcome:
    """Run a case and return its outcome; any exception becomes its problem."""
    begin = time.perf_counter()
    figure, problem = None, ""
    try:
        figure = case.run()
        if not figure.value <= figure.limit:  # NaN fails too
            problem = f"{figure.what} {figure.value:.3g}, at most {figure.limit:.3g} expected"
    except CheckError as error:
        problem = str(error)
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        problem = f"{type(error).__name__}: {error} ({place.filename.rpartition('/')[2]}:{place.lineno})"
    seconds = time.perf_counter() - begin
    if figure is None:
        return Outcome(case.stage, case.name, False, "", None, None, problem, seconds)
    value = figure.value if math.isfinite(figure.value) else None
    return Outcome(case.stage, case.name, not problem, figure.what, value, figure.limit, problem, seconds)
