"""The documentation holds what the program has: a page a command, every option, links that lead somewhere."""

import json
import os
import re
import runpy
from pathlib import Path

import click
import pytest

from tests.test_architecture import SUBPACKAGES
from vvgt_cli.commands.main import COMMANDS, cli
from vvgt_cli.conversion.batch import CANNOT
from vvgt_cli.version import VERSION

ROOT = Path(__file__).parent.parent
SITE = runpy.run_path(str(ROOT / "docs" / "conf.py"))
FOLDERS = [ROOT / "examples", ROOT / "packaging"]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(p for f in FOLDERS for p in f.glob("*.md"))])


def commands():
    """(page name, command) of every command, those of groups with their group's page."""
    context = click.Context(cli)
    for name in COMMANDS:
        command = cli.get_command(context, name)
        if isinstance(command, click.Group):
            yield from ((name, sub) for sub in command.commands.values())
        else:
            yield name, command


def options(command):
    return [
        option
        for parameter in command.params
        if isinstance(parameter, click.Option)
        for option in (*parameter.opts, *parameter.secondary_opts)
    ]


@pytest.mark.parametrize(("page", "command"), list(commands()), ids=lambda value: getattr(value, "name", value))
def test_every_command_has_a_page_on_which_the_site_lists_its_options(page, command):
    text = (ROOT / "docs" / "commands" / f"{page}.md").read_text("utf-8")
    name = page if command.name == page else f"{page} {command.name}"
    place = SITE["OPTIONS"].search(text[text.index(f"# vvgt {name}\n") :])
    assert place[1] == name
    listed = re.findall(r"^```{option} (.*)$", SITE["options"](place), re.M)
    assert sorted(re.findall(r"(?<![\w-])-{1,2}[a-z][\w-]*", " ".join(listed))) == sorted(options(command))
    shown = SITE["examples"](command)
    assert any(line.startswith("vvgt ") for line in shown)
    for example in re.findall(r"^vvgt (.*)$", "\n".join([text, *shown]), re.M):
        for option in re.findall(r"(?<!\S)(--[a-z-]+|-[a-z])(?=\s|$)", example.split(" | ")[0]):
            owner = example.split()[0]
            assert any(option in options(sub) for name, sub in commands() if name == owner), f"{example}: {option}"


def test_the_page_of_convert_gets_the_table_of_what_cannot_be_combined():
    text = (ROOT / "docs" / "commands" / "convert.md").read_text("utf-8")
    rows = [
        row.strip("| ").split(" | ") for row in SITE["combinations"](SITE["COMBINATIONS"].search(text)).splitlines()
    ]
    listed = {(kind, name): reason for kind, names, reason in rows for name in re.findall("`(.*?)`", names)}
    assert listed == {
        (kind, name): SITE["escaped"](reason) for kind, refused in CANNOT.items() for name, reason in refused.items()
    }


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(path):
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", path.read_text("utf-8")):
        if "://" not in target:
            assert (path.parent / target).exists(), target


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_to_sections_find_them(path):
    for target, section in re.findall(r"\]\(([^)#\s]*)#([^)\s]+)\)", path.read_text("utf-8")):
        if "://" not in target:
            text = (path.parent / target if target else path).read_text("utf-8")
            heads = [
                re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in re.findall(r"^#+ (.*)$", text, re.M)
            ]
            assert section in heads, f"{target}#{section}"


def test_the_index_leads_to_every_page():
    pages = SITE["navigation"]((ROOT / "docs" / "index.md").read_text("utf-8")).splitlines()
    for page in [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "commands").glob("*.md")]:
        assert page.name == "index.md" or page.relative_to(ROOT / "docs").with_suffix("").as_posix() in pages, page


def test_files_that_contributors_are_sent_to_are_there():
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    named = re.findall(r"`((?:vvgt_cli|docs|tests|benchmarks)/[\w/.-]+|test_[\w*]+\.py)`", text)
    assert len(named) > 30
    for name in named:
        assert list(ROOT.glob(name if "/" in name else f"tests/{name}")), name


