"""Python in processes of its own, which tests/conftest.py tells where the package is."""

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

VVGT = ("-m", "tests.spared")


def start(*words: object, variables: dict[str, str] | None = None, **how: Any) -> subprocess.Popen:
    """Start Python with these words and more variables; its talk is text in pipes, unless ``how`` says otherwise."""
    usual = {"env": os.environ | (variables or {}), "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, *map(str, words)], **(usual | how))


def python(*words: object, code: int = 0, given: Any = None, **how: Any) -> tuple[Any, Any]:
    """Run Python to its end, with ``given`` at its standard input; check the exit status, return output and errors."""
    process = start(*words, stdin=subprocess.PIPE, **how)
    out, err = process.communicate(given, timeout=900)
    assert process.returncode == code, err
    return out, err


def replaced(line: Sequence[object], *change: object) -> list[object]:
    """A command line in which the options of ``change`` take the place of those of the same names."""
    words = [part for word in line for part in (word.split() if str(word).startswith("--") else [word])]
    kept, keep = [], True
    for word in words:
        keep = word not in change if re.match("--?[a-z]", str(word)) else keep
        kept += [word] if keep else []
    return [*kept, *change]
