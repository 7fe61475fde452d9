"""A web server for the view: fixed files, and one endless stream per browser, on the loopback unless asked otherwise.

Whoever may connect may look, so: a name that is not this machine's is refused (a page elsewhere that had its own name
point here could read the view through a visitor's browser), nothing can be written, and streams and connections are
limited. A browser that takes no data is let go.
"""

import os
import socket
from collections.abc import Callable
from contextlib import suppress
from http.server import ThreadingHTTPServer
from socketserver import TCPServer
from threading import BoundedSemaphore, Condition, Thread
from typing import Any

from nlos_cam.errors import NlosCamError
from nlos_cam.view.assets import LOOPBACK, Assets
from nlos_cam.view.hosts import address_of, names_of, resolved
from nlos_cam.view.requests import MOST_STREAMS, Send, handler_of

__all__ = ["Send", "ViewServer"]

MOST_CONNECTIONS = 32
"""At once; a further one is closed."""
CLOSE_AFTER_S = 1.0
"""Streams that were told to end have so long to do so, before their connections are cut."""


class _Threads(ThreadingHTTPServer):
    """A thread for each connection, as many as there is room for, none of which outlives `server_close`."""

    daemon_threads = False  # so that closing waits for them
    allow_reuse_address = os.name == "posix"  # elsewhere two programs would share the port
    allow_reuse_port = False

    def __init__(self, family: socket.AddressFamily, host: str, port: int, handler: Any) -> None:
        self.address_family = family
        self._room = BoundedSemaphore(MOST_CONNECTIONS)
        self._open: set[socket.socket] = set()
        self._changed = Condition()
        super().__init__((host, port), handler)

    def server_bind(self) -> None:
        """Without asking a name server what this machine is called, which may take long and serves nothing here."""
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
        """A connection that breaks is the browser's right, and no traceback on the person's terminal."""

    def cut(self, after_s: float) -> None:
        """Wait so long for the connections to end, and cut those that do not."""
        with self._changed:
            self._changed.wait_for(lambda: not self._open, after_s)
            for request in self._open:
                with suppress(OSError):
                    request.shutdown(socket.SHUT_RDWR)


class ViewServer:
    """Serves from the moment it is made until `close`.

    Takes the preferred port, or any free one if that is busy, unless only that one `exact`ly will do. Raises
    NlosCamError where it cannot listen there.
    """

    def __init__(
        self,
        assets: Assets,
        stream: Callable[[Send], None],
        preferred_port: int,
        *,
        host: str = LOOPBACK,
        exact: bool = False,
        most_streams: int = MOST_STREAMS,
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
        """Where a browser on this machine finds it."""
        return address_of(self._host, self.port)

    def close(self) -> None:
        """Stop listening and wait for the answers under way: the streams must have been told to end."""
        self._server.shutdown()
        self._thread.join()
        self._server.cut(CLOSE_AFTER_S)
        self._server.server_close()
