"""`vvgt`: the group of commands, which turns every error into one line and an exit status."""

from __future__ import annotations

import errno
import importlib
import json
import os
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Sequence

import click

from vvgt_cli.commands.process import ENDING, end_on_signals, first_of_group, leave, open_streams, received
from vvgt_cli.commands.words import expand
from vvgt_cli.errors import UsageError, VvgtError
from vvgt_cli.progress import Console, Once
from vvgt_cli.resources import keep_freed_memory, return_freed_memory
from vvgt_cli.version import VERSION

COMMANDS = [  # modules of this subpackage, with underscores
    *("convert", "init", "merge", "optimize", "recolor", "view", "render", "render-views", "voxelize", "evaluate"),
    *("check", "report", "info", "tf", "infer", "export", "train", "synth", "plugin", "warmup"),
]
INTERRUPTED = 130  # 128 + SIGINT, as shells report it
BROKEN_PIPE = 141  # 128 + SIGPIPE
ALONE = 2.0  # seconds after which a process of a group of them tells of an error of its own
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
DEBUG = "VVGT_TRACEBACK"
ENDED = "vvgt: ended: "  # before the status of each of several commands; vvgt_cli/integrations/command.py reads it
noted = [Once()]  # warnings of the current run


class LazyGroup(click.Group):
    """A group that imports a subcommand's module when it is needed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands."""
        return COMMANDS

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return a command, None if there is none of this name."""
        if cmd_name not in COMMANDS:
            return None
        return importlib.import_module(f"vvgt_cli.commands.{cmd_name.replace('-', '_')}").command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command of a command line; suggest similar names for an unknown one."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-"):
            from vvgt_cli.volume.components import expected

            raise UsageError(f"no command {name!r}; {expected(name, COMMANDS, len(COMMANDS))}")
        return super().resolve_command(ctx, args)


def _describe(context: click.Context, parameter: click.Parameter, given: bool) -> None:
    if given:
        from vvgt_cli.commands.slicer import description

        click.echo(description())
        context.exit()


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(VERSION, "-V", "--version", prog_name="vvgt", message="%(prog)s %(version)s")
@click.option(
    "--xml", is_flag=True, is_eager=True, expose_value=False, callback=_describe,
    help="Describe convert as a command-line module of 3D Slicer (docs/programs.md) and exit.",
)  # fmt: skip
def cli() -> None:
    """Convert scientific volumes to 3D Gaussian splats.

    Data goes to standard output, messages to standard error; "-" stands for either stream, for raw values, .ply
    and JSON. Nothing is overwritten without --overwrite. Exit status: 0 success, 1 invalid data, 2 wrong usage, 130
    interrupted.
    """


def _fail(message: str, code: int) -> int:
    if not first_of_group():
        time.sleep(ALONE)  # the first process reports what ends all; torchrun ends the others meanwhile
    print(f"vvgt: error: {' '.join(message.split())}", file=sys.stderr)
    return code


def _note(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning as one line, once of all files of a command (replaces `warnings.showwarning`)."""
    line = " ".join(str(message).split())
    if noted[-1].first(line):
        print(f"vvgt: note: {line}", file=sys.stderr)


def _os_error(error: OSError) -> str:
    what = error.strerror or str(error) or type(error).__name__
    if error.filename:
        return f"{error.filename}: {what}"
    if _stdout_fails() or error.errno in FULL:  # everything else that is written says its name
        return f"standard output: {'it is closed' if error.errno == errno.EBADF else what}"
    return what


def _stdout_fails() -> bool:
    """Return whether standard output cannot be written; keep the interpreter from trying again at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def run(args: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit status; every error is one line on standard error."""
    received.clear()
    noted[:] = [Once()]
    try:
        words, console = list(sys.argv[1:] if args is None else args), Console
        if words[:1] == ["--slicer"]:
            from vvgt_cli.commands.slicer import SlicerConsole, arguments

            words, console = arguments(words[1:]), SlicerConsole
        # not cli.main: it would turn a broken pipe and an interrupt into statuses of its own
        with cli.make_context("vvgt", expand(words), obj=console) as context:
            cli.invoke(context)
        for line in noted[-1].repeated():
            print(f"vvgt: note: {line}", file=sys.stderr)
        sys.stdout.flush()
        return 0
    except BaseException as error:
        if os.environ.get(DEBUG):
            traceback.print_exc()
        return _status(_ended(received[0]) if received else error)


def _ended(number: int) -> BaseException:
    """Return the exception of a signal, whatever a running kernel turned it into."""
    return KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)


def _status(error: BaseException) -> int:
    if isinstance(error, click.exceptions.Exit):  # after --help and --version
        return error.exit_code
    if isinstance(error, click.exceptions.NoArgsIsHelpError):  # a call without a command
        print(error.format_message(), file=sys.stderr)
        return error.exit_code
    if isinstance(error, click.ClickException):
        context = getattr(error, "ctx", None)
        hint = f" (see '{context.command_path} --help')" if context else ""
        return _fail(error.format_message() + hint, error.exit_code)
    if isinstance(error, VvgtError):
        return _fail(str(error), error.exit_code)
    if isinstance(error, BrokenPipeError):
        _stdout_fails()
        return BROKEN_PIPE
    if isinstance(error, OSError):
        return _fail(_os_error(error), 1)
    if isinstance(error, MemoryError):
        return _fail("out of memory: try fewer Gaussians, a smaller --screen, or a smaller volume", 1)
    if isinstance(error, KeyboardInterrupt):
        return _fail("interrupted", INTERRUPTED)
    if isinstance(error, SystemExit):
        code = error.code if isinstance(error.code, int) else 1
        name = next((signal.Signals(number).name for number in ENDING if code == 128 + number), None)
        return _fail(f"ended by {name}", code) if name and first_of_group() else code
    return _fail(f"internal: {type(error).__name__}: {error} (a bug; {DEBUG}=1 shows where)", 1)


def _several() -> int:
    """Run commands, each a line of standard input (a JSON list of words); tell of the status of each.

    For programs that run many (vvgt_cli/integrations/command.py), and are spared the start of each.
    """
    status = 0
    for line in sys.stdin:
        status = run(json.loads(line))
        return_freed_memory()
        if reader := sys.modules.get("vvgt_cli.field.reader"):
            reader.forget()  # files may be written again before the next command
        print(f"{ENDED}{status}", file=sys.stderr, flush=True)
        if received:
            break
    return status


def main() -> None:
    """Run the `vvgt` command and exit."""
    open_streams()
    end_on_signals()
    keep_freed_memory()
    warnings.showwarning = _note
    leave(_several() if sys.argv[1:] == ["--commands"] else run())


if __name__ == "__main__":
    main()
