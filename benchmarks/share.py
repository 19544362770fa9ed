"""What other formats of Gaussians cost in bytes and in dB, and the gallery's pictures.

python benchmarks/share.py SCENES.tsv DATA FUNCTIONS FILES -o docs/share.csv [--pictures docs/gallery]
python benchmarks/share.py --table docs/share.csv

FILES is a folder with a NAME.ply of each scene, as `vvgt convert` makes it; scenes without one are passed over.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
from dvr_scenes import print_table, read_scenes, write_rows

from vvgt_cli.cameras import default_views
from vvgt_cli.conversion.gaussian_files import file_rule, layout_of, open_gaussians
from vvgt_cli.conversion.place import to_box_frame, upright_axes
from vvgt_cli.dvr import Scene
from vvgt_cli.errors import DataError
from vvgt_cli.field.source import StyledVolume
from vvgt_cli.gaussians import Gaussians, in_unit_frame
from vvgt_cli.gaussians.formats import FORMATS, encoded, read_splats
from vvgt_cli.gaussians.rules import Rule
from vvgt_cli.score.views import preview, score_test_views

PICTURED, EDGE, QUALITY = 4, 360, 88  # test view from the side, pixels of a picture, of JPEG


def score(source: StyledVolume, scene: Scene, gaussians: Gaussians, size: int, rule: Rule) -> float:
    """PSNR on three test views, dB."""
    inside = to_box_frame(gaussians, source.volume)
    return score_test_views(scene, inside, size, rule=rule, every=False).psnr


def rows(name: str, source: StyledVolume, scene: Scene, path: Path) -> Iterator[dict[str, Any]]:
    """A row a format that can be written here."""
    gaussians, header = open_gaussians(str(path))
    rule, size, layout = file_rule(header), header.screen_size or 400, layout_of(header)
    best = score(source, scene, gaussians, size, rule)
    yield {"scene": name, "format": ".ply", "megabytes": path.stat().st_size / 1e6, "psnr": best, "cost": 0.0}
    for known in FORMATS:
        target = path.with_name(f"written-{name}{known.suffix}")
        try:
            target.write_bytes(encoded(known, gaussians, layout, target.name))
        except DataError as error:
            print(error)
            continue
        psnr = score(source, scene, in_unit_frame(*read_splats(target)), size, rule)
        megabytes = target.stat().st_size / 1e6
        yield {"scene": name, "format": known.suffix, "megabytes": megabytes, "psnr": psnr, "cost": best - psnr}


def picture(source: StyledVolume, scene: Scene, path: Path, target: Path) -> None:
    """Volume, splats and eight times their difference from the side, as JPEG."""
    from PIL import Image

    gaussians, header = open_gaussians(str(path))
    axes = upright_axes(source.volume, header.up)
    camera = default_views("test", size=EDGE)[PICTURED]
    size = header.screen_size or EDGE
    sheet = preview(scene, to_box_frame(gaussians, source.volume), [camera], axes, file_rule(header).at(EDGE / size))
    Image.fromarray(np.rint(255 * sheet).astype(np.uint8)).save(target, quality=QUALITY)


@click.command()
@click.argument("inputs", nargs=-1)
@click.option("-o", "--output")
@click.option("--pictures")
@click.option("--table")
def main(inputs: tuple[str, ...], output: str | None, pictures: str | None, table: str | None) -> None:
    if table:
        print_table(table)
        return
    listing, data, functions, files = inputs
    names = tuple(path.stem for path in Path(files).glob("*.ply"))
    found: list[dict[str, Any]] = []
    for name, source in read_scenes(listing, data, functions, names):
        path, scene = Path(files) / f"{name}.ply", source.scene()
        if pictures:
            Path(pictures).mkdir(parents=True, exist_ok=True)
            picture(source, scene, path, Path(pictures) / f"{name}.jpg")
        if output:
            found += rows(name, source, scene, path)
    if output:
        write_rows(output, found)


if __name__ == "__main__":
    main()
