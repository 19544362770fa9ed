"""`vvgt train`."""

from __future__ import annotations

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.progress import Console


@shared.command("train", short_help="Train the network on volumes.")
@click.option(
    "--data", required=True, metavar="DIR",
    help="Folder with volumes in DIR/train and DIR/held; scenes are cached in DIR/scenes.",
)  # fmt: skip
@click.option("-o", "--output", required=True, metavar="RUN", help="Folder of the run, created or resumed.")
@click.option(
    "--config", "path", metavar="FILE.yaml", help="Settings that differ from the defaults, or a run's config.yaml."
)
@shared.common_options
def command(data: str, output: str, path: str | None, console: Console) -> None:
    """Train a network on scenes made from the volumes in DIR, keeping the best on held-out scenes.

    A scene is a volume with one of ten suggested functions, views of it, and the Gaussians of the closed form. Scenes
    are made first and reused by all runs with the same scene settings. RUN gets config.yaml, metrics.csv (one row per
    step), held.csv (one row per evaluation), last.pt, best.pt, and tensorboard/ if TensorBoard is installed.

    After SIGTERM or Ctrl-C the current step is saved; run the same command again to resume with identical results. To
    use several processes: torchrun --nproc-per-node N -m vvgt_cli.commands.main train ... Requires torch and PyYAML,
    of the extra train.

    Example:
      mkdir -p data/train data/held
      vvgt synth shells --seed 1 -o data/train/shells_1.nrrd
      vvgt synth isotropic --seed 2 -o data/held/isotropic_2.nrrd
      vvgt train --data data -o run
      vvgt export run/best.pt -o models/mine
    """
    import sys

    from vvgt_cli.commands.process import ending
    from vvgt_cli.errors import UsageError, pip_install

    try:
        import torch  # noqa: F401
        import yaml  # noqa: F401
    except ImportError as error:
        raise UsageError(f"vvgt train needs {error.name}; try: {pip_install('train')}") from None
    from vvgt_cli.network.training.config import TrainConfig, read_config
    from vvgt_cli.network.training.loop import train

    with ending() as ended:
        status = train(read_config(path) if path else TrainConfig(), data, output, console, ended)
    if status:
        sys.exit(status)
