"""The server of `vvgt view`: what it hands out, and to whom; how it ends."""

import gzip
import http.client
import json
import re
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from tests.processes import start
from vvgt_cli.commands.server import Resource, Site, served
from vvgt_cli.conversion.index import expanded
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply, write_ply


def cloud(count: int = 20, shift: float = 0.0) -> Gaussians:
    rng = np.random.default_rng(3)
    means = rng.uniform(-0.5, 0.5, (count, 3)) + np.array([shift, 0, 0])
    scales = np.full((count, 3), -3.0)
    return Gaussians(means, scales, rng.normal(size=(count, 4)), np.full(count, 2.0), rng.uniform(0, 1, (count, 3)))


def ask(url: str, path: str | None = None, method: str = "GET", **headers: str) -> tuple[int, bytes, dict[str, str]]:
    """Status, body and headers, of a path to the letter."""
    place = urlsplit(url)
    connection = http.client.HTTPConnection("127.0.0.1", place.port, timeout=60)
    connection.putrequest(method, path or place.path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read(), dict(answer.getheaders())


@pytest.fixture
def site(tmp_path: Path) -> Iterator[str]:
    (tmp_path / "secret").write_text("secret")

    def broken() -> bytes:
        raise DataError("a frame that is damaged")

    said: list[str] = []
    parts = {
        "": Resource("text/html", lambda: b"page"),
        "viewer.js": Resource("text/javascript", lambda: gzip.compress(b"program"), packed=True),
        "bad.ply": Resource("application/octet-stream", broken),
    }
    with served(Site(parts, said.append)) as url:
        yield url
    assert said == ["a frame that is damaged"] * len(said)


def test_the_page_and_its_files_are_handed_out(site):
    status, body, headers = ask(site)
    assert (status, body) == (200, b"page")
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert "Access-Control-Allow-Origin" not in headers
    status, body, headers = ask(site, urlsplit(site).path + "viewer.js")
    assert (status, gzip.decompress(body), headers["Content-Encoding"]) == (200, b"program", "gzip")
    assert ask(site, method="HEAD")[:2] == (200, b"")
    assert ask(site, urlsplit(site).path + "bad.ply")[:2] == (500, b"")


@pytest.mark.parametrize(
    "path",
    ["/", "/viewer.js", "/{}", "/{}/../secret", "/{}/../../../../../../etc/passwd", "/{}//etc/passwd",
     "/{}/%2e%2e/secret", "/{}/secret", "/{}/page.html", "/{}/viewer.js?x", "/{}/?file=/etc/passwd",
     "/..", "/{}x/"],
)  # fmt: skip
def test_other_paths_get_nothing(site, path):
    assert ask(site, path.format(urlsplit(site).path.strip("/")))[:2] == (404, b"")


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:80"},
        {"Host": "127.0.0.1.evil.example"},
        {"Host": "localhost@evil.example"},
        {"Host": ""},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "https://localhost"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
    ],
    ids=lambda headers: "=".join(*headers.items()),
)
def test_other_hosts_and_origins_get_nothing(site, headers):
    assert ask(site, **headers)[:2] == (403, b"")


def test_the_page_itself_may_ask_also_through_a_tunnel(site):
    port = urlsplit(site).port
    assert ask(site, Origin=f"http://127.0.0.1:{port}", Sec_Fetch_Site="same-origin")[0] == 200
    assert ask(site, Host="localhost:9999", Origin="http://localhost:9999")[0] == 200
    assert ask(site, Host="localhost:9999", Origin="http://localhost:9998")[0] == 403


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "CONNECT", "NONSENSE"])
def test_other_methods_get_nothing(site, method):
    status, body, headers = ask(site, method=method)
    assert (status, body) == (405, b"")
    assert "Access-Control-Allow-Origin" not in headers


def test_what_was_sent_with_a_request_that_is_refused_is_not_read_as_another(site):
    host, port, word = urlsplit(site).hostname, urlsplit(site).port, urlsplit(site).path
    inner = f"GET {word} HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode()
    outer = f"POST {word} HTTP/1.1\r\nHost: {host}:{port}\r\nContent-Length: {len(inner)}\r\n\r\n".encode()
    with socket.create_connection((host, port), timeout=10) as line:
        line.sendall(outer + inner)
        told = b""
        while part := line.recv(4096):
            told += part
    assert told.count(b"HTTP/1.") == 1
    assert b" 405 " in told.splitlines()[0]


