"""Errors that users meet; each message says what was read, what was expected, and what to try."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager


def pip_install(extra: str) -> str:
    """Return the command that installs the packages of an extra of vvgt, by their names: no index need have vvgt."""
    from importlib.metadata import PackageNotFoundError, requires

    try:
        lines = requires("vvgt") or []
    except PackageNotFoundError:  # run from a clone
        return f"pip install '.[{extra}]' in the clone"
    found = [line.partition(";")[0].strip() for line in lines if re.search(rf"""extra == ['"]{extra}['"]""", line)]
    return " ".join(["pip install", *(f"'{package}'" for package in found)])


class VvgtError(Exception):
    """The base of every error that the command line prints as one line.

    ``exit_code`` is the process's exit status: 1 for data, 2 for usage.
    """

    exit_code = 1


class DataError(VvgtError):
    """A file or an array with unexpected content (exit status 1)."""

    exit_code = 1


@contextmanager
def naming(what: str) -> Iterator[None]:
    """Put ``what`` and a colon in front of every `DataError` of the block that does not begin with them."""
    try:
        yield
    except DataError as error:
        raise error if str(error).startswith((f"{what}:", f"{what}#")) else DataError(f"{what}: {error}") from None


class DeviceFailed(DataError):
    """The GPU is lost, or has too little memory: the same can be done on the CPU."""


class Unsuitable(DataError):
    """Readable data that cannot be converted: the same command would fail again."""


class NothingVisible(Unsuitable):
    """A volume in which a transfer function shows nothing from any view."""

    def __init__(self, volume: str, function: str) -> None:
        """Build the message from the names of the volume and the function."""
        super().__init__(
            f"{volume} under {function}: nothing visible from any view; expected opacity above 0 where the data are "
            "(try 'vvgt tf show TF -o tf.png --volume VOLUME')"
        )


class UsageError(VvgtError):
    """Incorrect usage, such as contradictory options or unknown names (exit status 2)."""

    exit_code = 2


class NoLiveForm(UsageError):
    """A volume or options without a live form: the same can be converted ordinarily."""


class SeveralSteps(UsageError):
    """A file with several time steps, of which none was chosen.

    Attributes:
        steps: number of time steps.
        times: time of each step in ``unit`` (which may be ""); None where the file has none.
        names: name of each step, where the file has names.
    """

    def __init__(
        self,
        source: str,
        steps: int,
        what: str = "time steps",
        times: Sequence[float] | None = None,
        unit: str = "",
        names: Sequence[str] = (),
    ) -> None:
        """Build the message; ``what`` names the steps."""
        super().__init__(
            f"{source}: {steps} {what}; expected one: try --time N (0 to {steps - 1}), or a number in the output of "
            "vvgt convert, as -o 'p_{:02d}.ply', for a series of all steps, or -o p.html, for a page of all"
        )
        self.steps, self.times, self.unit, self.names = steps, times, unit, list(names)


class SeveralArrays(UsageError):
    """A file with several arrays, images or groups, of which none was chosen.

    Attributes:
        option: the option that chooses one.
        choices: valid values of the option.
        names: readable names of the choices.
    """

    def __init__(self, text: str, option: str, choices: Sequence[str], names: Sequence[str] = ()) -> None:
        """Store the message and the choices."""
        super().__init__(text)
        self.option, self.choices, self.names = option, list(choices), list(names or choices)


class SeveralComponents(UsageError):
    """A volume with several components or channels, of which none was chosen.

    Attributes:
        count: number of components.
        color: whether they are red, green, blue and perhaps opacity.
        colors: RGB in [0, 1] of each channel; None where the file has none.
        channels: whether they are channels of a microscope, which are shown together.
        names: names of the channels, where the file has names.
    """

    def __init__(
        self,
        text: str,
        count: int,
        color: bool = False,
        colors: Sequence[tuple[float, float, float] | None] = (),
        channels: bool = False,
        names: Sequence[str] = (),
    ) -> None:
        """Store the message and what is known of the components."""
        super().__init__(text)
        self.count, self.color, self.colors, self.channels, self.names = count, color, colors, channels, names
