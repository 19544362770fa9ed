"""`vvgt view` of volumes and live files: the page, conversions for its look, files to save."""

import http.client
import io
import json
import pickle
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from tests.test_field_runners import ended
from tests.test_formats_server import ask, cloud, shown
from tests.test_live import GRAIN, HI, LO, RAMP, facts
from tests.test_live import cloud as live_cloud
from vvgt_cli.commands import viewer as view
from vvgt_cli.commands.converter import Converted, Converter, Failed
from vvgt_cli.commands.converter_process import hidden
from vvgt_cli.commands.live_site import PageController, cloud_of, page_files, plain_name
from vvgt_cli.commands.server import Resource, Site, served
from vvgt_cli.conversion import convert_batch
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import DataError
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import PlyOptions, as_ply, read_ply, write_ply
from vvgt_cli.gaussians.formats.page_file import read_html
from vvgt_cli.gaussians.formats.page_look import look_entry, parse_light
from vvgt_cli.gaussians.formats.page_values import PageLayer, values_of
from vvgt_cli.gaussians.frames import up_matrix
from vvgt_cli.gaussians.live import Table, baked
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.progress import Console
from vvgt_cli.volume import Volume

FUNCTION = {
    "name": "mine",
    "points": [{"x": 0.2, "rgb": [1, 0, 0], "opacity": 0}, {"x": 0.9, "rgb": [1, 1, 0], "opacity": 0.5}],
    "opacity_unit_distance": 0.1,
}
AT_EYE = {"kind": "headlight", "from": [0, 0, 1], "ambient": 0.2, "diffuse": 1, "specular": 0, "power": 4}
AT_ONCE = 30.0  # seconds: a moment, on a busy machine


def send(url: str, name: str, what: Any, **headers: str) -> tuple[int, bytes]:
    """Status and body of what JSON that is sent gets."""
    place = urlsplit(url)
    connection = http.client.HTTPConnection("127.0.0.1", place.port, timeout=120)
    body = what if isinstance(what, bytes) else json.dumps(what).encode()
    told = {"Content-Type": "application/json"} | {key.replace("_", "-"): value for key, value in headers.items()}
    connection.request("POST", place.path + name, body, told)
    answer = connection.getresponse()
    return answer.status, answer.read()


def scene_of(url: str) -> dict[str, Any]:
    found = re.search(r'id="scene">(.*?)</script>', ask(url)[1].decode(), re.S)
    return dict(json.loads(found[1]))


def state_of(url: str) -> dict[str, Any]:
    return dict(json.loads(ask(url, urlsplit(url).path + "state")[1]))


def at_work(url: str) -> bool:
    """Whether a conversion has sent progress and no result yet."""
    state = state_of(url)
    return state["state"] == "working" and state["said"] != "beginning"


def until(what: Any, seconds: float = 600) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.1)


def workers(parent: int) -> set[int]:
    """Processes of a server."""
    rows = subprocess.run(["ps", "-eo", "pid,ppid"], capture_output=True, text=True, check=True).stdout
    table = [list(map(int, row.split())) for row in rows.splitlines()[1:]]
    return {pid for pid, above in table if above == parent}


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files of the programs that a test starts."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder


def test_the_first_page_spans_the_box_of_the_volume() -> None:
    np.testing.assert_array_equal(hidden((1, 2, 3)).means, [[-1, -2, -3], [1, 2, 3]])


