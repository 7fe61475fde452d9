"""Web server of the view: fixed files, one endless stream per browser, and commands; on the
loopback by default.

The view has no password, therefore: foreign host names are refused (DNS rebinding would let a page
elsewhere read the view through a visitor's browser), requests that another site's page makes are
refused, a command needs the token of the printed address, streams and connections are limited, and
a browser that sends or reads too slowly is cut.
"""

import gzip
import hmac
import ipaddress
import json
import os
import re
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from socketserver import TCPServer
from threading import BoundedSemaphore, Condition, Thread
from typing import Any
from urllib.parse import unquote

from nlos_cam.errors import NlosCamError

LOOPBACK = "127.0.0.1"
STREAM_PATH = "/stream"
COMMAND_PATH = "/command"
FILES_PATH = "/files/"
TIMEOUT_S = 5.0
"""Seconds for a whole request, and for each piece of an answer, after which a browser is cut."""
PIECE_BYTES = 1 << 18
MAX_REQUEST_BYTES = 1 << 16
MIN_PACKED_BYTES = 1 << 10
MAX_PACKED_BYTES = 1 << 20
"""Sizes of assets that are sent in gzip to browsers that take it."""
MAX_STREAMS = 8
"""Browsers that watch at once."""
MAX_CONNECTIONS = 32
"""Connections at once; a further one takes the place of the oldest whose request is not whole yet,
or is closed.
"""
CLOSE_AFTER_S = 1.0
"""Seconds that ended streams have before their connections are cut."""
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; frame-ancestors 'self'"
)
"""The browser itself refuses to fetch anything from elsewhere, or to show the view inside another's
page.
"""
SANDBOX = f"{POLICY}; sandbox allow-scripts allow-downloads"
"""Policy for a page that came as a file, from anybody: its scripts run in an origin of their own,
and so have neither the storage, the stream nor the commands of a live run at the same address.
"""
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}

Send = Callable[[bytes], None]
Assets = Mapping[str, tuple[str, bytes]]
"""Content type and bytes by path."""
Command = Callable[[str, Mapping[str, Any]], str]
"""Runs a command by name with its arguments and returns its outcome in words. Raises NlosCamError
with the reason.
"""


@dataclass(frozen=True)
class Served:
    """Files, stream, commands and limits of a server."""

    assets: Assets
    stream: Callable[[Send], None]
    command: Command | None = None
    """None for a view without controls."""
    token: str = ""
    """Secret that a command, or who asks for a file, must bring."""
    file: Callable[[str], Path | None] = field(default=lambda _: None)
    """Path of a file that a command wrote, by its name alone."""
    max_streams: int = MAX_STREAMS
    known: Callable[[str], bool] = field(default=lambda _: False)
    """Check of a Host header."""
    policy: str = POLICY
    """Content-Security-Policy of every answer."""


