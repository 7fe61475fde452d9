"""Watchers, idle and slow connections, and hostile requests against a live loop: docs/view_attack.json.

`attack_view.py [--watchers N] [--connections N] [--seconds S] [--camera URI] [--out FILE]`. A person's page is
fetched every second, and the loop's frames and drops are read from its log. Exits with 1 where a page was not served,
or where threads or memory stay raised.
"""

import argparse
import json
import os
import random
import selectors
import signal
import socket
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from threading import Event, Thread
from typing import Any
from urllib.parse import urlsplit

from live_process import LiveProcess
from soak import FrameLog, state_of

from nlos_cam.evaluate import machine

DOCS = Path(__file__).parents[2] / "docs"
START_TIMEOUT_S, END_TIMEOUT_S, REST_S = 600.0, 180.0, 20.0
WATCHING, WATCHED_BYTES, PAGE_TIMEOUT_S = 6, 1 << 15, 20.0
"""Watchers at once, and bytes that each reads; time for a person's page."""
SENDERS, ANSWER_TIMEOUT_S = 4, 0.2
"""Hostile requests at once, and time for the answer to one."""
MAX_MORE_MIB, MAX_MORE_THREADS = 32, 2
HOST = b"Host: 127.0.0.1\r\n"
REQUESTS: tuple[bytes, ...] = (
    b"GET /" + b"x" * 70_000 + b" HTTP/1.1\r\n" + HOST + b"\r\n",
    b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: [::1].evil.example\r\n\r\n",
    b"GET /stream HTTP/1.1\r\n" + HOST + b"Origin: http://evil.example\r\n\r\n",
    b"GET /stream HTTP/1.1\r\n" + HOST + b"Sec-Fetch-Site: cross-site\r\nSec-Fetch-Mode: no-cors\r\n\r\n",
    b"GET /../../etc/passwd HTTP/1.1\r\n" + HOST + b"\r\n",
    b"GET /%2e%2e/%2e%2e/etc/passwd HTTP/1.1\r\n" + HOST + b"\r\n",
    b"GET / HTTP/1.1\r\n" + HOST + b"X: y\r\n" * 2000 + b"\r\n",
    b"GET / HTTP/9.9\r\n" + HOST + b"\r\n",
    b"DELETE / HTTP/1.1\r\n" + HOST + b"\r\n",
    b"POST /command HTTP/1.1\r\n" + HOST + b"Content-Length: 999999999\r\n\r\n{",
    b"POST /command HTTP/1.1\r\n" + HOST + b"Content-Length: -1\r\n\r\n{}",
    b"POST /command HTTP/1.1\r\n" + HOST + b"X-Token: x\r\nContent-Length: 20000\r\n\r\n" + b"[" * 20_000,
    b"POST /command HTTP/1.1\r\n" + HOST + b'X-Token: \xff\xfe\r\nContent-Length: 16\r\n\r\n{"command":"x"} ',
    b"GET / HTTP/1.1\r\n" + HOST + b"\r\n" + b"GET /stream HTTP/1.1\r\n" + HOST + b"\r\n" * 50,
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(300),
    b"\x00" * 60_000,
    b"GET",
)


def page_ms(address: str) -> float | None:
    """Fetch the page as a person's browser does; return its milliseconds, None where it was not served."""
    start_s = time.monotonic()
    connection = HTTPConnection(urlsplit(address).netloc, timeout=PAGE_TIMEOUT_S)
    with suppress(OSError, HTTPException):
        connection.request("GET", "/", headers={"Sec-Fetch-Site": "none", "Sec-Fetch-Mode": "navigate"})
        answer = connection.getresponse()
        if answer.status == 200 and answer.read():
            return 1e3 * (time.monotonic() - start_s)
    connection.close()
    return None


@contextmanager
def person(address: str) -> Generator[list[float | None]]:
    """Fetch the page once a second until the end of the block."""
    stop, found = Event(), list[float | None]()

    def fetch() -> None:
        while not stop.wait(1.0):
            found.append(page_ms(address))

    thread = Thread(target=fetch)
    thread.start()
    try:
        yield found
    finally:
        stop.set()
        thread.join()


def come_and_go(address: str, count: int) -> Counter[str]:
    """Let watchers read the stream for a moment and leave; count them, and how often all places were taken."""
    seen = Counter[str]()

    def watch() -> None:
        while seen["watched"] < count and seen["refused"] < 20 * count:
            connection, read = HTTPConnection(urlsplit(address).netloc, timeout=PAGE_TIMEOUT_S), 0
            with suppress(OSError, HTTPException):
                connection.request("GET", "/stream")
                answer = connection.getresponse()
                while read < WATCHED_BYTES and (content := answer.read1(1 << 14)):
                    read += len(content)
            seen["watched" if read >= WATCHED_BYTES else "refused"] += 1
            connection.close()

    run_all([Thread(target=watch) for _ in range(WATCHING)])
    return seen


