"""Mutation tests: ``python tests/mutants.py [--number N] [--seed N] [--only PATH:LINE:COLUMN] [--again]``.

Changes one token of the package at random (`tests/mutant_sites.py`; the same draw for the same seed) and runs the
tests that call the changed function, the most specific first, until one fails. Which tests call a function is recorded
by running every test file once (`tests/mutant_map.py`), and again when the file changes. Where no call is seen, as in
kernels and in other processes, the tests of its callers are run, and the test files that import its module.

Works in copies of the checkout in a temporary folder. Prints a line for each mutant and a summary; all results go to
``OUT/mutants.json``, from which an interrupted run resumes. ``--again`` retries the mutants that no test noticed.
"""

import argparse
import ast
import hashlib
import importlib.util
import itertools
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

from mutant_sites import Site, sites

ROOT = Path(__file__).parent.parent
KERNELS = Path("vvgt_cli", "__pycache__", "kernels")
LEFT_OUT = {"architecture", "benchmarks", "browser", "docs_pages", "fuzz", "jit", "mutants", "viewers"}
MOST_TESTS, MOST_SECONDS = 300, 90.0  # per mutant; seconds as in an unchanged checkout


AGAIN = ("DISTURBED", "NOT NOTICED")


def environment(**more: str) -> dict[str, str]:
    """For tests: one thread each, kernels compiled on demand."""
    threads = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    kept = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    return kept | threads | {"KERNELS_AHEAD": "0", **more}


def file_of(test: str) -> str:
    return test.split("::")[0]


class Tests:
    """Which tests call what.

    Attributes:
        seconds: of every test.
        reach: how many functions a test calls.
        callers: tests of a function ("path:qualified name").
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.seconds: dict[str, float] = {}
        self.reach: dict[str, int] = {}
        self.callers: dict[str, list[str]] = defaultdict(list)

    def learn(self, processes: int) -> None:
        """Record the test files that have changed; read all records."""
        self.folder.mkdir(parents=True, exist_ok=True)
        files = [f for f in sorted(ROOT.glob("tests/test_*.py")) if not LEFT_OUT & {f.stem[5:], f.stem.split("_")[-1]}]
        with ThreadPoolExecutor(processes) as pool:
            for found in pool.map(self._calls, files):
                for test, (seconds, functions) in found.items():
                    self.seconds[test], self.reach[test] = seconds, len(functions)
                    for function in functions:
                        self.callers[function.replace(".<locals>", "")].append(test)

    def _calls(self, file: Path) -> dict[str, Any]:
        kept = self.folder / f"{file.stem}-{hashlib.sha256(file.read_bytes()).hexdigest()[:8]}.json"
        if not kept.exists():
            print(f"recording what {file.name} calls", flush=True)
            for old in self.folder.glob(f"{file.stem}-*.json"):
                old.unlink()
            path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
            command = [sys.executable, "-m", "pytest", "-p", "mutant_map", "-p", "no:cacheprovider", str(file)]
            subprocess.run(
                command, cwd=ROOT, env=environment(PYTHONPATH=path, MUTANT_MAP=str(kept)), capture_output=True
            )
        found: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() else {}
        return found

    @cached_property
    def naming(self) -> dict[str, set[str]]:
        """Functions ("path:qualified name") of the package that use a name."""
        found: dict[str, set[str]] = defaultdict(set)
        for path in (ROOT / "vvgt_cli").rglob("*.py"):
            waiting: list[tuple[str, ast.AST]] = [("", ast.parse(path.read_text("utf-8")))]
            while waiting:
                inside, node = waiting.pop()
                for child in ast.iter_child_nodes(node):
                    within = inside
                    if isinstance(child, ast.FunctionDef | ast.ClassDef):
                        within = f"{inside}.{child.name}".lstrip(".")
                    elif not inside and isinstance(child, ast.Assign) and isinstance(child.targets[0], ast.Name):
                        within = child.targets[0].id  # a function made of others: `_tile = tiles_of(cast)`
                    name = child.id if isinstance(child, ast.Name) else getattr(child, "attr", None)
                    if name and inside:
                        found[name].add(f"{path.relative_to(ROOT).as_posix()}:{inside}")
                    waiting.append((within, child))
        return found

    def of(self, site: Site) -> list[str]:
        """Tests to run, grouped by file: first those of files that import the module or its room, and of these the most
        specific, which call the fewest functions."""
        wanted = {f"{site.path}:{site.function}"}
        seen = set(wanted)
        tests: set[str] = set()
        while wanted:
            unseen = {function for function in wanted if not self.callers.get(function)}
            tests.update(*(self.callers[function] for function in wanted - unseen))
            names = {function.split(":")[1].split(".")[-1] for function in unseen}
            wanted = {function for name in names for function in self.naming.get(name, ())} - seen
            seen |= wanted
        module = site.path.removesuffix(".py").replace("/", ".")
        texts = {f"tests/{file.name}": file.read_text("utf-8") for file in ROOT.glob("tests/test_*.py")}
        naming = {name for name, text in texts.items() if module in text}
        if not self.callers.get(f"{site.path}:{site.function}"):
            tests.update(test for test in self.seconds if file_of(test) in naming)
        room = ".".join(module.split(".")[:2])
        near = {name: (name not in naming) + (room not in text) for name, text in texts.items()}
        order = {test: (near[file_of(test)], self.seconds[test] > 5, self.reach[test]) for test in tests}
        tests_of_file: dict[str, list[str]] = defaultdict(list)
        spent = 0.0
        for test in sorted(tests, key=order.__getitem__)[:MOST_TESTS]:
            spent += self.seconds[test]
            if spent < MOST_SECONDS:
                tests_of_file[file_of(test)].append(test)
        return [test for file in tests_of_file.values() for test in file]


class Copy:
    """A copy of the checkout that mutants are made in, one at a time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        files = subprocess.run(
            ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True
        )
        for name in files.stdout.splitlines():
            if (ROOT / name).exists():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)

    def kernels(self) -> None:
        """Restore those of the checkout: compiling a mutant removes the original's."""
        shutil.rmtree(self.folder / KERNELS, ignore_errors=True)
        shutil.copytree(ROOT / KERNELS, self.folder / KERNELS)

    def run(self, site: Site, tests: list[str], seconds: float) -> dict[str, Any]:
        """Try a mutant.

        A test that fails is run without the mutant too, after the same tests; failing there as well is "DISTURBED".

        Returns:
            {"state": "noticed", "timeout", "DISTURBED" or "NOT NOTICED", "by": the test that failed, "seconds",
            "tests": how many}.
        """
        file = self.folder / site.path
        file.write_text(site.apply(file.read_text("utf-8")), "utf-8")
        start = time.monotonic()
        try:
            state, by = self._attempt(tests, seconds) if tests else ("NOT NOTICED", "")
        finally:
            shutil.copy2(ROOT / site.path, file)
        if by in tests and self._attempt(tests[: tests.index(by) + 1], seconds)[0] != "NOT NOTICED":
            state = "DISTURBED"
        return {"state": state, "by": by, "seconds": round(time.monotonic() - start, 1), "tests": len(tests)}

    def _attempt(self, tests: list[str], seconds: float) -> tuple[str, str]:
        self.kernels()
        command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-rfE", "-p", "no:cacheprovider", *tests]
        try:
            done = self._wait(command, 4 * seconds + 240)
        except subprocess.TimeoutExpired:
            return "timeout", ""
        if not done.returncode:
            return "NOT NOTICED", ""
        failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
        by = next((test for test in tests if any(f" {test} " in f"{line} " for line in failed)), "")
        return "noticed", by or f"exit status {done.returncode}"

    def _wait(self, command: list[str], limit: float) -> subprocess.CompletedProcess[str]:
        env = environment(PYTHONPATH=str(self.folder))
        process = subprocess.Popen(command, cwd=self.folder, env=env, text=True, start_new_session=True,
                                   stdout=subprocess.PIPE, stderr=subprocess.STDOUT)  # fmt: skip
        try:
            out, _ = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, 9)
            process.communicate()
            raise
        return subprocess.CompletedProcess(command, process.returncode, out)


