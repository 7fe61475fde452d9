"""Damaged files of every format through everything that reads them: docs/figures/fuzz.json.

`fuzz.py [--count N] [--minutes M] [--only NAME] [--first NUMBER] [--out FILE] [--keep FOLDER]
[--files FOLDER]`. Each case runs in a process forked from one that has loaded the program, and has
30 s of processor time and, with the program, 1 GiB. A case is known by its input and number, which
make the same damage again. A second call resumes, and begins again where the program has changed
since. A bad case is printed; its file stays in --keep. Exits with 1 where a case is bad.
"""

import argparse
import json
import multiprocessing
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numba
import numpy as np
from fuzz_inputs import DONE, Input, WrongResultError, link_or_copy, make_files, make_inputs
from mutations import mutate
from nlos_calibration.errors import CalibrationError
from nlos_models.errors import ModelError
from program_state import program_digest

from nlos_cam.cli.main import build_app
from nlos_cam.errors import NlosCamError
from nlos_cam.evaluate import machine
from nlos_cam.files import CHECKSUMS, FileBusyError, atomic_file, checksums_of
from nlos_cam.processes import safe_children

DOCS = Path(__file__).parents[2] / "docs"
GROUPS = "light", "torch"
MEMORY_BYTES = 1 << 30
TIMEOUT_S = 30.0
WALL_TIMEOUT_S = 600.0
STILL_S = 0.5
"""Memory of a case with the loaded program; its processor time; and the time on the clock of a busy
machine in which it spends less than STILL_S of processor time where it waits for ever."""
OURS = NlosCamError, CalibrationError, ModelError
MAX_KEPT_BYTES = 20_000
LAST_TRIES = 50
"""Tries to write the last findings while the other group's process writes its own."""
GOOD = "done", "refused"
ANSWER_BYTES = 1 << 20
COUNTS = "by_input", "most_mib", "most_cpu_s", "numbers"


class Verdict(NamedTuple):
    """One of done, refused, unexpected, wrong, memory, crash, hang; and details."""

    kind: str
    details: str
    mib: int = 0
    """Largest memory of the process."""
    cpu_s: float = 0.0
    modules: tuple[str, ...] = ()
    """That the case imported."""


def judge(
    action: Callable[[], None], memory_bytes: int = MEMORY_BYTES, timeout_s: float = TIMEOUT_S
) -> Verdict:
    """Run an action in a forked process and return how it ended."""
    read_end, write_end = os.pipe()
    if (pid := os.fork()) == 0:
        os.close(read_end)
        try:
            pages, resident = map(
                int, Path("/proc/self/statm").read_text(encoding="ascii").split()[:2]
            )
            limit = max(
                memory_bytes + (pages - resident) * resource.getpagesize(), memory_bytes // 4
            )
            resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
            seconds = max(int(timeout_s), 1)
            resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
            before = set(sys.modules)
            kind, details = _end_of(action)
            resource.setrlimit(
                resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2
            )  # the answer needs some too
            os.write(
                write_end,
                json.dumps([kind, details, sorted(set(sys.modules) - before)]).encode()[
                    :ANSWER_BYTES
                ],
            )
        finally:
            os._exit(0)
    os.close(write_end)
    if is_late := _stands_still(
        pid, read_end, WALL_TIMEOUT_S if timeout_s >= TIMEOUT_S else timeout_s
    ):
        os.kill(pid, signal.SIGKILL)
    answer = b"".join(iter(partial(os.read, read_end, 1 << 16), b""))
    os.close(read_end)
    _, status, usage = os.wait4(pid, 0)
    mib = usage.ru_maxrss >> 10
    cpu_s = usage.ru_utime + usage.ru_stime
    if is_late or (not answer and cpu_s > 0.9 * timeout_s):
        return Verdict("hang", f"no answer after {cpu_s:.0f} s of processor time", mib, cpu_s)
    if not answer:
        return Verdict("crash", f"exit code {os.waitstatus_to_exitcode(status)}", mib, cpu_s)
    kind, details, modules = json.loads(answer)
    return Verdict(kind, details, mib, cpu_s, tuple(modules))


