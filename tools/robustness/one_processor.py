"""A live run with its page on one processor, beside a busy program: docs/figures/one_processor.json, by user.

`one_processor.py [--minutes M] [--user NAME] [--out FILE]`, on Linux. All processes of the run, a
program that only counts, and a browser that watches the stream share the processor `--processor`.
Commands of the page are sent every 5 s by turns; the last act is Ctrl-C. Prints how long each
command took, which part of the processor the other program got, and the seconds until the run had
ended. Exits with 1 if a command took over 2 s, the other program got less than half, or Ctrl-C took
over 5 s. As root the run may ask for real-time priority; `--user` runs it as another.
"""

import argparse
import json
import os
import platform
import pwd
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from http.client import HTTPConnection, HTTPException
from itertools import cycle
from pathlib import Path
from threading import Event, Thread
from urllib.parse import urlsplit

from live_process import ADDRESS, LiveProcess

MAX_COMMAND_S = 2.0
MIN_SHARE = 0.49
MAX_END_S = 5.0
PERIOD_S = 5.0
START_TIMEOUT_S = 600.0
REQUEST_TIMEOUT_S = 60.0
ENDED_WELL = {0, 130}
ROOT = Path(__file__).parents[2]
BUSY = """
import sys, time
until_s = time.monotonic() + float(sys.argv[1])
while time.monotonic() < until_s:
    pass
"""
COMMANDS: tuple[tuple[str, dict[str, object]], ...] = (
    ("pause", {}),
    ("resume", {}),
    ("snapshot", {}),
    ("average", {"frames": 4}),
    ("record", {"label": "cup"}),
    ("stop_recording", {}),
    ("average", {"frames": 1}),
)


@dataclass
class Trial:
    """What a run showed."""

    user: str
    minutes: float
    command_s: dict[str, list[float]] = field(default_factory=dict[str, list[float]])
    refusals: list[str] = field(default_factory=list[str])
    other_share: float = 0.0
    """Part of the other program and of the browser in what they and the run got: on a machine that
    does nothing else, their share of the processor. Where the kernel shares time by sessions
    (autogroup), it is a half at any priority."""
    frames_watched_mib: float = 0.0
    end_s: float | None = None

    def summary(self) -> dict[str, object]:
        """Return the trial with the slowest answer to each command, and the number of answers."""
        slowest_s = {name: max(each) for name, each in self.command_s.items()}
        answers = sum(map(len, self.command_s.values()))
        machine = f"{os.cpu_count()} cores, {platform.machine()}"
        return {**asdict(self), "machine": machine, "command_s": slowest_s, "answers": answers}

    def findings(self) -> list[str]:
        """Return what is out of bounds."""
        slow = [
            f"{name} took {max(each):.1f} s"
            for name, each in self.command_s.items()
            if max(each) > MAX_COMMAND_S
        ]
        if self.other_share < MIN_SHARE:
            slow.append(f"other programs got {self.other_share:.2f} of the processor")
        if self.end_s is None or self.end_s > MAX_END_S:
            slow.append(f"Ctrl-C took {self.end_s} s")
        return [*self.refusals, *slow]


