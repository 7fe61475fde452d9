"""Web server of the view: fixed files and one endless stream per browser, on the loopback by default.

The view has no password, therefore: foreign host names are refused (DNS rebinding would let a page elsewhere read the
view through a visitor's browser), nothing can be written, streams and connections are limited, and a browser that
reads nothing is disconnected.
"""

import ipaddress
import os
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from threading import BoundedSemaphore, Condition, Thread
from typing import Any

from nlos_cam.errors import NlosCamError
from nlos_cam.view.assets import LOOPBACK, Assets

Send = Callable[[bytes], None]
STREAM_PATH = "/live.rrd"
WRITE_TIMEOUT_S = 5.0
"""Seconds without data taken or a request, after which a browser is disconnected."""
PIECE_BYTES = 1 << 18
"""A file goes out in pieces, each within that time: the viewer has 30 MB, and a link may be slow."""
MAX_STREAMS = 8
"""Browsers that watch at once; each costs a drawing, 12 times a second."""
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; worker-src 'self' blob:; frame-ancestors 'self'"
)
"""The browser itself refuses to fetch anything from elsewhere, or to show the view inside another's page."""
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}


@dataclass(frozen=True)
class Served:
    """Files, stream and limits of a server for requests with a known host name."""

    assets: Assets
    stream: Callable[[Send], None]
    known: Callable[[str], bool]
    most_streams: int
    streams: BoundedSemaphore


class Handler(BaseHTTPRequestHandler):
    """Handler of GET and HEAD; other methods are not implemented."""

    served: Served
    timeout = WRITE_TIMEOUT_S
    server_version, sys_version = "nlos-cam", ""

    def do_GET(self) -> None:
        try:
            self._answer(self.path.partition("?")[0])
        except OSError:
            self.close_connection = True  # the browser left, which is its right

    def do_HEAD(self) -> None:
        self.do_GET()

    def _answer(self, path: str) -> None:
        if not self.served.known(self.headers.get("Host", "")):
            self._tell(HTTPStatus.FORBIDDEN, "this is not the name of the machine: open the address as it was told")
        elif path == STREAM_PATH:
            self._answer_stream()
        elif path in self.served.assets:
            kind, content = self.served.assets[path]
            self._begin(HTTPStatus.OK, kind, len(content))
            self._send(content)
        else:
            self._tell(HTTPStatus.NOT_FOUND, "there is nothing here: the view is at /")

    def _answer_stream(self) -> None:
        if not self.served.streams.acquire(blocking=False):
            told = f"{self.served.most_streams} browsers watch already, and no more may: close one, and reload"
            self._tell(HTTPStatus.SERVICE_UNAVAILABLE, told)
            return
        try:
            self._begin(HTTPStatus.OK, "application/octet-stream")
            if self.command != "HEAD":
                self.served.stream(self._send)
        finally:
            self.served.streams.release()

    def _tell(self, status: HTTPStatus, text: str) -> None:
        content = f"{text}\n".encode()
        self._begin(status, "text/plain; charset=utf-8", len(content))
        self._send(content)

    def _begin(self, status: HTTPStatus, kind: str, length: int | None = None) -> None:
        self.send_response(status)
        told = {"Content-Type": kind, **HEADERS}
        if length is not None:
            told["Content-Length"] = str(length)
        for name, value in told.items():
            self.send_header(name, value)
        self.end_headers()

    def _send(self, content: bytes) -> None:
        if self.command == "HEAD":
            return
        for start in range(0, len(content), PIECE_BYTES):
            self.wfile.write(content[start : start + PIECE_BYTES])

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  the name http.server uses
        pass


def handler_of(
    assets: Assets, stream: Callable[[Send], None], known: Callable[[str], bool], most_streams: int
) -> type[Handler]:
    """Return a handler class for requests with a known Host header and a limited number of streams."""
    served = Served(assets, stream, known, most_streams, BoundedSemaphore(most_streams))
    return type("ViewHandler", (Handler,), {"served": served})


LOCAL_NAMES = {"localhost", "127.0.0.1", "::1"}
EVERYWHERE = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104  looked up, not bound
"""Addresses that listen on every interface, and the address for a browser on this machine."""


