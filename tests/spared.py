"""What small conversions in tests are spared; `python -m tests.spared` stands in for `vvgt` in other processes."""

from importlib import import_module


def spare() -> None:
    """Score at a file's size and twice that, not 4K; march through 32 px, not 128 (0.3 s a conversion)."""
    for name in ("conversion.stages.scores", "commands.report_runs", "commands.check_splats"):
        import_module(f"vvgt_cli.{name}").screens = lambda size: [(size, 40.0), (2 * size, 40.0)]
    evaluate = import_module("vvgt_cli.commands.evaluation")
    evaluate.viewing_conditions = lambda size: [(size, 40.0), (size, 10.0)]
    import_module("vvgt_cli.closed_form.closed_form").MARCH_SIZE = 32


if __name__ == "__main__":
    spare()
    import_module("vvgt_cli.commands.main").main()
