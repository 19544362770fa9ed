"""Files that the server of `vvgt view` offers for streamed SOG: the page, the manifest, and what that names."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from vvgt_cli.commands.live_site import HTML, JSON, SCRIPT
from vvgt_cli.commands.server import Resource
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.page_file import camera, page
from vvgt_cli.gaussians.formats.sog_images import IMAGES, META
from vvgt_cli.gaussians.formats.streamed import MANIFEST, placed, read_manifest


def streamed_resources(file: str) -> dict[str, Resource]:
    """Return the resources by name; "" is the page.

    Raises:
        DataError: not a manifest, or a file that it names is missing.
    """
    manifest, folder = read_manifest(file), Path(file).parent
    resources = {MANIFEST: Resource(JSON, Path(file).read_bytes)}
    for name in manifest["filenames"]:
        if not (folder / name).is_file():
            raise DataError(f"{file}: {folder / name} is missing; expected the whole folder")
        resources[name] = Resource(JSON, (folder / name).read_bytes)
        for image in IMAGES:
            path = (folder / name).with_name(f"{image}.webp")
            resources[f"{name.removesuffix(META)}{path.name}"] = Resource("image/webp", partial(path.read_bytes))
    splats, scale = placed(manifest)
    view = camera(splats)
    view |= {key: [scale * x for x in view[key]] for key in ("position", "target")}
    more: dict[str, Any] = {
        "streamed": True, "camera": view, "outermost": [], "comments": splats.comments,
        "enlarged": scale,
    }  # fmt: skip
    name = Path(file).absolute().parent.name
    text = page(name, splats, [{"name": name, "file": MANIFEST}], SCRIPT, more)
    return resources | {"": Resource(HTML, lambda: text.encode("utf-8"))}