def test_two_servers_have_two_ports_and_two_words():
    parts = {"": Resource("text/html", lambda: b"page")}
    with served(Site(parts, print)) as one, served(Site(parts, print)) as other:
        assert urlsplit(one).port != urlsplit(other).port
        assert urlsplit(one).path != urlsplit(other).path
        assert len(urlsplit(one).path) > 16
        assert urlsplit(one).hostname == "127.0.0.1"


@contextmanager
def shown(*args: str, folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`vvgt view`, and its address."""
    code = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += "from vvgt_cli.commands.main import main; main()"
    child = start("-c", code, "view", "--no-browser", *args, cwd=folder)
    try:
        yield child, child.stdout.readline().strip()
    finally:
        child.kill()
        child.communicate()


def test_view_shows_a_series_and_ends_on_an_interrupt(tmp_path):
    for k in (0, 1, 10, 2):
        write_ply(tmp_path / f"run_{k}.ply", cloud(shift=k / 100), PlyOptions(up="x"))
    with shown("run_*.ply", folder=tmp_path) as (child, url):
        scene = json.loads(re.search(r'id="scene">(.*?)</script>', ask(url)[1].decode())[1])
        assert [frame["name"] for frame in scene["frames"]] == ["run_0.ply", "run_1.ply", "run_2.ply", "run_10.ply"]
        path = urlsplit(url).path
        for k, frame in zip((0, 1, 2, 10), scene["frames"], strict=True):
            (tmp_path / "got.ply").write_bytes(ask(url, path + frame["file"])[1])
            stored, header = read_ply(tmp_path / "got.ply")
            assert header.up == "x"
            np.testing.assert_array_equal(stored.means, read_ply(tmp_path / f"run_{k}.ply")[0].means)
        assert gzip.decompress(ask(url, path + "viewer.js")[1]).count(b"SuperSplat")
        assert ask(url, path + "run_0.ply")[0] == 404
        (tmp_path / "run_2.ply").write_bytes(b"ply\n")
        assert ask(url, f"{path}2.ply")[0] == 500
        waiting = http.client.HTTPConnection("127.0.0.1", urlsplit(url).port)
        waiting.connect()  # somebody who never asks
        begin = time.monotonic()
        child.send_signal(signal.SIGINT)
        _, said = child.communicate(timeout=60)
        assert time.monotonic() - begin < 10  # a second, and what a busy machine adds
        assert child.returncode == 0
        assert "run_2.ply: no 'end_header'" in said
        assert "Traceback" not in said


def test_a_port_of_ones_own_which_may_be_taken(tmp_path, vvgt):
    write_ply(tmp_path / "a.ply", cloud())
    with served(Site({}, print)) as url:
        port = urlsplit(url).port
        result = vvgt("view", tmp_path / "a.ply", "--port", port, "--no-browser")
    assert result.code == 2
    assert f"--port {port}: " in result.error
    with shown("a.ply", "--port", str(port), folder=tmp_path) as (_, url):
        assert urlsplit(url).port == port


def test_globs_become_files_of_gaussians_in_the_order_of_their_numbers(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a_10.ply", "a_2.ply", "[x].ply", "slice_1.tif", "slice_2.tif"):
        Path(name).write_bytes(b"")
    assert expanded("a_*.ply") == ["a_2.ply", "a_10.ply"]
    assert expanded("a_?.ply") == ["a_2.ply"]
    Path("h[1]").mkdir()
    Path("h[1]/lod-meta.json").write_bytes(b"")
    for name in ("[x].ply", "none.ply", "h[1]/#1", "slice_*.tif", "a.h5:/[x]"):  # the last two are volumes
        assert expanded(name) == [name]
    with pytest.raises(UsageError, match="no such files"):
        expanded("b_*.ply")


@pytest.mark.parametrize(
    ("args", "code", "said"),
    [
        (["nothing.ply"], 1, "nothing.ply"),
        (["nothing_*.ply"], 2, "no such files"),
        (["a.ply", "example:blob:8"], 2, "quote the pattern"),
        (["a.ply", "--port", "70000"], 2, "70000"),
        (["a.ply", "-o", "a.png"], 2, ".spz"),
        (["a.ply", "-o", "b.html", "--port", "8000"], 2, "omit --port"),
        (["a.ply", "a.ply", "--tf", "viridis", "-o", "b.html"], 2, "are for volumes only"),
        (["a.ply", "-o", "a.ply", "--overwrite"], 2, "is an input"),
    ],
)
def test_bad_calls_are_one_line(args, code, said, tmp_path, vvgt, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_ply("a.ply", cloud())
    Path("text.ply").write_text("no Gaussians here")
    result = vvgt("view", *args, "--no-browser") if "-o" not in args else vvgt("view", *args)
    assert result.code == code
    assert said in result.error
