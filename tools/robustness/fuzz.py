"""Corrupted recordings through everything that reads recordings: docs/fuzz.json (arguments: count, seed).

Every case is run in a process of its own that is watched for crashes, hangs, memory and errors outside the project's
tree. A bad case is printed with its seed and its file is kept: the seed gives the same damage again, although
librealsense stamps a recording with other times in each run. To fuzz another reader, add it to ACTIONS.

`fuzz.py --watch ACTIONS.py WHOLE.bag` is the watched process: it answers one line of JSON per path on stdin.
"""

import json
import resource
import runpy
import select
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from threading import Event
from typing import Self

import numpy as np
from corruption import corrupt
from noise_recordings import make_all
from rosbags.rosbag1 import Reader

from nlos_cam.errors import NlosCamError, RecordingError
from nlos_cam.evaluate import machine
from nlos_cam.recording import BagReader, ExportOptions, ReplayCamera, export_recording, repair_recording

DOCS = Path(__file__).parents[2] / "docs"
MEMORY_BYTES = 1 << 30
"""Allowed above the memory of the process when everything is loaded and a whole recording was read."""
TIMEOUT_S, START_TIMEOUT_S = 10.0, 120.0
GOOD = "done", "refused"

Action = Callable[[Path, Path], None]
"""Reads a recording, and may write into an empty folder; anything but an error of the project's tree is a finding."""
Verdict = tuple[str, str]
"""One of done, refused, unexpected, memory, crash, hang; and details."""


def repair_and_read(path: Path, folder: Path) -> None:
    """Repair, and check that the result holds each of the claimed frames once."""
    out = folder / "repaired.bag"
    claimed = repair_recording(path, out).recovered_frames
    with Reader(out) as reader:
        images = [connection for connection in reader.connections if connection.topic.endswith("/image/data")]
        found = [(connection.id, time_ns) for connection, time_ns, _ in reader.messages(images)]
    if sum(claimed.values()) != len(found):
        raise AssertionError(f"claimed {claimed}, {len(found)} can be read")
    if len(set(found)) != len(found):
        raise AssertionError("a frame is there twice")


def replay_all(path: Path, _: Path) -> None:
    """Replay, and check that frames are whole and in order."""
    last = -1
    with ReplayCamera(path) as camera:
        for frame in camera:
            shape = frame.intrinsics.height, frame.intrinsics.width
            if any(image.shape != shape for image in (frame.depth_m, frame.ir, frame.confidence)):
                raise AssertionError(f"frame {frame.frame_number} is not whole")
            if frame.frame_number <= last:
                raise AssertionError(f"frame {frame.frame_number} comes after {last}")
            last = frame.frame_number


def export_all(path: Path, folder: Path) -> None:
    """Export, and check that the reported number of files was written."""
    made = export_recording(BagReader(path), folder / "export", ExportOptions(points=True), stop=Event())
    for stream, count in made.frames.items():
        if len(list((folder / "export" / stream).iterdir())) != count:
            raise AssertionError(f"reported {count} {stream}, and wrote others")
    if made.damage:
        raise RecordingError(made.damage)


ACTIONS: dict[str, Action] = {"replay": replay_all, "export": export_all, "repair": repair_and_read}


class Watched:
    """Process that runs the actions; restarted when it is lost."""

    def __init__(self, actions: Path, warm_up: Path, timeout_s: float = TIMEOUT_S) -> None:
        self._command = [sys.executable, str(Path(__file__).resolve()), "--watch", str(actions), str(warm_up)]
        self._timeout_s = timeout_s
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def judge(self, path: Path) -> Verdict:
        """Run the actions on a file."""
        process = self._process or self._start()
        verdict = self._ask(process, str(path), self._timeout_s)
        if verdict[0] not in GOOD:
            self._end()
        return verdict

    def _start(self) -> subprocess.Popen[str]:
        self._process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        if (verdict := self._ask(self._process, "", START_TIMEOUT_S))[0] != "done":
            self._end()
            raise RuntimeError(f"the actions fail on a whole recording: {verdict}")
        return self._process

    def _ask(self, process: subprocess.Popen[str], line: str, timeout_s: float) -> Verdict:
        if process.stdin is None or process.stdout is None:
            raise RuntimeError("the process has no pipes")
        process.stdin.write(line + "\n")
        process.stdin.flush()
        if not select.select([process.stdout], [], [], timeout_s)[0]:
            return "hang", f"no answer in {timeout_s:.0f} s"
        if not (answer := process.stdout.readline()):
            return "crash", f"exit code {process.wait()}"
        kind, details = json.loads(answer)
        return kind, details

    def _end(self) -> None:
        if self._process:
            self._process.kill()
            self._process.communicate()
        self._process = None


