"""Actions on files in a process of their own, watched: crashes, hangs, memory and unexpected errors are told.

Run as a program, it is that process: it takes the file with the ACTIONS, then a path per line, and answers each.
"""

import json
import resource
import runpy
import select
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Self

from nlos_cam.errors import NlosCamError

MEMORY_BYTES = 1 << 30
"""Above what the process has when everything is loaded and a whole recording was read."""
TIMEOUT_S = 10.0
START_TIMEOUT_S = 120.0
GOOD = ("done", "refused")
Action = Callable[[Path, Path], None]
Verdict = tuple[str, str]
"""One of done, refused, unexpected, memory, crash, hang; and what was told."""


class Watched:
    """A process that does the actions; started again when it is lost."""

    def __init__(self, actions: Path, warm_up: Path, timeout_s: float = TIMEOUT_S) -> None:
        self._command = [sys.executable, str(Path(__file__).resolve()), str(actions), str(warm_up)]
        self._timeout_s = timeout_s
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def judge(self, path: Path) -> Verdict:
        """Do the actions on a file."""
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
        kind, told = json.loads(answer)
        return kind, told

    def _end(self) -> None:
        if self._process:
            self._process.kill()
            self._process.communicate()
        self._process = None


def verdict_of(actions: dict[str, Action], path: Path) -> Verdict:
    """Do every action; the worst that came of them, or, if all is well, which of them refused the file and why."""
    refused: list[str] = []
    for name, action in actions.items():
        with tempfile.TemporaryDirectory() as folder:
            try:
                action(path, Path(folder))
            except NlosCamError as error:
                refused.append(f"{name}: {error}")
            except MemoryError:
                return "memory", name
            except Exception as error:  # noqa: BLE001  whatever it is, it is a finding
                return "unexpected", f"{name}: {error!r}"
    return ("refused", "\n".join(refused)) if refused else ("done", "")


def limit_memory() -> None:
    """From now on, this process may take MEMORY_BYTES more than it has."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def main(actions_file: str, warm_up: str) -> None:
    """Answer one line of JSON to each line."""
    sys.path.insert(0, str(Path(actions_file).parent))
    actions = runpy.run_path(actions_file)["ACTIONS"]
    for number, line in enumerate(sys.stdin):
        print(json.dumps(verdict_of(actions, Path(line.strip() or warm_up))), flush=True)
        if number == 0:
            limit_memory()


if __name__ == "__main__":
    main(*sys.argv[1:])
