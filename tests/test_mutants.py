"""Which changes `tests/mutants.py` makes to a source file."""

import ast
import textwrap
from pathlib import Path

from mutant_sites import sites

SOURCE = '''
"""Text 1 + 2."""
LIMIT = 3


def area(a: float, b: float = 1.0) -> float:
    """Of min(a, b) == 1."""
    if a is not None and b < 0.5:
        raise ValueError(f"{a + b} at {1}", 2)
    print("é", max(a, 1))
    é = np.min([a, -b], axis=0) + (a) * (b)
    return é


class Box:
    size: int = 4

    def __repr__(self):
        return 1

    def empty(self):
        return not self.size or True
'''


def test_only_what_computes_is_changed(tmp_path: Path) -> None:
    path = tmp_path / "a.py"
    path.write_text(SOURCE, "utf-8")
    found = [(s.line, s.old, s.new, s.function) for s in sites(tmp_path, path)]
    assert sorted(found) == sorted([
        (8, "not", "", "area"), (8, "and", "or", "area"), (8, "<", "<=", "area"), (8, "0.5", "0.4", "area"),
        (11, "min", "max", "area"), (11, "-", "+", "area"), (11, "0", "1", "area"), (11, "+", "-", "area"),
        (11, "*", "/", "area"), (22, "not", "", "Box.empty"), (22, "or", "and", "Box.empty"),
        (22, "True", "False", "Box.empty"),
    ])  # fmt: skip
    for site in sites(tmp_path, path):
        mutant = site.apply(SOURCE)
        assert ast.dump(ast.parse(mutant)) != ast.dump(ast.parse(SOURCE))
        assert len(mutant) - len(SOURCE) == len(site.new) - len(site.old)


def test_an_operator_is_that_of_its_operands(tmp_path: Path) -> None:
    path = tmp_path / "a.py"
    source = textwrap.dedent("""
        def f(a, b):
            return (a - (b - 1)) - -b ** 2
    """)
    path.write_text(source)
    changed = {site.apply(source).split("return ")[1].strip() for site in sites(tmp_path, path) if site.old == "-"}
    assert changed == {
        *("(a + (b - 1)) - -b ** 2", "(a - (b + 1)) - -b ** 2", "(a - (b - 1)) + -b ** 2", "(a - (b - 1)) - +b ** 2")
    }
