"""Seeds of tests/fuzz.py: files of microscopes, and blocks of N5."""

import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path

import microscopes as written
import test_volume_bigdataviewer as views
from fuzz import Seed
from fuzz_seeds import FIXTURES, READ, volume_reader


def microscopes() -> dict[str, list[Seed]]:
    """Of the readers that libraries provide: two channels of two time steps, and one alone."""
    one, several = written.cells(channels=1), written.cells(times=2)
    chosen = volume_reader(component=1, time=1)
    in_blocks = volume_reader(component=0, time=1, stored=True)
    found = {"N5": n5(), "BigDataViewer": bigdataviewer()}
    with tempfile.TemporaryDirectory() as folder:
        ims, czi, packed = (Path(folder) / name for name in ("a.ims", "a.czi", "b.czi"))
        written.write_ims(ims, several)
        written.write_czi(czi, several)
        written.write_czi(packed, several, "zstd1:ExplicitLevel=3;PreProcess=HiLoByteUnpack", tiles=True)
        found["Imaris"] = [Seed("a.ims", ims.read_bytes(), chosen), Seed("b.ims", ims.read_bytes(), in_blocks)]
        found["CZI"] = [
            Seed("a.czi", czi.read_bytes(), chosen),
            Seed("b.czi", packed.read_bytes(), in_blocks),
            Seed("c.czi", packed.read_bytes(), chosen),
        ]
    found["LIF"] = [
        Seed("a.lif", written.lif([("a", several)]), chosen),
        Seed("b.lif", written.lif([("a", one), ("b", several)]), volume_reader(array="b", component=0, time=0)),
    ]
    found["ND2"] = [
        Seed("a.nd2", written.nd2(several), chosen),
        Seed("b.nd2", written.nd2(several), in_blocks),
        Seed("c.nd2", written.nd2(one), READ),
        Seed("d.nd2", written.nd2(several, packed=True), chosen),
    ]
    return found


def bigdataviewer() -> list[Seed]:
    """The XML, whose data stay whole: two channels at two time points, and one view of two tiles."""
    seeds = []
    for kind, tiles in (("hdf5", False), ("n5", True)):
        with tempfile.TemporaryDirectory() as folder:
            xml = Path(views.write(Path(folder), kind, tiles=tiles)).read_bytes()
            files = [path for path in Path(folder).rglob("*") if path.is_file() and path.suffix != ".xml"]
            beside = {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}
        chosen = {"array": "1"} if tiles else {"component": 1}
        seeds += [Seed("a.xml", xml, volume_reader(time=1, stored=tiles, **chosen), beside)]
    return seeds


def n5() -> list[Seed]:
    """Metadata of a store, and blocks of it in every compression."""
    with tarfile.open(FIXTURES / "n5" / "linear.tar.xz") as archive:
        files = {m.name: archive.extractfile(m).read() for m in archive.getmembers() if m.isfile()}  # type: ignore[union-attr]
    seeds = []
    for kind in ("raw", "gzip", "zlib", "bzip2", "xz", "blosc", "zstd"):
        facts = files[f"linear.n5/{kind}/attributes.json"]
        block = files[f"linear.n5/{kind}/0/0/0"]
        seeds += [
            Seed(f"{kind}.json", facts, _store(lambda data, block=block: (data, block))),
            Seed(f"{kind}.block", block, _store(lambda data, facts=facts: (facts, data))),
        ]
    return seeds


def _store(parts: Callable[[bytes], tuple[bytes, bytes]]) -> Callable[[Path], None]:
    """Read a store of one block that is made of the changed file."""

    def read(path: Path) -> None:
        facts, block = parts(path.read_bytes())
        store = path.with_name(path.name + ".n5")
        (store / "0" / "0").mkdir(parents=True, exist_ok=True)
        (store / "attributes.json").write_bytes(facts)
        (store / "0" / "0" / "0").write_bytes(block)
        READ(store)

    return read