def test_the_map_for_contributors_has_every_subpackage_in_its_order_and_every_test_file():
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    table = text.partition("## Map of the package")[2].partition("\n\n| where")[0]
    assert tuple(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`.*?`) \| ", table, re.M)))) == SUBPACKAGES
    named = {path for name in re.findall(r"`(test_[\w*]+\.py)`", table) for path in ROOT.glob(f"tests/{name}")}
    assert [path.name for path in ROOT.glob("tests/test_*.py") if path not in named] == []


def test_readme_has_the_two_commands_each_on_a_line_with_its_own_set_up():
    lines = [
        line for line in (ROOT / "README.md").read_text("utf-8").splitlines() if line.startswith("python3 -m venv")
    ]
    assert len(lines) == 2
    assert re.search(r"bin/vvgt convert example:\S+ .*-o \S+\.ply", lines[0])
    assert re.search(r"bin/pytest -n 2 --dist loadfile$", lines[1])
    for line in lines:
        assert "-c constraints.txt" in line


def test_examples_are_listed_and_executable_by_bash():
    listed = (ROOT / "examples" / "README.md").read_text("utf-8")
    scripts = sorted(ROOT.glob("examples/*.sh"))
    assert scripts
    for script in scripts:
        assert f"`{script.name}`" in listed
        assert script.read_text().startswith("#!/usr/bin/env bash")
        assert os.access(script, os.X_OK)


def test_every_file_states_the_version_and_keywords_of_the_package():
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    meta, cited = json.loads((ROOT / "codemeta.json").read_text()), (ROOT / "CITATION.cff").read_text()
    assert meta["version"] == VERSION
    assert f"\nversion: {VERSION}\n" in cited
    assert meta["keywords"] == project["keywords"] == re.findall(r"^  - ([\w ]+)$", cited, re.M)
    assert meta["description"] == project["description"]


def test_constraints_pin_every_dependency_of_the_package():
    pins = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line)
    assert all(re.fullmatch(r"[\w.]+", version) for version in pins.values())
    names = {re.sub(r"[-_.]+", "-", name).lower() for name in pins}
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = project["dependencies"] + extras["test"] + extras["docs"]
    for requirement in wanted:
        assert re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", requirement)[0]).lower() in names, requirement


def test_recipes_state_the_version_and_dependencies_of_the_package():
    import tomllib

    import yaml

    requirements = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    wanted = dict(re.match(r"([\w-]+)([^;]*)", requirement).groups() for requirement in requirements)
    recipe = yaml.safe_load((ROOT / "packaging" / "conda" / "recipe.yaml").read_text())
    assert recipe["context"]["version"] == VERSION
    run = dict(line.split(" ") for line in recipe["requirements"]["run"])
    other = {"openexr-python": "OpenEXR", "py-openimageio": "OpenImageIO"}
    assert {other.get(name, name): version for name, version in run.items()} == wanted | {"python": ">=3.11"}

    spack = (ROOT / "packaging" / "spack" / "package.py").read_text()
    assert re.findall(r'(?:version\("|vvgt@)([\d.]+)', spack) == [VERSION, VERSION]
    found = dict(re.findall(r'depends_on\("py-([\w-]+)@([\d.:]+)", type=\("build", "run"\)', spack))
    wheels = dict(re.match(r"([\w-]+)(.*)", text).groups() for text in re.findall(r'"(\w+>=[\d.]+)"', spack))
    ranges = {name: ">=" + text.rstrip(":").replace(":0.68", ",<0.69") for name, text in found.items()}
    assert ranges | wheels == wanted

    docker = [*re.findall(r"^RUN (.*)$", (ROOT / "packaging" / "Dockerfile").read_text(), re.M)]
    post = (ROOT / "packaging" / "vvgt.def").read_text().partition("%post\n")[2].partition("\n\n")[0]
    assert docker[:3] == [line.strip() for line in post.splitlines()][1:]


def test_pictures_of_the_gallery_are_small_and_shown():
    text = (ROOT / "docs" / "gallery.md").read_text("utf-8")
    pictures = sorted((ROOT / "docs" / "gallery").iterdir())
    assert len(pictures) >= 3
    for picture in pictures:
        assert f"(gallery/{picture.name})" in text
        assert picture.stat().st_size < 150_000
