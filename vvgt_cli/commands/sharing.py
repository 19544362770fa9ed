"""What leaves with a file of Gaussians, for `vvgt info --sharing`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.formats import is_splats, read_splats
from vvgt_cli.gaussians.formats.page_live import HELD

OURS = ("vvgt ", "SplatRenderMode")
FACE = (
    "shows what the volume shows, such as the face of a head whose skin is visible: --crop, --mask or a function "
    "without skin removes it"
)
LATER = "; other functions can be chosen later, which show what this one hides"


def what_leaves(file: str) -> dict[str, Any]:
    """Return what a file of Gaussians or a page of one cloud holds besides Gaussians: names, places, values.

    Raises:
        DataError: a file that is not valid.
        UsageError: not a file of Gaussians.
    """
    if not is_splats(file):
        raise UsageError(
            f"--sharing {file}: not Gaussians; expected a .ply, a page or another file that 'convert' wrote"
        )
    _, header = read_splats(file)
    layers = () if header.live is None else header.live.layers
    page = Path(file).suffix.lower() == ".html"
    text = Path(file).read_text("utf-8") if page else ""
    live = bool(layers) or f'id="{HELD}-0"' in text
    names = [name for layer in layers for name in (layer.name, *(label.name for label in layer.labels))]
    legend = json.loads(header.legend or "{}")
    scanned = header.space in ("RAS", "LPS")
    made, facts = header.certificate, dict[str, Any](kind="sharing", name=Path(file).name)
    found = {
        "title": header.title, "function": header.function,
        "command": made and made.command, "checksum": made and made.sha256,
        "range": legend.get("values"), "names": [*filter(None, names), *(name for name, _ in legend.get("labels", ()))],
        "place": header.affine and f"position and directions in the {'scanner' if scanned else 'world'}",
        "camera": header.camera and "eye and target in the world",
        "values": live and "data values under each Gaussian, and their histogram",
        "slices": 'id="slices-0"' in text and "of the volume, also of what its look hides",
        "other": [line for line in header.comments if not line.startswith(OURS)],
    }  # fmt: skip
    facts |= {key: value for key, value in found.items() if value}
    facts["picture"] = FACE + LATER * live
    remove = "--no-comments omits all but the picture and the values, --title names it otherwise"
    return facts | {"remove": f"{remove}; positions of --frame world stay"}
