"""A pytest plugin (``-p mutant_map``) for `tests/mutants.py` that records which tests call which functions.

``MUTANT_MAP`` names the file that is written: {test: [seconds, [functions]]} of the tests that passed, a function as
"path:qualified name". Calls of compiled kernels go unseen.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = f"{ROOT / 'vvgt_cli'}{os.sep}"
called: set[CodeType] = set()
failed: set[str] = set()
found: dict[str, tuple[float, list[str]]] = {}


def see(frame: FrameType, event: str, arg: object) -> None:
    """Trace function: notes what is called, and does not follow its lines."""
    if frame.f_code.co_filename.startswith(PACKAGE):
        called.add(frame.f_code)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    called.clear()
    start = time.perf_counter()
    sys.settrace(see)
    threading.settrace(see)
    try:
        return (yield)
    finally:
        sys.settrace(None)
        threading.settrace(None)  # type: ignore[arg-type]
        names = {f"{Path(c.co_filename).relative_to(ROOT).as_posix()}:{c.co_qualname}" for c in set(called)}
        if item.nodeid not in failed and names:
            found[item.nodeid] = round(time.perf_counter() - start, 2), sorted(names)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if not report.passed:
        failed.add(report.nodeid)


def pytest_sessionfinish() -> None:
    Path(os.environ["MUTANT_MAP"]).write_text(json.dumps(found))
