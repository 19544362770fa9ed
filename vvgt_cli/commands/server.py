"""Server of `vvgt view`: one page and its files, on this machine's own address, for the browser that has the URL.

Other users of the machine and other pages in the browser can reach the port too. So the page's path has a random word,
and requests that name another host, come from another page, or ask for anything else are refused.
"""

from __future__ import annotations

import json
import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

from vvgt_cli.errors import DataError, UsageError, VvgtError
from vvgt_cli.gaussians.formats.page_file import policy, waiting_page

ADDRESS = "127.0.0.1"
MAX_REQUEST = 1 << 20  # bytes of what a page may send: a function of 4096 nodes has 400 KB
NAMES = (ADDRESS, "localhost")  # that a request may know it by; the port is another one behind a tunnel
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": policy(waiting_page("", ""), "'self'") + "; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


@dataclass(frozen=True)
class Resource:
    """Content at a path.

    Attributes:
        kind: media type.
        content: called for each request.
        packed: whether the content is compressed by gzip.
    """

    kind: str
    content: Callable[[], bytes]
    packed: bool = False


@dataclass(frozen=True)
class Site:
    """Resources by name; "" is the page.

    Attributes:
        resources: what can be fetched; may change.
        failed: called with the reason when a resource cannot be read.
        posts: functions that take the JSON sent to a name and return the answer; a `VvgtError` becomes an answer with
            its reason (400).
        word: random part of the paths.
    """

    resources: dict[str, Resource]
    failed: Callable[[str], None]
    posts: dict[str, Callable[[Any], Resource]] = field(default_factory=dict)
    word: str = field(default_factory=lambda: secrets.token_urlsafe(12))

    def name(self, path: str) -> str | None:
        """Return the exact name in a request's path; None if the path lacks the word."""
        return path.removeprefix(f"/{self.word}/") if path.startswith(f"/{self.word}/") else None


@contextmanager
def served(site: Site, port: int = 0) -> Iterator[str]:
    """Serve a site within the block, yielding the page's URL; raise UsageError if the port (0: a free one) is taken."""
    handler = type("Handler", (_Handler,), {"site": site})
    try:
        server = _Server((ADDRESS, port), handler)
    except OSError as error:
        raise UsageError(f"--port {port}: {error.strerror or error}; try another port, or omit --port") from None
    thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
    thread.start()
    try:
        yield f"http://{ADDRESS}:{server.server_address[1]}/{site.word}/"
    finally:
        server.shutdown()
        server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True  # a browser that does not read on keeps nobody waiting
    block_on_close = False

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore a browser that closes the connection."""


class _Handler(BaseHTTPRequestHandler):
    site: Site
    protocol_version = "HTTP/1.1"
    timeout = 60

    def do_GET(self) -> None:
        name = self.site.name(self.path) if self._ours() else None
        resource = None if name is None else self.site.resources.get(name)
        if resource is None:
            self.send_error(404 if self._ours() else 403)
            return
        try:
            content = resource.content()
        except (VvgtError, OSError) as error:
            self.site.failed(str(error))
            self.send_error(500)
            return
        self._answer(200, resource, content)

    do_HEAD = do_GET

    def do_POST(self) -> None:
        name = self.site.name(self.path) if self._ours() else None
        taken = None if name is None else self.site.posts.get(name)
        if taken is None:
            self.send_error(405 if self._ours() else 403)
            return
        length = self.headers.get("Content-Length", "")
        if self.headers.get("Content-Type") != "application/json" or not re.fullmatch("[0-9]{1,9}", length):
            self.send_error(415)  # which a page of another origin cannot send unasked
            return
        if int(length) > MAX_REQUEST:
            self.send_error(413)
            return
        try:
            resource = taken(_parsed(self.rfile.read(int(length))))
            content = resource.content()
        except VvgtError as error:
            resource = Resource("text/plain; charset=utf-8", lambda: b"")
            self._answer(400, resource, " ".join(str(error).split()).encode())
            return
        self._answer(200, resource, content)

    def _answer(self, status: int, resource: Resource, content: bytes) -> None:
        self.send_response_only(status)
        self.send_header("Content-Type", resource.kind)
        self.send_header("Content-Length", str(len(content)))
        if resource.packed:
            self.send_header("Content-Encoding", "gzip")
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def _ours(self) -> bool:
        """Return whether a request names this machine and comes from the page itself or from no page."""
        host = self.headers.get("Host", "")
        origin = self.headers.get("Origin")
        if _name(f"http://{host}") not in NAMES or self.headers.get("Sec-Fetch-Site", "none") not in (
            "none",
            "same-origin",
        ):
            return False
        return origin is None or origin == f"http://{host}"

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Send a status and nothing else; the request's body is not read."""
        self.send_response_only(405 if code == 501 else code)  # of a method that there is not
        self.send_header("Content-Length", "0")
        self.send_header("Connection", "close")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


def _parsed(content: bytes) -> Any:
    """Parse JSON that was sent, or raise DataError."""
    try:
        return json.loads(content.decode("utf-8"), parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise DataError(f"the request is not JSON ({error}); expected an object") from None


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is no number")


def _name(url: str) -> str | None:
    try:
        parts = urlsplit(url)
        return parts.hostname if parts.username is None and not parts.path else None
    except ValueError:
        return None
