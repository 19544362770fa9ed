"""The single-token mutants of a source file, for `tests/mutants.py`.

Only code that computes: function bodies without docstrings, annotations, strings, calls that print (`TEXTS`), `raise`
statements and `__repr__`.
"""

import ast
import io
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ARITHMETIC = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "//"), ast.Pow: ("**", "*"), ast.LShift: ("<<", ">>"), ast.RShift: (">>", "<<"),
    ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"), ast.BitXor: ("^", "&"),
}  # fmt: skip
COMPARISONS = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"), ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"), ast.In: ("in", "not in"),
}  # fmt: skip
NAMES = {"min": "max", "minimum": "maximum", "any": "all", "floor": "ceil", "argmin": "argmax", "sin": "cos"}
NAMES |= {new: old for old, new in NAMES.items()}
TEXTS = {"say", "warn", "warn_once", "echo", "print", "progress", "note", "psnr_note", "texture_note", "debug", "info"}


@dataclass(frozen=True)
class Site:
    """One mutant: ``old`` at a place of ``path`` becomes ``new``; line from 1, column from 0, in characters."""

    path: str
    line: int
    column: int
    old: str
    new: str
    function: str

    @property
    def name(self) -> str:
        return f"{self.path}:{self.line}:{self.column}"

    def apply(self, source: str) -> str:
        """The mutated source."""
        lines = source.splitlines(keepends=True)
        text = lines[self.line - 1]
        assert text.startswith(self.old, self.column), f"{self.name} is not {self.old!r}"
        lines[self.line - 1] = text[: self.column] + self.new + text[self.column + len(self.old) :]
        return "".join(lines)


class Finder(ast.NodeVisitor):
    """Collects a file's sites as (line, column, old, new, function)."""

    def __init__(self, path: str, source: str) -> None:
        self.path, self.names, self.found = path, list[str](), list[Site]()
        self.tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))
        self.lines = source.splitlines()

    def add(self, place: tuple[int, int], old: str, new: str) -> None:
        self.found.append(Site(self.path, *place, old, new, ".".join(self.names)))

    def between(self, left: ast.expr, right: ast.expr, old: str, new: str) -> None:
        """The token ``old`` between two operands, brackets aside."""
        start, stop = self.characters(left.end_lineno, left.end_col_offset), self.start(right)
        for token in self.tokens:
            if start <= token.start < stop and token.string == old:
                return self.add(token.start, old, new)
        return None

    def characters(self, line: int | None, column: int | None) -> tuple[int, int]:
        """A place in characters; `ast` counts bytes."""
        assert line is not None
        return line, len(self.lines[line - 1].encode()[:column].decode())

    def start(self, node: ast.expr) -> tuple[int, int]:
        return self.characters(node.lineno, node.col_offset)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if node.name in ("__repr__", "__str__"):
            return
        self.names += [node.name]
        for statement in node.body:
            self.visit(statement)
        self.names.pop()

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        inside = bool(self.names)
        self.names += [node.name]
        for statement in node.body:
            if inside or isinstance(statement, ast.FunctionDef | ast.ClassDef):
                self.visit(statement)
        self.names.pop()

    def visit_Module(self, node: ast.Module) -> None:
        for statement in node.body:
            if isinstance(statement, ast.FunctionDef | ast.ClassDef):
                self.visit(statement)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value:
            self.visit(node.value)

    def visit_Raise(self, node: ast.Raise) -> None:
        """What is said and why does not compute."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """A text."""

    def visit_Lambda(self, node: ast.Lambda) -> None:
        self.visit(node.body)

    def visit_Call(self, node: ast.Call) -> None:
        called = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
        if called.lstrip("_") in TEXTS:
            return
        if called in NAMES and isinstance(node.func, ast.Name):
            self.add(self.start(node.func), called, NAMES[called])
        elif called in NAMES:
            line, end = self.characters(node.func.end_lineno, node.func.end_col_offset)
            self.add((line, end - len(called)), called, NAMES[called])
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        text = any(isinstance(n, ast.JoinedStr) or isinstance(getattr(n, "value", None), str | bytes)
                   for n in (node.left, node.right))  # fmt: skip
        if type(node.op) in ARITHMETIC and not text:
            self.between(node.left, node.right, *ARITHMETIC[type(node.op)])
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        old, new = ARITHMETIC.get(type(node.op), ("", ""))
        if old and not isinstance(getattr(node.value, "value", None), str | bytes):
            self.between(node.target, node.value, f"{old}=", f"{new}=")
        self.visit(node.value)

    def visit_Compare(self, node: ast.Compare) -> None:
        for left, operator, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
            if type(operator) in COMPARISONS:
                self.between(left, right, *COMPARISONS[type(operator)])
            elif isinstance(operator, ast.IsNot | ast.NotIn):
                self.between(left, right, "not", "")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        for left, right in zip(node.values, node.values[1:], strict=False):
            self.between(left, right, old, new)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub):
            self.add(self.start(node), "-", "+")
        elif isinstance(node.op, ast.Not):
            self.add(self.start(node), "not", "")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        old = self.lines[node.lineno - 1].encode()[node.col_offset : node.end_col_offset].decode()
        if isinstance(value, bool):
            self.add(self.start(node), old, str(not value))
        elif isinstance(value, int):
            self.add(self.start(node), old, str(value + 1))
        elif isinstance(value, float):
            self.add(self.start(node), old, repr(0.8 * value if value else 0.1))


def sites(root: Path, path: Path) -> Iterator[Site]:
    """All mutants of a file, in the order of the source."""
    source = path.read_text("utf-8")
    finder = Finder(path.relative_to(root).as_posix(), source)
    finder.visit(ast.parse(source))
    yield from sorted(finder.found, key=lambda site: (site.line, site.column))
