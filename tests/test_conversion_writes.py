"""How often a conversion writes its file, as the plan counts it."""

import pytest

from vvgt_cli.conversion.fitting import plan_of
from vvgt_cli.conversion.plan import WRITE
from vvgt_cli.conversion.request import ConvertRequest, FitOptions
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.progress import Console


@pytest.mark.parametrize(
    ("output", "options", "times"), [("a.ply", {}, 2), ("-", {}, 1), ("a.ply", {"checkpoint": "c"}, 1), (None, {}, 0)]
)
def test_the_plan_counts_how_often_the_file_is_written(tmp_path, output, options, times):
    output = output if output in (None, "-") else str(tmp_path / output)
    found = plan_of(
        ConvertRequest(SourceRequest("example:marschner-lobb:24"), output, FitOptions(400, 48), **options),
        Console(quiet=True),
    )
    assert found.costs()[-1] == ("write", pytest.approx(times * WRITE * found.workload.pace))
    assert found.seconds == pytest.approx(sum(seconds for _, seconds in found.costs()))
