"""What a conversion's stages are foreseen to cost."""

import pytest

from vvgt_cli.cameras.blocks import BLOCK, ENOUGH, FEW, spread_blocks
from vvgt_cli.conversion.stages import CheckViews, TestViews, TrainingViews
from vvgt_cli.dvr import Scene
from vvgt_cli.field import workload as case_module
from vvgt_cli.field.workload import Workload, measure
from vvgt_cli.look.readers import minimal
from vvgt_cli.volume import read_volume

POINTS = [{"x": x, "rgb": [x, 0.5, 1 - x], "opacity": 0.6 * x} for x in (0.0, 0.5, 1.0)]


def drawn(size, enough):
    """Pixels of a view's blocks."""
    return spread_blocks(size, size, enough=enough).numbers.size * BLOCK**2


@pytest.fixture(scope="module")
def scene():
    return Scene.build(read_volume("example:marschner-lobb:16"), minimal.read({"points": POINTS}, "ramp"), 1.0)


@pytest.mark.parametrize(("size", "judged"), [(300, 300**2), (1080, drawn(1080, FEW))])
def test_check_views_cost_what_their_blocks_do(scene, size, judged):
    workload = measure(scene, size, 1000)
    edge = min(size, 300)
    seconds, memory = CheckViews().cost(workload)
    assert seconds == pytest.approx(4 * 1.2 * workload.view * judged / edge**2)
    assert memory == 32 * (4 * judged + size**2)
    assert TrainingViews(48, edge).cost(workload).memory == 32 * 48 * edge**2


def test_a_machine_is_as_slow_as_it_draws(scene, monkeypatch):
    monkeypatch.setattr(case_module, "pace", case_module.pace.__wrapped__)  # not what this process has measured
    drawn_once = []
    monkeypatch.setattr("vvgt_cli.splat.render", lambda gaussians, camera: drawn_once.append(len(gaussians)))
    monkeypatch.setattr(case_module, "_quickest", lambda call, calls=3: (call(), 3 * case_module.SPLAT)[1])
    assert measure(scene, 48, 1000).pace == pytest.approx(3)
    assert drawn_once == [20_000] * 2  # loaded, then timed


@pytest.mark.parametrize(
    ("whole", "pixels", "beside"),
    [(True, 3 * 1080**2 + 7 * drawn(1080, ENOUGH), 0.1), (False, 3 * drawn(1080, ENOUGH), 0.03)],
)
def test_three_large_test_views_are_whole_where_all_ten_are_scored(whole, pixels, beside):
    workload = Workload(100_000, 1e6, 10.2e6, 1080, 0.05, pace=2.0)
    assert TestViews(whole).cost(workload).seconds == pytest.approx(
        pixels * (1.2 * 0.05 / 300**2 + 2 * beside / 400**2)
    )