class Handler(BaseHTTPRequestHandler):
    """Handler of GET, HEAD and POST; other methods are not implemented."""

    served: Served
    packed: Mapping[str, bytes]
    """Assets in gzip, by path; large ones are left out."""
    streams: BoundedSemaphore
    timeout = TIMEOUT_S
    server_version = "nlos-cam"
    sys_version = ""

    def setup(self) -> None:
        super().setup()
        self.rfile = BytesIO(self._whole_request())
        self.server.request_read(self.request)  # type: ignore[attr-defined]

    def _whole_request(self) -> bytes:
        """Read one request within TIMEOUT_S in all: a byte now and then would else hold a
        connection for ever.
        """
        deadline_s = time.monotonic() + TIMEOUT_S
        content = b""
        while len(content) < _request_bytes(content) <= MAX_REQUEST_BYTES:
            self.request.settimeout(max(deadline_s - time.monotonic(), 1e-3))
            more = self.request.recv(1 << 14)
            if not more:
                break
            content += more
        self.request.settimeout(TIMEOUT_S)
        return content

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_HEAD(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def _answer(self, answer: Callable[[str], None]) -> None:
        path = self.path.partition("?")[0]
        try:
            if not self.served.known(self.headers.get("Host", "")):
                self._forbid("this is not a name of the machine: open the address that it printed")
            elif self._is_foreign(path):
                self._forbid("a page of another site may not ask: open the address yourself")
            else:
                answer(path)
        except OSError:
            self.close_connection = True  # the browser left, which is its right

    def _is_foreign(self, path: str) -> bool:
        """Return True for a request made by another site's page, unless it only leads a person to
        the page.
        """
        origin = self.headers.get("Origin")
        if origin is not None and origin.partition("://")[2] != self.headers.get("Host", ""):
            return True
        visits = path == "/" and self.headers.get("Sec-Fetch-Mode", "navigate") == "navigate"
        is_ours = self.headers.get("Sec-Fetch-Site", "none") in {"none", "same-origin"}
        return not (is_ours or visits)

    def _get(self, path: str) -> None:
        if path == STREAM_PATH:
            self._answer_stream()
        elif path.startswith(FILES_PATH):
            self._answer_file(unquote(path.removeprefix(FILES_PATH)))
        elif path in self.served.assets:
            self._answer_asset(path)
        else:
            self._say(HTTPStatus.NOT_FOUND, "there is nothing here: the view is at /")

    def _answer_asset(self, path: str) -> None:
        kind, content = self.served.assets[path]
        headers = {"Vary": "Accept-Encoding"}
        if path in self.packed and _takes_gzip(self.headers.get("Accept-Encoding", "")):
            headers["Content-Encoding"] = "gzip"
            content = self.packed[path]
        self._begin(HTTPStatus.OK, kind, len(content), headers)
        self._send(content)

    def _answer_file(self, name: str) -> None:
        """Send a file that a command wrote, to who may command."""
        path = self.served.file(name)
        if not self._has_token():
            self._forbid(
                "read-only: open the address that was printed, with its token, to download"
            )
        elif path is None or not path.is_file():
            self._say(HTTPStatus.NOT_FOUND, "this run wrote no such file, or it was moved away")
        else:
            with path.open("rb") as file:
                self._begin(HTTPStatus.OK, "application/octet-stream", path.stat().st_size)
                while piece := file.read(PIECE_BYTES):
                    self._send(piece)

    def _has_token(self) -> bool:
        token = self.headers.get("X-Token", "")
        return hmac.compare_digest(token.encode(), self.served.token.encode())

    def _answer_stream(self) -> None:
        if not self.streams.acquire(blocking=False):
            most = self.served.max_streams
            self._say(
                HTTPStatus.SERVICE_UNAVAILABLE,
                f"{most} browsers watch already: close one to watch here",
            )
            return
        try:
            self._begin(HTTPStatus.OK, "application/octet-stream")
            if self.command != "HEAD":
                self.served.stream(self._send)
        finally:
            self.streams.release()

    def _post(self, path: str) -> None:
        run = self.served.command
        if path != COMMAND_PATH or run is None:
            self._say(HTTPStatus.NOT_FOUND, "this view has no controls")
        elif not self._has_token():
            self._forbid("read-only: open the address that was printed, with its token, to control")
        else:
            self._run_command(run)

    def _run_command(self, run: Command) -> None:
        try:
            request = json.loads(self.rfile.read())
            name = str(request.pop("command"))
            arguments = dict[str, Any](request)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            self._say(HTTPStatus.BAD_REQUEST, 'not a command: send {"command": NAME, ...} as JSON')
            return

        try:
            outcome = run(name, arguments)
        except NlosCamError as error:
            self._say(HTTPStatus.CONFLICT, str(error))
        except OSError:
            raise
        except Exception as error:  # noqa: BLE001  whatever it was, the page says it, and the run goes on
            reason = f"unforeseen {type(error).__name__}: {error}"
            self._say(HTTPStatus.INTERNAL_SERVER_ERROR, reason)
        else:
            self._say(HTTPStatus.OK, outcome)

    def _forbid(self, text: str) -> None:
        self._say(HTTPStatus.FORBIDDEN, text)

    def _say(self, status: HTTPStatus, text: str) -> None:
        content = f"{text}\n".encode(errors="backslashreplace")
        self._begin(status, "text/plain; charset=utf-8", len(content))
        self._send(content)

    def _begin(
        self,
        status: HTTPStatus,
        kind: str,
        length: int | None = None,
        others: Mapping[str, str] | None = None,
    ) -> None:
        self.send_response(status)
        policy = {"Content-Security-Policy": self.served.policy}
        headers = {"Content-Type": kind, **policy, **HEADERS, **(others or {})}
        if length is not None:
            headers["Content-Length"] = str(length)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()

    def _send(self, content: bytes) -> None:
        if self.command != "HEAD":
            # The timeout holds for a whole piece.
            for start in range(0, len(content), PIECE_BYTES):
                self.wfile.write(content[start : start + PIECE_BYTES])

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  the name http.server uses
        pass


def _takes_gzip(accepted: str) -> bool:
    """Return True for an Accept-Encoding that names gzip, and not with a weight of zero."""
    for part in accepted.lower().replace(" ", "").split(","):
        name, _, weight = part.partition(";")
        if name == "gzip":
            return weight.rstrip("0") not in {"q=", "q=0."}
    return False


def _packed(assets: Assets) -> dict[str, bytes]:
    """Compress assets, once for all browsers; large ones hold pictures, which do not shrink."""
    return {
        path: gzip.compress(content, mtime=0)
        for path, (_, content) in assets.items()
        if MIN_PACKED_BYTES <= len(content) <= MAX_PACKED_BYTES
    }


def _request_bytes(content: bytes) -> int:
    """Return the bytes of a request of which `content` has come so far: at least one more until its
    head is whole.
    """
    head, end, _ = content.partition(b"\r\n\r\n")
    if not end:
        return len(content) + 1
    length = re.search(rb"\r\ncontent-length: *(\d{1,9})\r\n", head.lower() + b"\r\n")
    return len(head) + len(end) + int(length[1]) if length else len(content)


LOCAL_NAMES = {"localhost", "127.0.0.1", "::1"}
EVERYWHERE = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104  looked up, not bound
"""Addresses that listen on every interface, and the address for a browser on this machine."""
HOST = re.compile(r"(?:\[(?P<six>[0-9a-f:.%]+)\]|(?P<name>[^\[\]:]*))(?::\d{1,5})?")


def resolved(host: str) -> tuple[socket.AddressFamily, str]:
    """Return family and address of a host to listen on. Raises NlosCamError for a name without an
    address.
    """
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError) as error:
        reason = "it has no address" if isinstance(error, OSError) else "it is no host name"
        raise NlosCamError(
            f"--view-host {host}: {reason}; give a name or address of this machine"
        ) from error
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
        f"anyone who can reach {where} at port {port} sees the bench's pictures and depth,"
        " unencrypted and without a password; controls need the token in the address"
    )