def test_a_volume_is_shown_and_converted_for_the_pages_function(
    tmp_path: Path, temporary: Path, small_screen: None
) -> None:
    folder = tmp_path / "here"
    folder.mkdir()
    with shown("example:blob:12", "--tf", "viridis", folder=folder) as (child, url):
        until(lambda: not scene_of(url).get("waits"))
        scene = scene_of(url)
        assert scene["server"] == {"converts": True, "name": "blob-12"}
        assert scene["values"] == {"from": "values.json"}
        assert json.loads(ask(url, urlsplit(url).path + "values.json")[1])["facts"][0]["dims"] == [12, 12, 12]
        assert scene["look"]["layers"][0]["values"][1] == pytest.approx(0.9, abs=0.1)
        path = urlsplit(url).path
        assert "not converted" in send(url, "save", {"file": "ply"})[1].decode()
        # a function: the next one ends the work for it
        assert send(url, "function", {**FUNCTION, "name": "first"}) == (200, b'{"number": 2}')
        first = workers(child.pid)
        assert send(url, "function", FUNCTION) == (200, b'{"number": 3}')
        assert not first & workers(child.pid)
        until(lambda: state_of(url)["state"] != "working")
        state = state_of(url)
        assert (state["number"], state["state"]) == (3, "done")
        # the next look ends no scores, and goes on from what they are of
        second = workers(child.pid)
        assert send(url, "function", {**FUNCTION, "light": AT_EYE}) == (200, b'{"number": 4}')
        assert workers(child.pid) == second
        until(lambda: state_of(url).get("scored", False))
        state = state_of(url)
        assert (state["number"], state["state"]) == (4, "done")
        assert re.fullmatch(r"converted, [3-9]\d\.\d dB", state["said"])
        shown_now, header = read_ply(io.BytesIO(ask(url, path + state["file"])[1]))
        assert header.live is None
        assert header.up == "z"
        status, saved = send(url, "save", {"file": "ply", "number": 4})
        many, kept = cloud_of(saved)
        assert status == 200
        assert (kept.up, kept.unit_distance) == ("none", 0.1)
        assert kept.light == Lighting(True, (), 0.2, 1.0, 0.0, 4.0)
        assert len(many) == len(shown_now) > 10
        assert kept.certificate is not None
        assert len(read_html(send(url, "save", {"file": "html", "number": 4})[1], "x")) == len(shown_now)
        page = send(url, "save", {"file": "html", "number": 4, "function": FUNCTION})[1].decode()
        look = json.loads(re.search(r'id="scene">(.*?)</script>', page, re.S)[1])["look"]
        assert look["layers"][0]["name"] == "mine"
        # no function: nothing is at work, and what was made is gone
        assert send(url, "function", None)[0] == 200
        assert ask(url, path + state["file"])[0] == 404
        assert send(url, "save", {"file": "ply", "number": 4})[0] == 400
        child.send_signal(signal.SIGINT)
        _, said = child.communicate(timeout=60)
        assert child.returncode == 0
        assert "Traceback" not in said
    assert list(temporary.iterdir()) == list(folder.iterdir()) == []


def test_colours_are_offered_no_values(tmp_path: Path, temporary: Path, small_screen: None) -> None:
    nib = pytest.importorskip("nibabel")
    data = np.zeros((8, 8, 8), np.dtype([(c, np.uint8) for c in "RGB"]))
    data["R"][2:6, 2:6, 2:6] = 200
    nib.save(nib.Nifti1Image(data, np.eye(4)), tmp_path / "rgb.nii")
    with shown(str(tmp_path / "rgb.nii"), folder=tmp_path) as (_, url):
        until(lambda: not scene_of(url).get("waits"))
        assert not {"values", "look"} & set(scene_of(url))


def test_what_is_cancelled_stops_and_an_interrupt_leaves_nothing(tmp_path: Path, temporary: Path) -> None:
    with shown("example:blob:12", "--tf", "viridis", folder=tmp_path) as (child, url):
        until(lambda: not scene_of(url).get("waits"))
        send(url, "function", FUNCTION)
        until(lambda: at_work(url))
        begin = time.monotonic()
        assert send(url, "function", None)[0] == 200
        assert not workers(child.pid)
        assert time.monotonic() - begin < AT_ONCE
        assert len(list(temporary.iterdir())) == 1  # the folder itself
        assert list(next(temporary.iterdir()).iterdir()) == []
        send(url, "function", FUNCTION)
        until(lambda: at_work(url))
        (pid,) = workers(child.pid)
        child.send_signal(signal.SIGINT)
        child.send_signal(signal.SIGINT)  # impatiently
        assert child.wait(60) == 0
        assert ended(pid)
    assert list(temporary.iterdir()) == []


