"""The rules of the house: import order of the subpackages, sizes of files and functions, where heavy imports sit."""

import ast
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

from tests.processes import python
from vvgt_cli.commands.main import COMMANDS

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "vvgt_cli"
SUBPACKAGES = (
    *("version", "errors", "defaults", "resources", "progress", "files", "jit", "volume", "look", "cameras", "images"),
    *("gaussians", "dvr", "device", "splat", "closed_form", "refine", "network", "score", "field"),
    *("conversion", "checks", "library", "commands", "integrations"),
)
HEAVY = {
    *("numba", "vtk", "vtkmodules", "pyvista", "onnxruntime", "torch", "matplotlib", "OpenImageIO", "OpenEXR"),
    *("scipy", "nibabel", "gsplat", "lpips", "tifffile", "h5py", "netCDF4", "zarr", "numcodecs", "pydicom"),
    *("highdicom", "gsply", "pxr", "eccodes", "PIL", "imageio_ffmpeg", "dask", "distributed"),
}
# Modules that hold numba kernels or torch networks: their importers import them inside the functions that call them.
KERNELS = {"numba", "torch"}
MAX_FILE, MAX_FUNCTION = 600, 60
FILES = sorted(PACKAGE.rglob("*.py"))
TESTS = sorted((ROOT / "tests").glob("*.py"))


def dotted(path: Path) -> str:
    """Name of a module, of a package for its ``__init__``."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {dotted(path): path for path in FILES}


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def of_every_file(paths: list[Path]) -> Callable[[Callable[[Path], None]], Callable[[], None]]:
    """Make one test of a rule for a file: a test for each would take longer to collect than to run."""

    def wrap(rule: Callable[[Path], None]) -> Callable[[], None]:
        def test() -> None:
            assert len(paths) > 300
            for path in paths:
                try:
                    rule(path)
                except AssertionError as error:
                    error.add_note(f"in {name(path)}")
                    raise

        return test

    return wrap


def subpackage(module: str) -> str:
    """Subpackage of a dotted module name inside the package; "" for the package itself."""
    return module.split(".")[1] if "." in module else ""


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


def imports(tree: ast.AST) -> Iterator[tuple[ast.stmt, str]]:
    """Every imported module (dotted), anywhere in the file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute here"
            if node.module == "vvgt_cli":
                yield from ((node, f"vvgt_cli.{alias.name}") for alias in node.names)
            else:
                yield node, node.module or ""


def module_level(tree: ast.Module) -> list[ast.stmt]:
    """Statements that run on import, into `if` and `try` but not under TYPE_CHECKING."""
    found: list[ast.stmt] = []
    waiting: list[ast.stmt] = list(tree.body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.If | ast.Try | ast.With | ast.ClassDef):
            waiting += node.body
        found.append(node)
    return found


@of_every_file(FILES)
def test_a_subpackage_imports_only_from_those_before_it(path):
    own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if own == "__init__":
        return
    assert own in SUBPACKAGES, f"{own} is no subpackage"
    for node, module in imports(tree_of(path)):
        if module.split(".")[0] == "vvgt_cli" and (own, module) != ("integrations", "vvgt_cli"):  # its public names
            assert subpackage(module) in SUBPACKAGES, f"line {node.lineno}: {module} is no subpackage"
            assert SUBPACKAGES.index(subpackage(module)) <= SUBPACKAGES.index(own), (
                f"line {node.lineno}: {own} imports {module}"
            )


@of_every_file([path for path in FILES if path.name != "paraview_plugin.py"])  # which only ParaView imports
def test_heavy_imports_sit_where_they_are_used(path):
    tree = tree_of(path)
    top = {id(node) for node in module_level(tree)}
    for node, module in imports(tree):
        package = module.split(".")[0]
        if id(node) in top and package in HEAVY:
            assert package in KERNELS, f"line {node.lineno}: {module} is imported at module level"


