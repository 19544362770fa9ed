"""The widget in JupyterLab, in a real browser: its traits follow the page, and the page follows them."""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.browser import PAGES, browser, packages

ROOT = Path(__file__).parents[1]
CELLS = (
    """
import json, numpy as np, vvgt_cli as vvgt
from vvgt_cli.integrations.jupyter import SplatWidget
values = np.indices((24, 22, 20)).sum(axis=0).astype(np.float32)
points = [{"x": 0, "opacity": 0, "rgb": [0, 0, 1]}, {"x": 63, "opacity": 0.5, "rgb": [1, 0.5, 0]}]
result = vvgt.convert(values, {"points": points}, max_gaussians=500, screen=100, steps=4)
widget = SplatWidget(result, camera="left")
widget
""",
    """
was = {"camera": widget.camera, "function": widget.function, "loaded": widget.loaded}
widget.cut = {"kind": "plane", "normal": [0, 0, 1], "at": 0.25}
widget.function = {"points": [{"x": 0, "opacity": 0, "rgb": [0, 1, 0]}, {"x": 63, "opacity": 1, "rgb": [0, 1, 0]}]}
widget.camera = "top"
""",
    """
now = {"camera": widget.camera, "cut": widget.cut, "points": widget.function["points"], "error": widget.error}
json.dump({"was": was, "now": now}, open("said.json", "w"))
""",
)


@pytest.fixture
def lab(tmp_path: Path):
    """Address of the notebook in a JupyterLab of its own."""
    pytest.importorskip("jupyterlab", reason="no JupyterLab: pip install jupyterlab anywidget")
    pytest.importorskip("anywidget")
    import nbformat

    cells = [nbformat.v4.new_code_cell(text.strip()) for text in CELLS]
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    nbformat.write(nbformat.v4.new_notebook(cells=cells, metadata=kernel), tmp_path / "a.ipynb")
    words = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", "--expose-app-in-browser"]
    log = tmp_path / "lab.log"
    with log.open("w") as stream:
        process = subprocess.Popen(
            [*words, "--port=0", "--ServerApp.port_retries=50"], cwd=tmp_path, stdout=stream, stderr=stream,
            env=os.environ | {"PYTHONPATH": str(ROOT), "JUPYTER_CONFIG_DIR": str(tmp_path / "config")},
        )  # fmt: skip
    end = time.monotonic() + 120
    while not (found := re.search(r"(http://127\.0\.0\.1:\d+/lab)\?token=(\w+)", log.read_text())):
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.3)
    yield f"{found[1]}/tree/a.ipynb?token={found[2]}"
    process.terminate()
    process.wait(60)


@pytest.mark.long
def test_page_and_traits_follow_each_other(lab: str, tmp_path: Path) -> None:
    (tmp_path / "job.json").write_text(json.dumps({"browser": browser(), "url": lab, "out": str(tmp_path / "lab.png")}))
    command = ["node", str(PAGES / "lab.mjs"), str(tmp_path / "job.json"), str(packages())]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    said = json.loads((tmp_path / "said.json").read_text())
    shown = json.loads(done.stdout)
    assert said["was"]["loaded"]
    assert said["was"]["camera"]["yaw"] == pytest.approx(shown["before"]) == pytest.approx(33, abs=0.5)  # the page's
    assert [point["x"] for point in said["was"]["function"]["points"]] == pytest.approx([0, 63], abs=0.01)
    assert said["now"]["error"] == ""
    assert said["now"]["camera"]["pitch"] == pytest.approx(-90, abs=1)  # by "top", as the page says it
    assert said["now"]["cut"]["at"] == 0.25
    assert said["now"]["cut"]["normal"] == pytest.approx([0, 0, 1])
    assert np.array([point["rgb"] for point in said["now"]["points"]]) == pytest.approx(
        np.array([[0, 1, 0]] * 2), abs=0.01
    )