def names_of(host: str, address: str) -> Callable[[str], bool]:
    """Return the check of a Host header: this machine's names, or an address (which no name server
    can forge). On the loopback only the host itself, its address and the usual names.
    """
    local_only = is_loopback(address)
    names = LOCAL_NAMES | {host.lower(), address.lower()}
    if not local_only:
        names |= {socket.gethostname().lower()}
    names -= {""}  # what a malformed header names

    def known(header: str) -> bool:
        name = name_in(header)
        return name in names or (not local_only and _is_address(name))

    return known


def name_in(header: str) -> str:
    """Return the host of a Host header without its port, which differs behind a forwarded port;
    empty if malformed.
    """
    found = HOST.fullmatch(header.strip().lower())
    return (found["six"] or found["name"] or "") if found else ""


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


class _Threads(ThreadingHTTPServer):
    """Server with a limited number of connection threads, all joined by `server_close`."""

    daemon_threads = False  # so that closing waits for them
    allow_reuse_address = os.name == "posix"  # elsewhere two programs would share the port
    allow_reuse_port = False
    request_queue_size = 64

    def __init__(self, family: socket.AddressFamily, host: str, port: int, handler: Any) -> None:
        self.address_family = family
        self._room = BoundedSemaphore(MAX_CONNECTIONS)
        self._open: dict[socket.socket, bool] = {}
        """By connection, oldest first, whether its request was read."""
        self._changed = Condition()
        super().__init__((host, port), handler)

    def server_bind(self) -> None:
        """Bind without a name lookup of this machine, which may take long."""
        TCPServer.server_bind(self)
        self.server_name = str(self.server_address[0])
        self.server_port = self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._room.acquire(blocking=False) and not self._cut_unread():
            self.shutdown_request(request)
            return
        with self._changed:
            self._open[request] = False
        super().process_request(request, client_address)

    def _cut_unread(self) -> bool:
        """Cut the oldest connection whose request is not whole, and take its place; return False
        without one.
        """
        with self._changed:
            unread = next((request for request, is_read in self._open.items() if not is_read), None)
            if unread is not None:
                with suppress(OSError):
                    unread.shutdown(socket.SHUT_RDWR)
        return unread is not None and self._room.acquire(timeout=CLOSE_AFTER_S)

    def request_read(self, request: socket.socket) -> None:
        """Note that a connection's request is whole."""
        with self._changed:
            self._open[request] = True

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._changed:
                self._open.pop(request, None)
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

    Takes the preferred port, or any free one if that is busy, unless `exact`. Raises NlosCamError
    if it cannot listen.
    """

    def __init__(
        self, served: Served, preferred_port: int, *, host: str = LOOPBACK, exact: bool = False
    ) -> None:
        family, self._host = resolved(host)
        members = {
            "served": replace(served, known=names_of(host, self._host)),
            "packed": _packed(served.assets),
            "streams": BoundedSemaphore(served.max_streams),
        }
        self._server = self._listening(
            family, preferred_port, type("ViewHandler", (Handler,), members), exact=exact
        )
        self.port: int = self._server.server_address[1]
        self._thread = Thread(target=self._server.serve_forever, args=(0.1,), name="view server")
        self._thread.start()

    def _listening(
        self, family: socket.AddressFamily, port: int, handler: Any, *, exact: bool
    ) -> _Threads:
        try:
            try:
                return _Threads(family, self._host, port, handler)
            except OSError:
                if exact:
                    raise
                return _Threads(family, self._host, 0, handler)
        except OSError as error:
            problem = (
                f"the view cannot be served at {address_of(self._host, port)} ({error.strerror})"
            )
            raise NlosCamError(
                f"{problem}: choose another --view-port or --view-host, or drop them"
            ) from error

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