def processor_s(pid: int) -> float:
    """Return the seconds of processor that a process has had."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def send(address: str, token: str, name: str, values: dict[str, object]) -> tuple[float, str]:
    """Send a command of the page; return the seconds it took and the refusal, if any."""
    connection = HTTPConnection(urlsplit(address).netloc, timeout=REQUEST_TIMEOUT_S)
    body = json.dumps({"command": name, **values})
    start_s = time.monotonic()
    try:
        connection.request("POST", "/command", body, {"X-Token": token})
        answer = connection.getresponse()
        text = answer.read().decode()
    finally:
        connection.close()
    took_s = time.monotonic() - start_s
    return took_s, "" if answer.status == 200 else f"{name}: {answer.status} {text.strip()}"


def watch(address: str, stop: Event, trial: Trial) -> None:
    """Read the stream of the view, as a browser does."""
    while not stop.is_set():
        connection = HTTPConnection(urlsplit(address).netloc, timeout=REQUEST_TIMEOUT_S)
        try:
            connection.request("GET", "/stream")
            stream = connection.getresponse()
            while not stop.is_set() and (piece := stream.read1(1 << 16)):
                trial.frames_watched_mib += len(piece) / 2**20
        except (OSError, HTTPException):
            stop.wait(1.0)
        finally:
            connection.close()


def attempt(trial: Trial) -> None:
    """Run live, and fill in the trial."""
    with LiveProcess(["sim"]) as run:
        address = run.wait_for_address(START_TIMEOUT_S)
        token = token_of(run)
        wait_for_camera(address, token)
        stop = Event()
        watcher = Thread(target=watch, args=(address, stop, trial))
        watcher.start()
        time.sleep(PERIOD_S)

        length_s = 60 * trial.minutes + REQUEST_TIMEOUT_S  # it ends by itself if this is killed
        busy = subprocess.Popen([sys.executable, "-S", "-c", BUSY, str(length_s)])
        start_s = time.monotonic()
        browser_s = processor_s(os.getpid())
        before_s = sum(map(processor_s, run.left()))
        for name, values in cycle(COMMANDS):
            if time.monotonic() - start_s > 60 * trial.minutes or run.process.poll() is not None:
                break
            took_s, refusal = send(address, token, name, values)
            trial.command_s.setdefault(name, []).append(round(took_s, 3))
            if refusal:
                trial.refusals.append(refusal)
            time.sleep(max(PERIOD_S - took_s, 0.0))
        other_s = processor_s(busy.pid) + processor_s(os.getpid()) - browser_s
        trial.other_share = other_s / (other_s + sum(map(processor_s, run.left())) - before_s)

        run.process.send_signal(signal.SIGINT)
        trial.end_s = run.ended_within(60.0)
        stop.set()
        busy.kill()
        busy.wait()
        watcher.join()
        if run.process.returncode not in ENDED_WELL:
            trial.refusals.append("\n".join(run.said[-3:]))


def wait_for_camera(address: str, token: str) -> None:
    """Wait until commands are answered: a user without a cache compiles the kernels first."""
    until_s = time.monotonic() + START_TIMEOUT_S
    while send(address, token, "average", {"frames": 1})[1] and time.monotonic() < until_s:
        time.sleep(1.0)


def token_of(run: LiveProcess) -> str:
    """Return the token that lets a page control, from the printed address."""
    line = next(line for line in run.said if ADDRESS.search(line))
    return line.partition("#")[2].split()[0]


def main() -> int:
    """Try; write; return 1 after a finding."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--processor", type=int, default=0)
    parser.add_argument("--user", default="")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "docs" / "figures" / "one_processor.json"
    )
    chosen = parser.parse_args()
    trials = json.loads(chosen.out.read_text(encoding="utf-8")) if chosen.out.exists() else {}
    kept = chosen.out.open("w", encoding="utf-8")  # before the user is another
    json.dump(trials, kept)
    kept.flush()  # the trials of other users stay, whatever ends this one
    os.sched_setaffinity(0, {chosen.processor})
    with tempfile.TemporaryDirectory() as name:
        if chosen.user:
            entry = pwd.getpwnam(chosen.user)
            os.chown(name, entry.pw_uid, entry.pw_gid)
            os.setgid(entry.pw_gid)
            os.setuid(entry.pw_uid)
            os.environ["HOME"] = name
        trial = Trial(chosen.user or pwd.getpwuid(os.getuid()).pw_name, chosen.minutes)
        os.chdir(name)  # the page's snapshots and recordings go there
        attempt(trial)
    trials[trial.user] = trial.summary()
    kept.seek(0)
    kept.truncate()
    kept.write(json.dumps(trials, indent=1) + "\n")
    kept.close()
    print(json.dumps(trials[trial.user], indent=1))
    for finding in trial.findings():
        print("finding:", finding, file=sys.stderr)
    return 1 if trial.findings() else 0


if __name__ == "__main__":
    sys.exit(main())
