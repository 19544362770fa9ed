"""Configuration of the documentation's site, which `make docs` builds from the Markdown of the repository.

Only what the pages do not contain is added by the build: the navigation, from the links of the index; options and
examples of a command, in place of its line ``Options and examples: `vvgt NAME --help`.``; the table of options that
cannot be combined; and the docstrings of the library.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from vvgt_cli.commands.main import cli  # noqa: E402
from vvgt_cli.commands.words import SECTIONS  # noqa: E402
from vvgt_cli.conversion.batch import CANNOT  # noqa: E402
from vvgt_cli.version import VERSION  # noqa: E402

project = html_title = "vvgt"
version = release = VERSION
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**.md", "examples/*.md", "models/*.md", "packaging/*.md"]
exclude_patterns = [
    ".*",
    "CODE_OF_CONDUCT.md",
    "SECURITY.md",
    "benchmarks",
    "build",
    "node_modules",
    "out",
    "tests",
    "vvgt_cli",
]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 4
autodoc_typehints = "description"
smartquotes = False
html_theme = "furo"
html_copy_source = False

OPTIONS = re.compile(r"^Options and examples: `vvgt ([a-z -]+) --help`\.$", re.M)
COMBINATIONS = re.compile(r"^Combinations that are refused: .*$", re.M)
LIBRARY = re.compile(r"^Functions and classes: .*$", re.M)


def navigation(text: str) -> str:
    """Return a hidden table of contents for each section of an index, of the pages that the section links to."""
    found = []
    for section in text.split("\n## "):
        title = section.partition("\n")[0].lstrip("# ")
        pages = dict.fromkeys(re.findall(r"\]\(([\w./-]+)\.md\)", section))
        if pages:
            found += ["```{toctree}", ":hidden:", f":caption: {title}", "", *pages, "```", ""]
    return "\n".join(found)


def escaped(text: str) -> str:
    """Return Markdown that shows ``text`` as it is."""
    return re.sub(r"([\\`*_{}<>\[\]|$])", r"\\\1", text)


def examples(command: click.Command) -> list[str]:
    """Return the lines of the examples in a command's help."""
    return [line.strip() for line in re.split(r"Examples?:\n", command.help or "")[-1].strip().splitlines()]


def options(match: re.Match[str]) -> str:
    """Return options and examples of the command that a line names, under the headings that its ``--help`` has."""
    command: click.Command = cli
    for name in match[1].split():
        assert isinstance(command, click.Group)
        command = command.get_command(click.Context(cli), name) or cli
    context = click.Context(command)
    listed = [parameter for parameter in command.params if isinstance(parameter, click.Option)]
    title = {name: title for title, names in SECTIONS.items() for name in names.split()}
    lines = [f"```{{program}} vvgt {match[1]}", "```"]
    for section in ("", *SECTIONS):
        rows = [option.get_help_record(context) for option in listed if title.get(option.name or "", "") == section]
        if section and any(rows):
            lines += ["", f"### {section}"]
        for name, text in filter(None, rows):
            lines += ["", f"```{{option}} {name}", escaped(text), "```"]
    return "\n".join([*lines, "", "```", *examples(command), "```"])


def combinations(match: re.Match[str]) -> str:
    """Return the table of options that a batch or an output does not take, and what to do instead."""
    rows = ["| converted | refused | why, and what to do |", "| --- | --- | --- |"]
    for kind, refused in CANNOT.items():
        for reason in dict.fromkeys(refused.values()):
            names = ", ".join(f"`{option}`" for option, why in refused.items() if why == reason)
            rows.append(f"| {kind} | {names} | {escaped(reason)} |")
    return "\n".join(rows)


def complete(app: Sphinx, page: str, source: list[str]) -> None:
    """Add to a page what is generated."""
    text = COMBINATIONS.sub(combinations, OPTIONS.sub(options, source[0]))
    text = LIBRARY.sub("```{eval-rst}\n.. automodule:: vvgt_cli\n   :members:\n   :imported-members:\n```", text)
    if page == root_doc:
        text += "\n\n" + navigation(text)
    elif page == "docs/log/index":
        text += "\n\n```{toctree}\n:hidden:\n:glob:\n\n*\n```\n"
    source[0] = text


def front_page(app: Sphinx, error: Exception | None) -> None:
    """Lead from the root of the site to its index."""
    if error is None:
        page = f'<!doctype html><meta http-equiv="refresh" content="0; url={root_doc}.html">\n'
        (Path(app.outdir) / "index.html").write_text(page)


def setup(app: Sphinx) -> None:
    """Connect the functions above to the build."""
    app.connect("source-read", complete)
    app.connect("build-finished", front_page)