def _stands_still(pid: int, answer: int, wall_s: float) -> bool:
    """Wait for a process's answer; return True where it spends no processor time for `wall_s` on
    the clock.
    """
    spent_s = -STILL_S
    while not select.select([answer], [], [], wall_s)[0]:
        ticks = (
            Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[11:13]
        )
        if (now_s := sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")) < spent_s + STILL_S:
            return True
        spent_s = now_s
    return False


def _end_of(action: Callable[[], None]) -> tuple[str, str]:
    try:
        action()
    except OURS as error:
        return (
            ("unexpected", f"several lines: {error}")
            if "\n" in str(error)
            else ("refused", str(error)[:300])
        )
    except WrongResultError as error:
        return "wrong", str(error)[:300]
    except MemoryError as error:
        return "memory", repr(error)[:300]
    except BaseException as error:  # noqa: BLE001  any other error is a finding
        return "unexpected", f"{type(error).__name__}: {error}"[:600]
    return "done", ""


@dataclass
class Findings:
    """Counts of all cases so far by input and verdict, their largest memory and time, and the bad
    ones.
    """

    by_input: dict[str, dict[str, int]] = field(default_factory=dict)
    most_mib: dict[str, int] = field(default_factory=dict)
    most_cpu_s: dict[str, float] = field(default_factory=dict)
    bad: list[dict[str, str | int]] = field(default_factory=list)
    numbers: dict[str, list[list[int]]] = field(default_factory=dict)
    """Numbers of the cases of an input, as ranges [first, end)."""

    def has(self, name: str, number: int) -> bool:
        """Return whether a case is among them."""
        return any(first <= number < end for first, end in self.numbers.get(name, []))

    def add(self, name: str, number: int, verdict: Verdict) -> None:
        """Count a case of an input."""
        ranges = self.numbers.setdefault(name, [])
        if ranges and ranges[-1][1] == number:
            ranges[-1][1] = number + 1
        else:
            ranges.append([number, number + 1])
        counts = self.by_input.setdefault(name, {})
        counts[verdict.kind] = counts.get(verdict.kind, 0) + 1
        self.most_mib[name] = max(self.most_mib.get(name, 0), verdict.mib)
        self.most_cpu_s[name] = round(max(self.most_cpu_s.get(name, 0.0), verdict.cpu_s), 1)

    def replaced(self, other: "Findings", names: list[str]) -> "Findings":
        """Return these findings with those of some inputs from another object."""
        mine = vars(self)
        theirs = vars(other)
        merged = {
            key: {**mine[key], **{name: theirs[key][name] for name in names if name in theirs[key]}}
            for key in COUNTS
        }
        rows = [row for row in self.bad if row["input"] not in names]
        return Findings(**merged, bad=[*rows, *(row for row in other.bad if row["input"] in names)])

    def facts(self) -> dict[str, Any]:
        """Return everything for JSON."""
        verdicts = sum(map(Counter, self.by_input.values()), Counter[str]())
        limits = {"timeout_cpu_s": TIMEOUT_S, "memory_mib": MEMORY_BYTES >> 20}
        totals = {
            "cases": verdicts.total(),
            "inputs": len(self.by_input),
            "verdicts": dict(verdicts),
        }
        of = {"machine": machine(), "program": program_digest()}
        return {**of, **limits, **totals, **vars(self)}


def read_findings(path: Path) -> Findings:
    """Return the findings of earlier calls; none without the file, or of another program."""
    found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if found.get("program") != program_digest():
        return Findings()
    return Findings(**{name: found[name] for name in vars(Findings()) if name in found})


def fuzz_one(name: str, each: Input, number: int, keep: Path) -> tuple[Verdict, str]:
    """Damage and judge one input; keep the file of a bad case. Return the verdict and the ways of
    the damage.
    """
    random = np.random.default_rng([number, crc32(name.encode())])
    path, action = each
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder) / "in"
        out = Path(folder) / "out"
        shutil.copytree(path.parent, home, copy_function=link_or_copy)
        out.mkdir()
        try:
            ways, content = mutate(path, path.read_bytes(), random)
        except (
            ValueError,
            OSError,
            TypeError,
            KeyError,
        ) as error:  # the library refuses to write such a file
            ways = f"none ({error!r:.50})"
            content = path.read_bytes()
        target = home / path.name
        target.unlink()  # its links elsewhere stay whole
        target.write_bytes(content)
        if (sums := checksums_of(home)) and random.random() < 0.5:
            (home / CHECKSUMS).unlink()
            sums[path.name] = sha256(content).hexdigest()
            (home / CHECKSUMS).write_text(
                "".join(f"{digest}  {key}\n" for key, digest in sums.items())
            )
            ways += "+checksum"
        verdict = judge(partial(action, target, out, random))
        if verdict.kind not in GOOD:
            print(f"{verdict.kind}: {name} {number} ({ways}): {verdict.details}", flush=True)
            if len(content) <= MAX_KEPT_BYTES:
                shutil.copy(target, keep / f"{number}-{name}")
    for module in verdict.modules:  # the next process need not import what this one did
        with suppress(Exception):
            import_module(module)
    return verdict, ways


