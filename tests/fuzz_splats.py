"""Seeds of tests/fuzz.py: files of Gaussians."""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fuzz import Seed


def ply() -> list[Seed]:
    from vvgt_cli.gaussians import Gaussians, PlyOptions, describe, read_ply, write_ply

    rng = np.random.default_rng(3)
    shapes = ((4, 3), (4, 3), (4, 4), (4,), (4, 3))
    gaussians = Gaussians(*(rng.standard_normal(shape).astype(np.float32) for shape in shapes))
    world = PlyOptions(frame="world", up="-y", scale=0.5, centre=(1, 2, 3), unit_distance=1.5, sh_degree=1)
    seeds = []
    for name, options in (
        ("a.ply", PlyOptions(comments=False)),
        ("b.ply", world),
    ):
        stream = io.BytesIO()
        write_ply(stream, gaussians, options)
        seeds.append(Seed(name, stream.getvalue(), lambda path: describe(*read_ply(path))))
    return seeds


def others() -> list[Seed]:
    """Files of other programs: compressed ones, without and with a range of colours and harmonics, and `.splat`."""
    from gsply import reader
    from test_gaussians_others import COLORS, GOOD, RANGES, compressed, damaged, splat
    from test_gaussians_others import ply as plain

    from vvgt_cli.gaussians.formats import read_columns, read_splats

    for name in ("_unpack_all_jit", "_unpack_sh_jit"):  # in Python: threads of OpenMP do not survive the fuzzer's forks
        setattr(reader, name, getattr(getattr(reader, name), "py_func", getattr(reader, name)))

    def read(path: Path) -> None:
        read_columns(path)
        read_splats(path)

    shaded = compressed(RANGES + COLORS, elements="sh chunk vertex", sh=9, count=9, chunks=1)
    files = {"a.compressed.ply": compressed(RANGES, count=9, chunks=1), "b.compressed.ply": shaded}
    files |= {"c.splat": splat(GOOD[:9]), "d.ply": plain(damaged())}
    return [Seed(name, content, read) for name, content in files.items()]


def sog() -> list[Seed]:
    """A `.sog`; its images and facts changed one by one, in an archive that is whole; some deflated."""
    from vvgt_cli.gaussians import Gaussians, PlyOptions
    from vvgt_cli.gaussians.formats import encoded, format_of, read_splats

    rng = np.random.default_rng(4)
    shapes = ((6, 3), (6, 3), (6, 4), (6,), (6, 3), (6, 8, 3))
    gaussians = Gaussians(*(rng.standard_normal(shape).astype(np.float32) for shape in shapes))
    whole = encoded(format_of("a.sog"), gaussians, PlyOptions(sh_degree=2), "a.sog")
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}

    def packed(name: str, deflated: bool) -> Callable[[bytes], bytes]:
        def pack(content: bytes) -> bytes:
            stream = io.BytesIO()
            with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED if deflated else zipfile.ZIP_STORED) as archive:
                for other, data in (members | {name: content}).items():
                    archive.writestr(zipfile.ZipInfo(other), data)
            return stream.getvalue()

        return pack

    parts = [
        Seed(f"{k}.sog", data, read_splats, pack=packed(name, k % 2 == 0))
        for k, (name, data) in enumerate(members.items())
    ]
    return [Seed("a.sog", whole, read_splats), *parts]
