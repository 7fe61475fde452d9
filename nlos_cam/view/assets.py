"""Files of the web page: ours, and the Rerun viewer compiled for the browser."""

import os
import socket
import subprocess
import time
from collections.abc import Generator, Mapping
from contextlib import closing, contextmanager
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException
from importlib import resources
from pathlib import Path

from nlos_cam.errors import NlosCamError

START_TIMEOUT_S = 20.0
LOOPBACK = "127.0.0.1"
VIEWER_FILES = {"/re_viewer.js": "text/javascript", "/re_viewer_bg.wasm": "application/wasm"}

Assets = Mapping[str, tuple[str, bytes]]
"""Content type and bytes by path."""


LIVE, RECORDED = b'data-time="live"', b'data-time="recorded"'
"""Marker in the page that selects the time panel."""


def page_assets(*, recorded: bool = False) -> Assets:
    """Return every file that the page loads, so that a browser fetches nothing from elsewhere.

    A `recorded` page has a time panel. Rerun's own server provides its compiled files; it is started for that and
    stopped. Its page loads fonts from the internet and its data port listens on every interface, so neither is used.
    Raises NlosCamError.
    """
    page = (resources.files("nlos_cam.view") / "page.html").read_bytes()
    page = page.replace(LIVE, RECORDED) if recorded else page
    with _viewer_files_server() as port:
        files = {path: (kind, _fetch(port, path)) for path, kind in VIEWER_FILES.items()}
    return {"/": ("text/html; charset=utf-8", page), **files}


@contextmanager
def _viewer_files_server() -> Generator[int]:
    """Run Rerun's own web server within the block; yield its port on the loopback."""
    port, unused = _free_port(), _free_port()
    ports = ["--port", str(unused), "--web-viewer-port", str(port)]
    command = [str(_rerun_program()), "--serve-web", "--bind", LOOPBACK, *ports]
    environment = {**os.environ, "CI": "1"}  # in a CI the program collects no usage data
    devnull = subprocess.DEVNULL
    with subprocess.Popen(command, env=environment, stdin=devnull, stdout=devnull, stderr=devnull) as server:
        try:
            _wait_until_served(port, server)
            yield port
        finally:
            server.kill()


def _rerun_program() -> Path:
    import rerun_cli

    folder = Path(str(rerun_cli.__file__)).parent
    names = ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun")
    found = [folder / name for name in names if (folder / name).is_file()]
    if not found:
        raise NlosCamError(f"the Rerun viewer is not in {folder}: reinstall rerun-sdk, or run with --no-view")
    return found[0]


def _wait_until_served(port: int, server: subprocess.Popen[bytes]) -> None:
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline_s:
        if server.poll() is not None:
            break
        try:
            socket.create_connection((LOOPBACK, port), timeout=1.0).close()
        except OSError:
            time.sleep(0.02)
        else:
            return
    raise NlosCamError(f"the Rerun viewer's files were not served within {START_TIMEOUT_S:.0f} s: run with --no-view")


def _fetch(port: int, path: str) -> bytes:
    with closing(HTTPConnection(LOOPBACK, port, timeout=START_TIMEOUT_S)) as connection:
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            content = answer.read()
        except (OSError, HTTPException) as error:
            raise NlosCamError(f"the Rerun viewer did not hand out {path}: {error}; run with --no-view") from error
    if answer.status != HTTPStatus.OK:
        raise NlosCamError(f"this rerun-sdk has no {path} ({answer.status}): reinstall it, or run with --no-view")
    return content


def _free_port() -> int:
    with socket.create_server((LOOPBACK, 0)) as probe:
        return probe.getsockname()[1]
