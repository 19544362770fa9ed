"""`vvgt tf convert`: a transfer function in another format."""

from __future__ import annotations

from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.outputs import Output, check_outputs, write_text
from vvgt_cli.progress import Console


def convert_transfer_function(
    tf: str, output: str, form: str, tf_range: str, overwrite: bool, console: Console | None = None
) -> None:
    """Read a function and write it to a JSON file.

    Args:
        tf: file, ``FILE#NAME``, or the name of a colour map.
        output: the file, or "-" for standard output.
        form: "minimal" or "paraview".
        tf_range: "data", or "LO,HI" to stretch the nodes to.
        overwrite: replace a file that exists.
        console: for messages.

    Raises:
        UsageError: an output that may not be written, ``rescale`` (there are no data), or fractions without LO,HI.
        DataError: not a function, or one that the format cannot store.
    """
    from vvgt_cli.look import read_transfer_function
    from vvgt_cli.look.convert import placed, to_text
    from vvgt_cli.look.function import PER_VOXEL
    from vvgt_cli.look.resolve import parse_tf_range

    check_outputs([Output("OUT", output, (".json",), binary=False)], [tf.partition("#")[0]], overwrite)
    limits = parse_tf_range(tf_range)
    if limits == "rescale":
        raise UsageError("--tf-range rescale needs the data, and this command reads none; give --tf-range LO,HI")
    function = placed(read_transfer_function(tf), None if isinstance(limits, str) else limits)
    text = to_text(function, form)
    distance = PER_VOXEL if function.opacity_unit_label == PER_VOXEL else f"{function.opacity_unit_distance or 0:g}"
    if form == "paraview" and distance != "0":
        (console or Console()).message(
            f"{output}: a ParaView preset stores no unit distance: set it to {distance} there, or give "
            f"--opacity-unit-distance {distance} here"
        )
    if form == "paraview" and function.lighting is not None:
        (console or Console()).message(f"{output}: a ParaView preset stores no shading; use --light headlight with it")
    write_text(output, text, overwrite)
