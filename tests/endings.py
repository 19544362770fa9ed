"""Endings of files of Gaussians in files of other programs, which cannot read our table; `make formats` writes them."""

import re
from pathlib import Path

from vvgt_cli.gaussians.formats import ENDINGS

ROOT = Path(__file__).parent.parent
PATTERNS = [f"*{ending}" for ending in ENDINGS]
TOLD = [ending.replace(".ply", ".splats.ply") for ending in ENDINGS]  # where other .ply are surfaces
LISTS = (  # file, what stands before the list and after it, the list
    ("vvgt_cli/integrations/blender/gaussian_splats/__init__.py", 'NAMES = "', '"', ";".join(PATTERNS)),
    ("vvgt_cli/integrations/slicer/GaussianSplats.py", '"Gaussian splats (', ')"]', " ".join(PATTERNS[1:])),
    ("vvgt_cli/integrations/napari.yaml", "filename_extensions: [", "]", ", ".join(f'"{one}"' for one in TOLD)),
    ("vvgt_cli/integrations/paraview_plugin.py", "ENDINGS = [", "]", ", ".join(f'"{one[1:]}"' for one in ENDINGS)),
    ("docs/programs.md", 'then offers "Gaussian splats" (', ")", ", ".join(f"`{one}`" for one in ENDINGS)),
    ("docs/programs.md", "File > Import > Gaussian splats* reads ", ", all but", ", ".join(f"`{e}`" for e in ENDINGS)),
    ("docs/programs.md", 'offers "Gaussian splats files" (', ")", ", ".join(f"`{one}`" for one in TOLD)),
)


def written(file: str, before: str, after: str, endings: str) -> str:
    """Text of a file with the list as it is to be."""
    pattern = re.compile(f"(?<={re.escape(before)})[^\n]*?(?={re.escape(after)})")
    text, number = pattern.subn(endings, (ROOT / file).read_text("utf-8"))
    assert number == 1, file
    return text


if __name__ == "__main__":
    for row in LISTS:
        (ROOT / row[0]).write_text(written(*row), "utf-8")
