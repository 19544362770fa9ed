"""`vvgt export`."""

from __future__ import annotations

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.progress import Console


@shared.command("export", short_help="Export a trained network as a model for infer.")
@click.argument("checkpoint", metavar="CHECKPOINT")
@click.option("-o", "--output", required=True, metavar="DIR", help="Folder to create; its name becomes the model's.")
@click.option(
    "--storage", type=click.Choice(["float32", "float16"]), default="float32", show_default=True,
    help="Storage type of the weights; float16 halves the files, computation stays float32.",
)  # fmt: skip
@shared.overwrite_option
@shared.common_options
def command(checkpoint: str, output: str, storage: str, overwrite: bool, console: Console) -> None:
    """Write the network of CHECKPOINT as two ONNX graphs and a model card.

    Before the folder is created, onnxruntime is compared with torch on random scenes; the largest difference is
    recorded in the card. Requires torch, onnx and onnxscript, of the extra train.

    Example:
      vvgt export run/best.pt -o models/small --storage float16
    """
    import time

    from vvgt_cli.errors import UsageError, pip_install

    try:
        import onnxscript  # noqa: F401
        import torch  # noqa: F401
    except ImportError as error:
        raise UsageError(f"vvgt export needs {error.name}; try: {pip_install('train')}") from None
    from vvgt_cli.network.export import export_model

    began = time.perf_counter()
    card = export_model(checkpoint, output, storage, overwrite)
    size = sum(graph["bytes"] for graph in card.graphs.values())
    console.stage(
        "export",
        time.perf_counter() - began,
        f"{output}: {card.parameters / 1e6:.2f} million weights, {size / 1e6:.1f} MB ({storage}), "
        f"onnxruntime within {card.difference:.0e} of torch",
    )
