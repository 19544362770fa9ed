"""The page of `vvgt view`, and the one in a file, in a real browser that reaches nothing but its own address."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from browser import first_of_orbit, page_picture

from tests.test_formats_server import shown
from vvgt_cli.cameras import orbit_views
from vvgt_cli.commands.main import run
from vvgt_cli.gaussians import read_ply
from vvgt_cli.gaussians.formats import read_splats
from vvgt_cli.gaussians.formats.page_file import policy
from vvgt_cli.images.metrics import psnr
from vvgt_cli.splat import render

SIZE = 400
pytestmark = pytest.mark.long


def shoot(url: str, folder: Path, frame: int | None = None, before: str = "") -> tuple[np.ndarray, dict[str, Any]]:
    """Picture (SIZE, SIZE, 3) from the first view of an orbit, and what the browser noted."""
    picture, noted = page_picture(url, folder, SIZE, camera=first_of_orbit(), frame=frame, before=before)
    assert noted["asked"] == noted["errors"] == []
    assert noted["text"] == ""
    return picture, noted


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "frog.ply"
    assert run(["init", "example:frog", "--max-gaussians", "20000", "--quiet", "-o", str(path)]) == 0
    return path


def ours(file: Path) -> np.ndarray:
    """As `vvgt render --orbit` draws its first view, by the file's rule; the file is not turned."""
    return render(read_ply(file)[0], orbit_views(1, size=SIZE)[0], rule="inria")[..., :3]


def test_view_shows_what_render_draws(file: Path, tmp_path: Path) -> None:
    with shown(file.name, folder=file.parent) as (_, url):
        shot, noted = shoot(url, tmp_path)
    same = psnr(ours(file), shot)
    print(f"the page against our drawing: {same:.2f} dB; {noted['seconds']:.1f} s to the first picture")
    other = psnr(render(read_ply(file)[0], orbit_views(1, size=SIZE)[0], rule="playcanvas")[..., :3], shot)
    assert same > max(40, other + 3)
    assert noted["frames"] == 1
    for mirrored in (shot[:, ::-1], shot[::-1]):
        assert psnr(ours(file), mirrored) < 30


def test_the_page_in_a_file_shows_the_same(file: Path, tmp_path: Path) -> None:
    assert run(["view", str(file), "-o", str(tmp_path / "frog.html"), "--quiet"]) == 0
    shot, _ = shoot((tmp_path / "frog.html").as_uri(), tmp_path)
    same = psnr(ours(file), shot)
    print(f"the page in a file against our drawing by its rule: {same:.2f} dB")
    assert same > 38  # the splats in it are compressed
    assert len(read_splats(tmp_path / "frog.html")[0]) == len(read_ply(file)[0])


def test_a_series_goes_to_its_frames(file: Path, tmp_path: Path) -> None:
    from vvgt_cli.gaussians import write_ply

    gaussians = read_ply(file)[0]
    white = replace(gaussians, colors=np.ones_like(gaussians.colors))
    for name, frame in (("f0.ply", gaussians), ("f1.ply", white)):
        write_ply(tmp_path / name, frame)
    with shown("f*.ply", folder=tmp_path) as (_, url):
        shot, noted = shoot(url, tmp_path, frame=1)
    assert noted["frames"] == 2
    assert psnr(render(white, orbit_views(1, size=SIZE)[0], rule="inria")[..., :3], shot) > 38
    assert psnr(ours(file), shot) < 25


def test_a_page_of_several_in_a_file_goes_to_each(file: Path, tmp_path: Path) -> None:
    from vvgt_cli.gaussians import write_ply

    gaussians = read_ply(file)[0]
    here = gaussians.means[:, :1] > 0  # the rest is the same: the second is held as what differs
    white = replace(gaussians, colors=np.where(here, np.float32(1), gaussians.colors))
    for name, frame in (("f0.ply", gaussians), ("f1.ply", white)):
        write_ply(tmp_path / name, frame)
    files = [str(tmp_path / f"f{k}.ply") for k in (0, 1)]
    assert run(["view", *files, "-o", str(tmp_path / "both.html"), "--quiet"]) == 0
    assert '"whole": 0' in (tmp_path / "both.html").read_text("utf-8")
    expected = render(white, orbit_views(1, size=SIZE)[0], rule="inria")[..., :3]
    for frame, picture in ((0, ours(file)), (1, expected)):
        shot, noted = shoot((tmp_path / "both.html").as_uri(), tmp_path, frame=frame)
        assert noted["frames"] == 2
        assert psnr(picture, shot) > 36


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A live file and its page beside it."""
    path = tmp_path_factory.mktemp("live") / "frog.ply"
    assert run(["convert", "example:frog", "--live", "--max-gaussians", "20000", "--quiet", "-o", str(path)]) == 0
    assert run(["view", str(path), "-o", str(path.with_suffix(".html")), "--quiet"]) == 0
    return path


def test_the_page_of_a_volume_shows_its_conversion_until_the_function_is_changed(tmp_path: Path) -> None:
    how = ["example:marschner-lobb:32", "--max-gaussians", "3000", "--screen", "200", "--steps", "0", "--quiet"]
    assert run(["convert", *how, "-o", str(tmp_path / "both.html")]) == 0
    assert run(["convert", *how, "--no-values", "-o", str(tmp_path / "small.html")]) == 0
    wanted, _ = shoot((tmp_path / "small.html").as_uri(), tmp_path)
    url = (tmp_path / "both.html").as_uri()
    begun, _ = shoot(url, tmp_path)
    assert psnr(wanted, begun) > 60
    step = "document.querySelectorAll('#live .presets button')[2].click()"
    changed, _ = shoot(url, tmp_path, before=step)
    assert psnr(wanted, changed) < 30
    undone, _ = shoot(url, tmp_path, before=f"{step}; document.querySelector('#live .undo').click()")
    assert psnr(wanted, undone) > 60


def test_a_page_runs_under_the_policy_it_names_and_else_says_why_not(live: Path, tmp_path: Path) -> None:
    content = live.with_suffix(".html").read_bytes()
    with sent_with(content, policy(content.decode())) as url:
        shot, _ = shoot(url, tmp_path)
    assert (shot.max(axis=-1) > 0.1).mean() > 0.02
    with sent_with(content, "default-src 'self'") as url, pytest.raises(AssertionError, match="needs JavaScript"):
        shoot(url, tmp_path)


@contextmanager
def sent_with(content: bytes, policy: str) -> Iterator[str]:
    """Address of a page that a server sends with a content security policy."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Security-Policy", policy)
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *said: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def test_a_live_page_reports_that_a_browser_has_no_webgl(live: Path, tmp_path: Path) -> None:
    off = "HTMLCanvasElement.prototype.getContext = () => null"
    text = live.with_suffix(".html").read_text("utf-8").replace("<head>", f"<head><script>{off}</script>", 1)
    (tmp_path / "off.html").write_text(text, "utf-8")
    with pytest.raises(AssertionError, match="WebGL 2 is missing"):
        shoot((tmp_path / "off.html").as_uri(), tmp_path)
