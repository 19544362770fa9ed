"""The pages' commands at sizes that tests have time for; `python -m tests.docs_commands` stands in for `vvgt`."""

import re
import sys
from pathlib import Path

from tests.processes import replaced
from tests.spared import spare
from vvgt_cli.commands.main import run

SIZES = {"convert": "--max-gaussians 200 --screen 48", "init": "--max-gaussians 200", "render": "--size 48"}
SIZES |= {"render-views": "--views 8 --test-views 2 --size 32", "evaluate": "--screen 48 --no-conditions --step 1"}
SIZES |= {"optimize": "--steps 4", "report": "--max-gaussians 200 --screen 48 --steps 2"}
OWN_BUDGET = {"--target-psnr", "--time-budget", "--dry-run", "--live"}


def blocks(page: Path, *languages: str) -> list[tuple[str, str]]:
    """(language, text) of the fenced blocks of a page that are marked with one of ``languages``, in order."""
    found = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text("utf-8"), re.M | re.S)
    return [(language, text) for language, text in found if language in languages]


def small(words: list[str]) -> list[str]:
    """A command line at small sizes, of small volumes."""
    line = ["example:marschner-lobb:16" if word in ("example:frog", "example:channels") else word for word in words]
    if line[0] != "optimize" or "--steps" in line:
        line = replaced(line, *SIZES.get(line[0], "").split())
    return replaced(line, "--steps", "24") if line[0] == "convert" and not OWN_BUDGET & set(line) else line


if __name__ == "__main__":
    spare()
    sys.exit(run(small(sys.argv[1:])))