def fuzz(group: str, home: Path, chosen: argparse.Namespace) -> None:
    """Judge the cases of a group's inputs, in turn, and write the findings now and then."""
    findings = read_findings(chosen.out)
    until_s = time.monotonic() + 60 * chosen.minutes
    written_s = 0.0
    os.environ["NLOS_CAM_CACHE"] = str(home / "cache")
    numba.config.THREADING_LAYER = (
        "workqueue"  # GNU OpenMP ends a forked process whose parent has used it
    )
    build_app()
    if group == "torch":
        import_module("torch").set_num_threads(
            1
        )  # a forked process has none of its parent's threads
    inputs = {name: each for name, each in make_inputs(home, group).items() if chosen.only in name}

    def write() -> None:
        # the other group writes there too
        with atomic_file(chosen.out) as part:
            both = read_findings(chosen.out).replaced(findings, [*inputs])
            part.write_text(json.dumps(both.facts(), indent=1) + "\n", encoding="utf-8")

    for number in range(chosen.first, chosen.first + chosen.count):
        for name, each in inputs.items():
            if findings.has(name, number) or time.monotonic() > until_s:
                continue
            verdict, ways = fuzz_one(name, each, number, chosen.keep)
            findings.add(name, number, verdict)
            if verdict.kind not in GOOD:
                row = {
                    "input": name,
                    "number": number,
                    "ways": ways,
                    "verdict": verdict.kind,
                    "why": verdict.details,
                }
                findings.bad.append(row)
            if time.monotonic() > written_s + 30 or verdict.kind not in GOOD:
                with suppress(FileBusyError):  # the next one holds these too
                    write()
                written_s = time.monotonic()
    for _ in range(LAST_TRIES):
        with suppress(FileBusyError):
            write()
            return
        time.sleep(0.1)
    write()


def main() -> int:
    """Make the files, then judge each group's inputs in a process of its own; return 1 after a bad
    case.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=400, help="cases of each input")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--minutes", type=float, default=1e6, help="limit of each group's time")
    parser.add_argument("--only", default="", help="only inputs with this in their name")
    parser.add_argument("--group", choices=GROUPS, help="only inputs of this group")
    parser.add_argument("--out", type=Path, default=DOCS / "figures" / "fuzz.json")
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument(
        "--files", type=Path, help="folder of the whole files, kept for the next call"
    )
    chosen = parser.parse_args()
    for needed in (chosen.keep, chosen.files):
        if needed:
            needed.mkdir(parents=True, exist_ok=True)
    spawn = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        chosen.files = chosen.files or Path(folder)
        # Files of an earlier program are all refused, and nothing is fuzzed.
        mark = chosen.files / DONE
        fresh = mark.exists() and mark.read_text(encoding="utf-8") == program_digest()
        if mark.exists() and not fresh:
            raise SystemExit(f"{chosen.files} holds an earlier program's files: delete it")
        made = [] if fresh else [partial(make_files, chosen.files)]
        groups = [
            partial(fuzz, group, chosen.files, chosen)
            for group in GROUPS
            if chosen.group in {None, group}
        ]
        for steps in (made, groups):
            processes = [spawn.Process(target=step) for step in steps]
            with safe_children():
                for process in processes:
                    process.start()
            for process in processes:
                process.join()
            if any(process.exitcode for process in processes):
                raise SystemExit("a process of the fuzz itself failed")
    found = read_findings(chosen.out)
    if not any(chosen.only in name for name in found.by_input):
        raise SystemExit(f"no case was judged: no input has {chosen.only!r} in its name")
    return int(bool(found.bad))


if __name__ == "__main__":
    sys.exit(main())