def test_a_conversion_ends_with_a_server_that_is_killed(tmp_path: Path, temporary: Path) -> None:
    with shown("example:blob:12", "--tf", "viridis", folder=tmp_path) as (child, _):
        until(lambda: bool(workers(child.pid)))
        (pid,) = workers(child.pid)
        child.kill()
        assert ended(pid)
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize("ready", [False, True], ids=["before it begins", "while it speaks"])
def test_the_process_of_a_server_that_has_ended_removes_its_folder(tmp_path: Path, ready: bool) -> None:
    folder = tmp_path / "temporary"
    folder.mkdir()
    code = "from vvgt_cli.commands.converter_process import main; main()"
    with subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        if ready:  # the input stays open: it is the answers that nobody hears
            process.stdout.close()
            pickle.dump((SourceRequest("example:blob:12"), "blob", None), process.stdin)
            pickle.dump((1, None), process.stdin)
            process.stdin.flush()
        else:
            process.stdin.close()
        assert process.wait(120) == 0
    assert not folder.exists()


@pytest.fixture
def controller(tmp_path: Path) -> Iterator[tuple[str, PageController]]:
    """The site of a volume, which says that it converts, without a process."""

    class Still(Converter):
        def submit(self, job: Any) -> int:
            self._number += 1
            return self._number

    site = Site({}, print)
    found = PageController(site.resources, site.posts, "x", Console(quiet=True))
    values = values_of([PageLayer(Volume(np.zeros((2, 3, 4), np.uint8)), RAMP, 0.5)])
    assert values is not None
    values = values._replace(look=replace(facts(), distance=0.5))
    ply = as_ply(hidden((1, 1, 1)), PlyOptions(up="y", scale=0.1, unit_distance=0.5))
    found.converter = Still(SourceRequest("none"), "x", found.on_message)
    found.resources["state"] = Resource("application/json", found._state_json)
    found.on_message(0, Converted(ply, page_files(*cloud_of(ply), "x", values), values))
    found.state = {"number": 0, "state": "none", "said": ""}
    with served(site) as url:
        yield url, found


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (b"\xff", "not JSON"),
        (b"[" * 60000, "not JSON"),
        (b'{"points": NaN}', "NaN is no number"),
        ([], "a list of at most"),
        ({**FUNCTION, "points": []}, "expected a list of objects"),
        ({**FUNCTION, "points": [{"x": "a", "opacity": 1, "rgb": [1, 1, 1]}]}, "points[0].x"),
        ({**FUNCTION, "opacity_unit_distance": 0}, "unit distance"),
        ({**FUNCTION, "range": "foreground"}, "'range'"),
        ({**FUNCTION, "file": "/etc/passwd"}, "'file'"),
    ],
)  # fmt: skip
def test_what_is_no_function_is_refused_with_the_reason(controller, sent, said) -> None:
    url, of = controller
    status, text = send(url, "function", sent)
    assert status == 400
    assert said in text.decode()
    assert b"\n" not in text
    assert of.state["number"] == 0


def test_who_may_send_what(controller: tuple[str, PageController]) -> None:
    url, of = controller
    assert send(url, "function", FUNCTION, Origin="http://evil.example")[0] == 403
    assert send(url, "function", FUNCTION, Host="evil.example")[0] == 403
    assert send(url, "function", FUNCTION, Sec_Fetch_Site="cross-site")[0] == 403
    assert send(url, "function", FUNCTION, Content_Type="text/plain")[0] == 415
    assert send(url, "function", FUNCTION, Content_Length="-1")[0] == 415
    assert send(url, "function", b" ", Content_Length=str((1 << 20) + 1))[0] == 413
    assert send(url, "", FUNCTION)[0] == 405
    assert send(url, "../function", FUNCTION)[0] == 405
    assert ask(url, urlsplit(url).path + "function")[0] == 404
    assert of.state["number"] == 0
    assert send(url, "function", FUNCTION, Origin=f"http://127.0.0.1:{urlsplit(url).port}")[0] == 200
    assert of.state["number"] == 1