def run_all(threads: list[Thread]) -> None:
    """Run threads to their end."""
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def hold(address: str, count: int, seconds: float) -> Counter[str]:
    """Open connections of which half say nothing and half send a byte a second; open again those that are cut."""
    place, selector, result = urlsplit(address), selectors.DefaultSelector(), Counter[str]()
    until_s, opened = time.monotonic() + seconds, 0
    while opened < count or time.monotonic() < until_s:
        if opened < count:
            for _ in range(50):
                with suppress(OSError):
                    one = socket.create_connection((place.hostname or "", place.port or 0), timeout=2.0)
                    one.setblocking(False)
                    selector.register(one, selectors.EVENT_READ, opened % 2)
                opened += 1
        for key, _ in selector.select(0.2):
            with suppress(OSError):
                if key.fileobj.recv(1 << 12):  # type: ignore[union-attr]
                    continue
            selector.unregister(key.fileobj)
            key.fileobj.close()  # type: ignore[union-attr]
            result["cut"] += 1
        for key in [*selector.get_map().values()]:
            if key.data:
                with suppress(OSError):
                    key.fileobj.send(b"G")  # type: ignore[union-attr]
    for key in [*selector.get_map().values()]:
        key.fileobj.close()  # type: ignore[union-attr]
        result["held to the end"] += 1
    return result + Counter(opened=opened)


def insult(address: str, seconds: float) -> Counter[str]:
    """Send hostile requests, whole or cut at random, a few at once, and count the answers by status."""
    place, answers, until_s = urlsplit(address), Counter[str](), time.monotonic() + seconds

    def send(seed: int) -> None:
        draw = random.Random(seed)  # noqa: S311
        while time.monotonic() < until_s:
            request, answer = draw.choice(REQUESTS), b""
            request = request if draw.random() < 0.7 else request[: draw.randrange(1, len(request))]
            with suppress(OSError), socket.create_connection((place.hostname or "", place.port or 0), 1.0) as one:
                one.settimeout(ANSWER_TIMEOUT_S)
                one.sendall(request)
                answer = one.recv(64)
            answers[answer[9:12].decode("ascii", "replace") if answer.startswith(b"HTTP") else "no answer"] += 1

    run_all([Thread(target=send, args=(seed,)) for seed in range(SENDERS)])
    return answers


def rest(seconds: float) -> Counter[str]:
    """Do nothing, for comparison."""
    time.sleep(seconds)
    return Counter()


def look(run: LiveProcess, log: Path) -> dict[str, float]:
    """Return memory, threads and descriptors of the process, and its frames and drops so far."""
    rss_mib, threads, descriptors = state_of(run.process.pid)
    rows = FrameLog(log).rows()
    dropped = float(next((value for name, value in rows[-1].items() if "dropped" in name), 0) or 0) if rows else 0.0
    state = {"rss_mib": round(rss_mib, 1), "threads": threads, "descriptors": descriptors}
    return state | {"frames": len(rows), "dropped": dropped}


def main() -> int:
    """Attack in turn, write after each attack; return 1 where something was refused or stayed raised."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--watchers", type=int, default=1000)
    parser.add_argument("--connections", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=60.0, help="of hostile requests, and of a quiet look before")
    parser.add_argument("--camera", default="sim")
    parser.add_argument("--out", type=Path, default=DOCS / "view_attack.json")
    chosen = parser.parse_args()
    attacks: dict[str, Callable[[str], Counter[str]]] = {
        "nobody": lambda _: rest(chosen.seconds),
        "watchers": lambda address: come_and_go(address, chosen.watchers),
        "connections": lambda address: hold(address, chosen.connections, chosen.seconds),
        "requests": lambda address: insult(address, chosen.seconds),
    }
    facts: dict[str, Any] = {"machine": machine(), "load_at_start": os.getloadavg()[0], "camera": chosen.camera}
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "frames.csv"
        with LiveProcess([chosen.camera, "--log", str(log), "--json"]) as run:
            address = run.wait_for_address(START_TIMEOUT_S).partition("#")[0]
            while not (log.exists() and len(FrameLog(log).rows()) > 60) and run.process.poll() is None:
                time.sleep(1.0)
            for number, (name, attack) in enumerate(attacks.items()):
                if number == 1:
                    facts["before"] = look(run, log)
                before = look(run, log)
                with person(address) as pages:
                    result = attack(address)
                after, served = look(run, log), sorted(page for page in pages if page is not None)
                row: dict[str, Any] = {"result": dict(result), "pages": len(pages), "served": len(served)}
                row["page_ms_most"] = round(served[-1], 1) if served else None
                facts[name] = row | {key: after[key] - before[key] for key in ("frames", "dropped")}
                print(name, facts[name], file=sys.stderr)
            time.sleep(REST_S)
            facts["after"] = look(run, log)
            run.process.send_signal(signal.SIGINT)
            facts["seconds_to_end"] = run.ended_within(END_TIMEOUT_S)
            facts["exit_code"] = run.process.poll()
    more = {key: facts["after"][key] - facts["before"][key] for key in ("rss_mib", "threads", "descriptors")}
    refused = [name for name in attacks if facts[name]["served"] < facts[name]["pages"]]
    facts["good"] = not refused and more["threads"] <= MAX_MORE_THREADS and more["rss_mib"] <= MAX_MORE_MIB
    chosen.out.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(facts, indent=1))
    return int(not facts["good"])


if __name__ == "__main__":
    sys.exit(main())