def watch(actions_file: str, warm_up: str) -> None:
    """Answer one line of JSON to each path on stdin; limit the memory once a whole recording was read."""
    sys.path.insert(0, str(Path(actions_file).parent))
    actions = runpy.run_path(actions_file)["ACTIONS"]
    for number, line in enumerate(sys.stdin):
        print(json.dumps(verdict_of(actions, Path(line.strip() or warm_up))), flush=True)
        if number == 0:
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            limit = pages * resource.getpagesize() + MEMORY_BYTES
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def verdict_of(actions: dict[str, Action], path: Path) -> Verdict:
    """Run every action; return the worst result, or the actions that refused the file and their reasons."""
    refused: list[str] = []
    for name, action in actions.items():
        with tempfile.TemporaryDirectory() as folder:
            try:
                action(path, Path(folder))
            except NlosCamError as error:
                refused.append(f"{name}: {error}")
            except MemoryError:
                return "memory", name
            except Exception as error:  # noqa: BLE001  any other error is a finding
                return "unexpected", f"{name}: {error!r}"
    return ("refused", "\n".join(refused)) if refused else ("done", "")


@dataclass
class Findings:
    """Results of a fuzz: counts by verdict, refusals by action, and the bad cases."""

    verdicts: dict[str, int] = field(default_factory=dict[str, int])
    refused_by: dict[str, int] = field(default_factory=dict[str, int])
    bad: list[dict[str, str | int]] = field(default_factory=list[dict[str, str | int]])


def fuzz(recordings: dict[str, Path], actions: Path, count: int, seed: int, keep: Path) -> Findings:
    """Corrupt recordings `count` times and watch the actions on each; bad cases stay in a folder."""
    findings = Findings()
    contents = {name: path.read_bytes() for name, path in recordings.items()}
    with Watched(actions, next(iter(recordings.values()))) as watched:
        for number in range(seed, seed + count):
            name = list(contents)[number % len(contents)]
            ways, content = corrupt(contents[name], np.random.default_rng(number))
            path = keep / f"{name}-{number}.bag"
            path.write_bytes(content)
            kind, details = watched.judge(path)
            findings.verdicts[kind] = findings.verdicts.get(kind, 0) + 1
            if kind in GOOD:
                path.unlink()
                for action in (line.partition(":")[0] for line in details.splitlines()):
                    findings.refused_by[action] = findings.refused_by.get(action, 0) + 1
            else:
                findings.bad.append({"seed": number, "recording": name, "ways": ways, "verdict": kind, "told": details})
                print(f"{kind}: seed {number}, {path} ({ways}): {details}")
    return findings


def main() -> int:
    """Fuzz, write, print; return 1 where a case is bad."""
    count, seed = (int(sys.argv[i]) if len(sys.argv) > i else default for i, default in ((1, 500), (2, 0)))
    keep = Path(tempfile.mkdtemp(prefix="fuzz-"))
    with tempfile.TemporaryDirectory() as folder:
        findings = fuzz(make_all(Path(folder)), Path(__file__), count, seed, keep)
    limits = {"timeout_s": TIMEOUT_S, "memory_mib": MEMORY_BYTES >> 20}
    result = {"machine": machine(), "recordings": count, "seed": seed, **limits, **asdict(findings)}
    (DOCS / "fuzz.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=2))
    return int(bool(findings.bad))


if __name__ == "__main__":
    sys.exit(watch(*sys.argv[2:]) if "--watch" in sys.argv[1:] else main())