@pytest.mark.parametrize(
    "sent",
    [None, {}, {"file": "png"}, {"file": "../x.ply"}, {"file": "ply", "number": 7}, {"file": "ply", "path": "/tmp/x"},
     {"file": "ply", "function": {}}],
)  # fmt: skip
def test_what_cannot_be_saved_is_refused(controller: tuple[str, PageController], sent: Any) -> None:
    assert send(controller[0], "save", sent)[0] == 400


def test_the_page_says_why_a_conversion_failed(controller: tuple[str, PageController]) -> None:
    url, of = controller
    send(url, "function", FUNCTION)
    of.on_message(1, Failed(DataError("mine: nothing is visible")))
    assert state_of(url) == {"number": 1, "state": "failed", "said": "mine: nothing is visible"}
    assert of.error is None
    assert "look" in scene_of(url)


def test_a_long_function_is_taken(controller: tuple[str, PageController]) -> None:
    points = [{"x": LO + k / 7e3, "rgb": [0.1234, 0.5678, 0.9012], "opacity": 0.123456} for k in range(4096)]
    assert send(controller[0], "function", {**FUNCTION, "points": points})[0] == 200


def test_a_light_of_a_page_is_that_of_a_file(controller: tuple[str, PageController]) -> None:
    _, of = controller
    assert of.first is not None
    assert of.values is not None
    options, side = of.first(), Lighting(False, ((0.6, 0.0, 0.8),), 0.2, 0.6, 0.3, 4.0)
    base = look_entry(of.values, replace(options, light=side))["light"]
    again = parse_light(base, options)
    assert again is not None
    np.testing.assert_allclose(again.directions, side.directions, atol=1e-12)
    assert replace(again, directions=side.directions) == side
    assert parse_light(base | {"kind": "headlight"}, options) == replace(side, headlight=True, directions=())
    assert parse_light(base | {"kind": "none"}, options) is None
    for wrong in ([], {}, {"kind": "sun"}, base | {"from": [0, 0, 0]}, base | {"from": 1}, base | {"ambient": "x"},
                  base | {"power": None}, base | {"diffuse": -1}, base | {"from": [1e999, 0, 0]}):  # fmt: skip
        assert send(controller[0], "function", {**FUNCTION, "light": wrong})[0] == 400


def test_a_conversion_has_the_light_of_the_file_or_of_the_page(
    controller: tuple[str, PageController], monkeypatch: pytest.MonkeyPatch
) -> None:
    url, of = controller
    jobs: list[Any] = []
    monkeypatch.setattr(of.converter, "submit", lambda job: jobs.append(job) or len(jobs))
    side = {**AT_EYE, "kind": "direction", "from": [3, 0, 4]}
    for sent in (None, AT_EYE, side, {**AT_EYE, "kind": "none"}):
        assert send(url, "function", {**FUNCTION, "light": sent})[0] == 200
    assert send(url, "function", {**FUNCTION, "light": {**AT_EYE, "kind": "sun"}})[0] == 400
    assert jobs[0][1] is None
    head, other, none = [options.lighting(Lighting(ambient=0.7), "RAS") for _, options in jobs[1:]]
    assert (head, none) == (Lighting(True, (), 0.2, 1, 0, 4), None)
    assert (other.headlight, other.ambient, other.diffuse) == (False, 0.2, 1)
    np.testing.assert_allclose(np.array(other.directions) @ up_matrix("y").T * (-1, -1, 1), [[0.6, 0, 0.8]], atol=1e-12)


def test_a_live_file_and_an_ordinary_one_are_shown_as_they_are(tmp_path: Path) -> None:
    some = baked(live_cloud(), Table.of_function(RAMP, LO, HI, 0.05, GRAIN))
    write_ply(tmp_path / "live.ply", some, PlyOptions(scale=0.1, unit_distance=0.5, live=facts()))
    write_ply(tmp_path / "plain.ply", cloud())
    with shown("live.ply", folder=tmp_path) as (_, url):
        scene = scene_of(url)
        assert not {"look", "server"} & set(scene)
        assert send(url, "function", FUNCTION)[0] == 405  # there is no volume
    with shown("plain.ply", folder=tmp_path) as (_, url):
        assert "look" not in scene_of(url)


