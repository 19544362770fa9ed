"""Options with several numbers in the forms people write: ``64 64 93``, ``64,64,93`` or ``64x64x93``."""

from __future__ import annotations

import re
from collections.abc import Sequence

from vvgt_cli.errors import UsageError

THREES = {"--dims": "256 256 128", "--spacing": "1 1 2.5", "--background": "1 1 1"}  # with an example each
RANGE = "--tf-range"
_BETWEEN = re.compile(r"[,x×]", re.IGNORECASE)
_LONGEST = 5  # words: 64 x 64 x 93


def expand(args: Sequence[str]) -> list[str]:
    """Return a command line in the declared form: three words for `THREES`, one word ``LO,HI`` for `RANGE`.

    Args:
        args: words of a command line; those after ``--`` are not changed.

    Raises:
        UsageError: an option of `THREES` without three numbers.
    """
    done: list[str] = []
    rest = list(args)
    while rest:
        word = rest.pop(0)
        option, equals, value = word.partition("=")
        if word == "--":
            return [*done, word, *rest]
        if option not in THREES and option != RANGE:
            done.append(word)
            continue
        words = [value, *rest] if equals else rest
        wanted = 2 if option == RANGE else 3
        taken, numbers = _numbers(words, wanted)
        if option == RANGE:
            done += [option, ",".join(numbers)] if numbers else [word]
        elif numbers:
            done += [option, *numbers]
        else:
            given = " ".join(words[:wanted])
            example = THREES[option]
            raise UsageError(
                f"{option} {given}: expected three numbers, as {option} {example} or {option} "
                f"{example.replace(' ', ',')}"
            )
        rest = words[taken:] if numbers else rest
    return done


def _numbers(words: list[str], count: int) -> tuple[int, list[str]]:
    """Return how many words hold ``count`` numbers, and the numbers; (0, []) if the words are something else."""
    found: list[str] = []
    for taken, word in enumerate(words[:_LONGEST], 1):
        parts = [part.strip() for part in _BETWEEN.split(word)]
        if not all(map(_is_number, filter(None, parts))):
            break
        found += filter(None, parts)
        if len(found) == count:
            return taken, found
        if len(found) > count:
            break
    return 0, []


def _is_number(text: str) -> bool:
    return re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", text) is not None
