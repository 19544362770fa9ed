"""A small folder of views that several tests look at."""

from vvgt_cli.commands.main import run

VOLUME, TF = "example:blob:16", "viridis"
SMALL = ("--views", 3, "--test-views", 2, "--size", 24)
BACKGROUND = (1, 0, 0.5)
BASE = ("render-views", VOLUME, "--tf", TF, *SMALL, "--background", *BACKGROUND)


def make_views(tmp_path_factory):
    """The folder, finished; to be read only."""
    folder = tmp_path_factory.mktemp("set") / "views"
    assert run([str(arg) for arg in (*BASE, "-o", folder, "--quiet")]) == 0
    return folder
