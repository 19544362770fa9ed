"""`vvgt train`."""

from __future__ import annotations

import click

from vvgt_cli.cli.options import common_options
from vvgt_cli.progress import Console


@click.command("train", short_help="Train the network on volumes.")
@click.option("--data", required=True, metavar="DIR", help="Volumes in DIR/train and DIR/held; scenes to DIR/scenes.")
@click.option("-o", "--output", required=True, metavar="RUN", help="Folder of the run: made, or gone on with.")
@click.option("--config", "path", metavar="FILE.yaml", help="What differs from the defaults, or a run's config.yaml.")
@common_options
def command(data: str, output: str, path: str | None, console: Console) -> None:
    """Train a network on scenes made of the volumes in DIR, and keep what is best on held-out ones.

    A scene is a volume under one of ten suggested functions, with views of it and the Gaussians of the closed form;
    scenes are made first, once for all runs with the same scene settings. RUN gets config.yaml, metrics.csv (a row a
    step), held.csv (a row a look at held-out volumes and functions), last.pt and best.pt; tensorboard/ where
    TensorBoard is installed.

    After SIGTERM or Ctrl-C the step is finished and saved; the same command goes on from there, to the same weights.
    Several processes: torchrun --nproc-per-node N -m vvgt_cli.cli.main train ... shares out the scenes of a step.
    Needs torch and PyYAML: install vvgt[train].

    \b
    Example:
      mkdir -p data/train data/held
      vvgt synth shells --seed 1 -o data/train/shells_1.nrrd
      vvgt synth isotropic --seed 2 -o data/held/isotropic_2.nrrd
      vvgt train --data data -o run
      vvgt export run/best.pt -o models/mine
    """
    import sys

    from vvgt_cli.cli.process import ending
    from vvgt_cli.errors import UsageError

    try:
        import torch  # noqa: F401
        import yaml  # noqa: F401
    except ImportError as error:
        raise UsageError(f"vvgt train needs {error.name}; install vvgt[train]") from None
    from vvgt_cli.training.config import TrainConfig, read_config
    from vvgt_cli.training.loop import train

    with ending() as ended:
        status = train(read_config(path) if path else TrainConfig(), data, output, console, ended)
    if status:
        sys.exit(status)
