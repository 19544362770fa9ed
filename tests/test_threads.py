"""The same bytes on any number of threads."""

from tests.processes import VVGT, python


def test_a_conversion_has_the_same_bytes_on_any_number_of_threads(tmp_path):
    line = ["convert", "example:blob:24", "--max-gaussians", "400", "--screen", "64", "--steps", "4", "-q", "--threads"]
    for threads in ("1", "3"):
        python(*VVGT, *line, threads, "-o", f"{threads}.ply", cwd=tmp_path)
    assert (tmp_path / "1.ply").read_bytes() == (tmp_path / "3.ply").read_bytes()
