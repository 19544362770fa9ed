"""`--help` in sections."""

import re

import click
import pytest

from vvgt_cli.commands.main import COMMANDS, cli
from vvgt_cli.commands.words import SECTIONS, SectionedCommand


def options(command: str) -> list[click.Option]:
    group = click.Context(cli, **cli.context_settings)  # a command keeps the names of the first help that it makes
    found = cli.get_command(group, command)
    assert isinstance(found, SectionedCommand)
    return [option for option in found.get_params(click.Context(found, group)) if isinstance(option, click.Option)]


@pytest.mark.parametrize("command", ["convert", "init", "render-views", "evaluate", "report", "view", "check", "info"])
def test_help_lists_every_option_once_and_the_main_ones_first(command, vvgt):
    text = vvgt(command, "--help").out.decode()
    listed = re.findall(r"^  (--?[a-z].*?)(?:  |$)", text.partition("\nOptions:\n")[2], re.M)
    names = [row.split()[0].strip(",") for row in listed]
    assert sorted(names) == sorted(option.opts[0] for option in options(command))
    heads = re.findall(r"^(\w+):$", text, re.M)
    assert [head for head in heads if head in SECTIONS] == [head for head in SECTIONS if head in heads]
    first = re.findall(r"^  (--?[a-z].*?)(?:  |$)", text.partition("\nOptions:\n")[2].partition("\nInput:\n")[0], re.M)
    assert 2 <= len(first) <= 15


def test_every_name_in_the_sections_is_an_option():
    names = {option.name for command in ("convert", "init", "render-views", "evaluate") for option in options(command)}
    assert not set(" ".join(SECTIONS.values()).split()) - names


def every_command() -> dict[str, click.Command]:
    group = click.Context(cli)
    found = {name: cli.get_command(group, name) for name in COMMANDS}
    inner = {f"tf {name}": one for name, one in found.pop("tf").commands.items()}
    return found | inner


@pytest.mark.parametrize("command", every_command())
def test_an_option_of_one_value_is_given_once(command, vvgt):
    """Also by its short and its long name; repeatable ones, and flags without an opposite, may be repeated."""
    given = [option for option in every_command()[command].params if isinstance(option, click.Option)]
    for option in given:
        words = [[name, *([] if option.is_flag else [value] * option.nargs)] for name, value in
                 ((option.opts[0], "1"), (option.opts[-1], "2"))]  # fmt: skip
        result = vvgt(*command.split(), *words[0], *words[1])
        names = "/".join([*option.opts, *option.secondary_opts])
        one = not (option.multiple or (option.is_flag and not option.secondary_opts))
        values = "" if option.is_flag else ", " + " and ".join(" ".join(word[1:]) for word in words)
        assert (f"{names}: given 2 times{values}; expected one" in result.err) == one
        if one:
            assert result.code == 2
            assert "\n" not in result.error
