"""`tf show`: a transfer function drawn over a histogram."""

from __future__ import annotations

from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.outputs import STDOUT, Output, check_outputs
from vvgt_cli.volume import ReadOptions


def show_transfer_function(
    tf: str, output: str, volume: str | None, read: ReadOptions, tf_range: str, overwrite: bool
) -> None:
    """Draw ``tf`` into a PNG, over the histogram of ``volume`` where one is given.

    Raises:
        UsageError, DataError: an output that may not be written, or inputs that are not what they must be.
    """
    from vvgt_cli.look import draw, read_transfer_function, resolve
    from vvgt_cli.synth.sources import open_volume
    from vvgt_cli.volume import statistics

    if output == STDOUT:
        raise UsageError("-o -: a picture goes to a file; expected a name ending in .png")
    if volume is None and (tf_range != "data" or read != ReadOptions()):
        raise UsageError("--tf-range and reading options need --volume")
    check_outputs([Output("-o", output, (".png",))], [tf, volume], overwrite)
    function = read_transfer_function(tf)
    numbers = None
    if volume is not None:
        data = open_volume(volume, read)
        numbers = statistics(data)
        function = resolve(function, numbers, tf_range, data.hounsfield)
    draw(function, numbers, output, overwrite)