def chosen(number: int, seed: int, only: list[str]) -> list[Site]:
    """The mutants named, or a random ``number`` of all that tests can notice.

    Without torch the modules that import it are skipped.
    """
    paths = sorted((ROOT / "vvgt_cli").rglob("*.py"))
    everywhere = [site for path in paths for site in sites(ROOT, path)]
    if only:
        return [site for site in everywhere if site.name in only]
    random.Random(seed).shuffle(everywhere)
    without = [] if importlib.util.find_spec("torch") else [p for p in paths if "import torch" in p.read_text("utf-8")]
    left_out = {p.relative_to(ROOT).as_posix() for p in without}
    kept = (site for site in everywhere if site.path not in left_out)
    return list(itertools.islice(kept, number))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--number", type=int, default=200, help="how many (200)")
    parser.add_argument("--seed", type=int, default=0, help="of the random choice (0)")
    parser.add_argument("--only", action="append", default=[], metavar="PATH:LINE:COLUMN", help="this one; repeatable")
    parser.add_argument("--again", action="store_true", help="those again that were not noticed")
    parser.add_argument("--processes", type=int, default=2, help="mutants at a time (2)")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "mutants", help="folder (out/mutants)")
    args = parser.parse_args()
    subprocess.run([sys.executable, "-m", "vvgt_cli.commands.main", "warmup"], cwd=ROOT, env=environment(), check=True)
    tests = Tests(args.out / "map")
    tests.learn(args.processes)
    kept = args.out / "mutants.json"
    results: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() else {}
    mutants = chosen(args.number, args.seed, args.only)
    tried = {key for key, result in results.items() if not (args.again and result["state"] in AGAIN)}
    lock = Lock()

    def key(site: Site) -> str:
        line = (ROOT / site.path).read_text("utf-8").splitlines()[site.line - 1]
        return f"{site.path}:{site.function} {line.strip()} {site.column} {site.old} -> {site.new}"

    def work(waiting: list[Site]) -> None:
        with tempfile.TemporaryDirectory(prefix="vvgt-mutants-") as folder:
            copy = Copy(Path(folder))
            while True:
                with lock:
                    if not waiting:
                        return
                    site = waiting.pop(0)
                names = tests.of(site)
                result = copy.run(site, names, sum(tests.seconds[name] for name in names))
                with lock:
                    results[key(site)] = asdict(site) | result
                    kept.write_text(json.dumps(results, indent=1))
                    told = (
                        f"{result['state']} {site.name} {site.old} -> {site.new} {result['by']} {result['seconds']} s"
                    )
                    print(told, flush=True)

    waiting = [site for site in mutants if key(site) not in tried or args.only]
    with ThreadPoolExecutor(args.processes) as pool:
        for done in [pool.submit(work, waiting) for _ in range(args.processes)]:
            done.result()
    states = [results[key(site)]["state"] for site in mutants]
    print(*(f"{states.count(state)} {state}" for state in ("noticed", "timeout", "DISTURBED", "NOT NOTICED")), sep=", ")


if __name__ == "__main__":
    main()