def resolved(host: str) -> tuple[socket.AddressFamily, str]:
    """Return family and address of a host to listen on. Raises NlosCamError for a name without an address."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError) as error:
        raise NlosCamError(f"--view-host {host}: no such address ({error}): give one of this machine's") from error
    family, *_, address = found[0]
    return family, str(address[0])


def is_loopback(address: str) -> bool:
    """Return True if only this machine reaches an address."""
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


def exposed(host: str, port: int) -> str:
    """Return a line about who else can see the view at a host; empty on the loopback.

    Raises NlosCamError for a name without an address.
    """
    _, address = resolved(host)
    if is_loopback(address):
        return ""
    where = "any address of this machine" if address in EVERYWHERE else address
    return (
        f"anyone who can reach {where} at port {port} sees the bench's pictures and depth, unencrypted and without a "
        "password"
    )


def names_of(host: str, address: str) -> Callable[[str], bool]:
    """Return the check of a Host header: this machine's names, or an address (which no name server can forge)."""
    names = LOCAL_NAMES | {host.lower(), socket.gethostname().lower()}
    local_only = is_loopback(address)

    def known(header: str) -> bool:
        name = name_in(header)
        return name in LOCAL_NAMES if local_only else name in names or _is_address(name)

    return known


def name_in(header: str) -> str:
    """Return the host of a Host header without its port, which differs behind a forwarded port."""
    name = header.strip().lower()
    if name.startswith("["):
        return name[1:].partition("]")[0]
    return name.rpartition(":")[0] if ":" in name else name


def address_of(host: str, port: int) -> str:
    """Return the URL for a browser on this machine."""
    host = EVERYWHERE.get(host, host)
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


__all__ = ["Send", "ViewServer"]

MAX_CONNECTIONS = 32
"""Connections at once; a further one is closed."""
CLOSE_AFTER_S = 1.0
"""Seconds that ended streams have before their connections are cut."""


class _Threads(ThreadingHTTPServer):
    """Server with a limited number of connection threads, all joined by `server_close`."""

    daemon_threads = False  # so that closing waits for them
    allow_reuse_address = os.name == "posix"  # elsewhere two programs would share the port
    allow_reuse_port = False

    def __init__(self, family: socket.AddressFamily, host: str, port: int, handler: Any) -> None:
        self.address_family = family
        self._room = BoundedSemaphore(MAX_CONNECTIONS)
        self._open: set[socket.socket] = set()
        self._changed = Condition()
        super().__init__((host, port), handler)

    def server_bind(self) -> None:
        """Bind without a name lookup of this machine, which may take long."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._room.acquire(blocking=False):
            self.shutdown_request(request)
            return
        with self._changed:
            self._open.add(request)
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._changed:
                self._open.discard(request)
                self._changed.notify_all()
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore broken connections: no traceback on the terminal."""

    def cut(self, after_s: float) -> None:
        """Wait for the connections to end, then cut the others."""
        with self._changed:
            self._changed.wait_for(lambda: not self._open, after_s)
            for request in self._open:
                with suppress(OSError):
                    request.shutdown(socket.SHUT_RDWR)


class ViewServer:
    """Server that runs from its construction until `close`, in its own thread.

    Takes the preferred port, or any free one if that is busy, unless `exact`. Raises NlosCamError if it cannot listen.
    """

    def __init__(
        self,
        assets: Assets,
        stream: Callable[[Send], None],
        preferred_port: int,
        *,
        host: str = LOOPBACK,
        exact: bool = False,
        most_streams: int = MAX_STREAMS,
    ) -> None:
        family, self._host = resolved(host)
        handler = handler_of(assets, stream, names_of(host, self._host), most_streams)
        self._server = self._listening(family, preferred_port, handler, exact=exact)
        self.port: int = self._server.server_address[1]
        self._thread = Thread(target=self._server.serve_forever, args=(0.1,), name="view server")
        self._thread.start()

    def _listening(self, family: socket.AddressFamily, port: int, handler: Any, *, exact: bool) -> _Threads:
        try:
            try:
                return _Threads(family, self._host, port, handler)
            except OSError:
                if exact:
                    raise
                return _Threads(family, self._host, 0, handler)
        except OSError as error:
            what = f"the view cannot be served at {address_of(self._host, port)} ({error.strerror})"
            raise NlosCamError(f"{what}: choose another --view-port or --view-host, or leave them away") from error

    @property
    def address(self) -> str:
        """Return the URL for a browser on this machine."""
        return address_of(self._host, self.port)

    def close(self) -> None:
        """Stop listening and wait for running answers; end the streams first."""
        self._server.shutdown()
        self._thread.join()
        self._server.cut(CLOSE_AFTER_S)
        self._server.server_close()