def modules_used(tree: ast.Module) -> set[str]:
    """Modules of the package that a file imports: at its top, within functions or for types alone."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {full if full in MODULES else node.module or "" for full in inner}
    return found & set(MODULES)


def circles(graph: dict[str, set[str]]) -> set[str]:
    """Modules that import themselves through others: what is left when those that import none of the rest are gone."""
    left = {module: used - {module} for module, used in graph.items()}
    while leaves := {module for module, used in left.items() if not used & set(left)}:
        left = {module: used for module, used in left.items() if module not in leaves}
    return {module for module in left if module in _within(left, module)}


def _within(graph: dict[str, set[str]], start: str) -> set[str]:
    """Modules that ``start`` imports, at any distance."""
    found: set[str] = set()
    waiting = [start]
    while waiting:
        new = graph[waiting.pop()] & set(graph) - found
        found |= new
        waiting += new
    return found


def test_no_file_imports_in_a_circle():
    graph = {module: modules_used(tree_of(path)) for module, path in MODULES.items()}
    assert sum(map(len, graph.values())) > 500
    assert not circles(graph)
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": set()}) == {"b", "c"}


@of_every_file(FILES)
def test_names_with_an_underscore_stay_in_their_module(path):
    tree = tree_of(path)
    aliases = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vvgt_cli"):
            for alias in node.names:
                assert not alias.name.startswith("_"), f"line {node.lineno}: {alias.name}"
                if f"{node.module}.{alias.name}" in MODULES:
                    aliases.add(alias.asname or alias.name)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in aliases:
            assert not node.attr.startswith("_"), f"line {node.lineno}: {node.value.id}.{node.attr}"


def test_subpackages_and_commands_do_not_import_kernels_at_module_level():
    uses = {}
    for path in FILES:
        top = {id(node) for node in module_level(tree_of(path))}
        dotted = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        uses[dotted] = {module for node, module in imports(tree_of(path)) if id(node) in top}
    kernels = {module for module, used in uses.items() if any(other.split(".")[0] in KERNELS for other in used)}
    heavy = set(kernels)
    while grown := {module for module, used in uses.items() if used & heavy} - heavy:
        heavy |= grown  # what imports a kernel at its top is heavy too
    highest = ("library", "conversion", "commands")
    doors = {module for module in uses if module.endswith("__init__") or module.split(".")[1] in highest}
    assert kernels
    assert not heavy & doors, f"importing {sorted(heavy & doors)} compiles or loads kernels"


@of_every_file(FILES + TESTS)
def test_files_and_functions_are_short(path):
    assert path.read_text("utf-8").count("\n") <= MAX_FILE
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = (node.end_lineno or node.lineno) - node.lineno + 1 - (ast.get_docstring(node) or "").count("\n")
            assert length <= MAX_FUNCTION, f"{node.name}: {length} lines"


@of_every_file(FILES)
def test_every_module_says_what_it_is(path):
    assert ast.get_docstring(tree_of(path))


# The worker that compiles is a program of its own; talk is what `Console` is for.
PROGRAMS = {
    "field/runners.py": {"os._exit", "signal.signal"},
    "integrations/catalyst.py": {"print"},
    "integrations/paraview_job.py": {"print"},
    "jit/worker.py": {"print", "sys.exit", "os._exit"},
    "progress.py": {"print"},
    "volume/vtk/child.py": {"os._exit"},
}
ENDINGS = {"print", "sys.exit", "os._exit", "exit", "quit", "signal.signal", "click.echo"}


@of_every_file(FILES)
def test_nothing_below_the_commands_prints_exits_or_handles_signals(path):
    own = path.relative_to(PACKAGE).as_posix()
    if own.startswith("commands/"):
        return
    calls = {ast.unparse(node.func) for node in ast.walk(tree_of(path)) if isinstance(node, ast.Call)}
    assert not calls & ENDINGS - PROGRAMS.get(own, set())


def loaded(*code: str) -> set[str]:
    """Top-level packages in a fresh interpreter after running the lines."""
    lines = [*code, "import sys", "print(' '.join(sorted({m.split('.')[0] for m in sys.modules})))"]
    return set(python("-c", "\n".join(lines))[0].splitlines()[-1].split())


def test_help_loads_click_and_nothing_heavier():
    calls = (f"assert run({[*command, '--help']}) == 0" for command in ([], *([name] for name in COMMANDS)))
    modules = loaded("from vvgt_cli.commands.main import run", *calls)
    assert "click" in modules
    assert not modules & (HEAVY | {"numpy"})


def test_every_subpackage_imports_without_the_heavy_packages():
    names = [path.parent.name for path in PACKAGE.glob("*/__init__.py")]
    assert not loaded(*(f"import vvgt_cli.{name}" for name in names)) & HEAVY
