"""The two errors a user can meet: each message says what was read, what was expected, what to try."""

from collections.abc import Sequence


class VvgtError(Exception):
    """Base of every error that the command line shows as one line.

    ``exit_code`` is the process's exit status: 1 for data, 2 for usage.
    """

    exit_code = 1


class DataError(VvgtError):
    """A file or an array is not what it must be (exit status 1)."""

    exit_code = 1


class DeviceFailed(DataError):
    """The GPU is lost, or has too little memory: the same can be done on the CPU."""


class Unsuitable(DataError):
    """Whole and readable data of which no run can make anything: the same command ends the same way."""


class NothingVisible(Unsuitable):
    """A function that shows nothing of a volume, from any view."""

    def __init__(self, volume: str, function: str) -> None:
        super().__init__(
            f"{volume} under {function}: nothing visible from any view; expected opacity above 0 where the data are "
            "(try 'vvgt tf show TF -o tf.png --volume VOLUME')"
        )


class UsageError(VvgtError):
    """The call itself is wrong: options that contradict, a name that does not exist (exit status 2)."""

    exit_code = 2


class SeveralSteps(UsageError):
    """A file of several time steps and none chosen.

    Attributes:
        steps: how many there are.
        times: of each, in ``unit`` (which may be ""), None where the file does not say.
        names: of each, where the file has any.
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
        super().__init__(
            f"{source}: {steps} {what}; expected one: try --time N (0 to {steps - 1}), or a number in the output of "
            "vvgt convert, as -o 'p_{:02d}.ply', which makes a series of them, or -o p.html, a page of them all"
        )
        self.steps, self.times, self.unit, self.names = steps, times, unit, list(names)


class SeveralArrays(UsageError):
    """A file of several arrays, images or groups and none chosen.

    Attributes:
        option: what chooses one.
        choices: what it may be given.
        names: of them, for people.
    """

    def __init__(self, text: str, option: str, choices: Sequence[str], names: Sequence[str] = ()) -> None:
        super().__init__(text)
        self.option, self.choices, self.names = option, list(choices), list(names or choices)


class SeveralComponents(UsageError):
    """A volume of several components or channels and none chosen.

    Attributes:
        count: how many there are.
        color: they are red, green, blue and perhaps opacity.
        colors: RGB in [0, 1] of each channel, None where the file says none.
        channels: they are channels of a microscope, which are shown together.
        names: of the channels, where they have any.
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
        super().__init__(text)
        self.count, self.color, self.colors, self.channels, self.names = count, color, colors, channels, names
