"""What small conversions in tests are spared; tests that compare with vvgt in a process of its own undo it."""

from importlib import import_module

MARCH = "vvgt_cli.closed_form.closed_form.MARCH_SIZE"


def spare() -> None:
    """Score at a file's size and twice that, not for a 4K screen; march visibility through 32 px, not 128."""
    for name in ("conversion.stages.scores", "commands.report", "commands.check_splats"):
        import_module(f"vvgt_cli.{name}").screens = lambda size: [(size, 40.0), (2 * size, 40.0)]
    evaluate = import_module("vvgt_cli.commands.evaluate")
    evaluate.viewing_conditions = lambda size: [(size, 40.0), (size, 10.0)]
    import_module("vvgt_cli.closed_form.closed_form").MARCH_SIZE = 32