def test_a_waiting_page_shows_progress_and_the_reason_of_a_failure(tmp_path: Path) -> None:
    site = Site({}, print)
    controller = PageController(site.resources, site.posts, "x", Console(quiet=True))
    with (
        served(site) as url,
        Converter(SourceRequest(str(tmp_path / "none.nrrd")), "x", controller.on_message) as converter,
    ):
        controller.await_volume(converter)
        assert scene_of(url)["waits"]
        assert state_of(url)["state"] in ("first", "failed")
        assert controller.shown.wait(120)
        assert "no such file" in state_of(url)["said"]
        assert controller.error.exit_code == 1


@pytest.mark.parametrize(
    ("args", "code", "said"),
    [
        (["none.nrrd"], 1, "no such file"),
        (["bad.nrrd"], 1, "check that the file is whole"),
        (["one.npy", "--tf", "hidden.json"], 1, "nothing is visible"),
        (["example:nope"], 2, "no such example"),
    ],
)
def test_what_cannot_be_shown_is_one_line(args, code, said, tmp_path, vvgt, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("one.npy", np.full((4, 4, 4), 5, np.uint8))
    head = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 8 8 8\nencoding: raw\n\nxx"
    Path("bad.nrrd").write_bytes(head)
    Path("hidden.json").write_text(json.dumps({"points": [
        {"x": 6, "rgb": [1, 1, 1], "opacity": 0}, {"x": 7, "rgb": [1, 1, 1], "opacity": 0.5}]}))  # fmt: skip
    assert said in vvgt.fails(code, "view", *args, "--no-browser")


def test_names_to_save_under() -> None:
    assert plain_name("a/b/head_64x64x93_uint16.raw") == "head"
    assert plain_name("example:blob:12") == "blob-12"
    assert plain_name("/x/</b>.nii.gz") == "b"
    assert plain_name("..") == "volume"
    assert plain_name("head.v4.spz") == "head"
    assert plain_name("a/head.compressed.ply") == plain_name("head.ply") == plain_name("head.spz") == "head"


def test_a_series_is_shown_frame_by_frame_and_saved_as_a_page(tmp_path, vvgt, monkeypatch, small_screen) -> None:
    shown: list[tuple[list[str], list[float]]] = []

    def serve(run, clouds, *how) -> None:
        shown.append(([name for name, _ in clouds], [float(read_ply(f)[0].means[:, 0].mean()) for _, f in clouds]))

    x = np.indices((12, 12, 24))[2]
    for k in range(3):
        np.save(tmp_path / f"run_{k}.npy", np.exp(-((x - 5 - 6 * k) ** 2) / 8).astype(np.float32))
    assert "quote the pattern" in vvgt.fails(2, "view", *sorted(tmp_path.glob("run_*.npy")))
    monkeypatch.setattr(view, "_serve", serve)
    (temporary := tmp_path / "t").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    vvgt.ok("view", tmp_path / "run_*.npy", "--tf", "viridis")
    names, means = shown[0]
    assert len(names) == 3
    assert means == sorted(means)
    assert means[2] - means[0] > 0.6  # 12 voxels of 24, whose box is 2 wide, in haze
    assert not list(temporary.glob("vvgt-*"))
    assert "holds one frame" in vvgt("view", tmp_path / "run_*.npy", "-o", tmp_path / "a.ply").error
    left = vvgt.fails(2, "view", tmp_path / "run_*.npy", "--no-values")
    assert "--no-values is for a page that is saved" in left
    wrong = vvgt("view", tmp_path / "run_*.npy", "--crop", "30:,:,:")
    assert (wrong.code, "live form" in wrong.err) == (2, False)
    saved: list[ConvertRequest] = []
    monkeypatch.setattr(convert_batch, "convert_all", lambda requests, console: saved.append(requests[""]))
    vvgt.ok("view", tmp_path / "run_*.npy", "--tf", "viridis", "-o", tmp_path / "a.html")
    assert (saved[0].output, saved[0].source.tf, saved[0].live) == (str(tmp_path / "a.html"), "viridis", False)
