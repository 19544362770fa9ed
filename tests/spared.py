"""What small conversions in tests are spared; `python -m tests.spared` stands in for `vvgt` in other processes."""

import os
import sys
from importlib import import_module

SCREEN = "VVGT_TEST_SCREEN"  # the default of ``--screen``, for commands that do not take it: `vvgt view`
BUDGET = 1000  # of Gaussians, beside it


def spare() -> None:
    """Score at a file's size and twice that, not 4K; march through 32 px, not 128 (0.3 s a conversion)."""
    for name in ("conversion.stages.scores", "commands.report_runs", "commands.check_splats"):
        import_module(f"vvgt_cli.{name}").screens = lambda size: [(size, 40.0), (2 * size, 40.0)]
    evaluate = import_module("vvgt_cli.commands.evaluation")
    evaluate.viewing_conditions = lambda size: [(size, 40.0), (size, 10.0)]
    import_module("vvgt_cli.closed_form.closed_form").MARCH_SIZE = 32
    import_module("vvgt_cli.commands.converter").START = ("-m", "tests.spared", "converter")


def defaults(screen: int) -> tuple[object, ...]:
    """Return the defaults of a fit, in the order of its options, with another screen and `BUDGET`."""
    usual = import_module("vvgt_cli.conversion.request").FitOptions.__init__.__defaults__
    return (BUDGET, screen, *usual[2:])


if __name__ == "__main__":
    spare()
    if SCREEN in os.environ:
        fit = import_module("vvgt_cli.conversion.request").FitOptions
        fit.__init__.__defaults__ = defaults(int(os.environ[SCREEN]))
    converter = sys.argv[1:2] == ["converter"]
    del sys.argv[1 : 1 + converter]
    import_module("vvgt_cli.commands.converter_process" if converter else "vvgt_cli.commands.main").main()
