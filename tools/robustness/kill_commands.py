"""Commands killed at random moments, and pairs of them started at once on one output:
docs/figures/kill_commands.json.

`kill_commands.py [--kills N] [--races N] [--seed S] [--only NAME] [--out FILE]`. After each kill
the same command runs again: it has to end well and keep finished parts, nothing half-written may be
accepted, and nothing may be left over, no process either. Of two commands on one output one has to
win, and the other to name the reason in a line. A second call resumes. Exits with 1 after a
finding.
"""

import json
import re
import signal
import sys
import time
from functools import partial
from http.client import HTTPConnection
from pathlib import Path
from random import Random

import trials
from live_process import children_of, session_of
from trials import Command, Forked, Row

from nlos_cam.cli.common import INTERRUPTED

REASONS = "being written", "exists", "in use"
"""Words of the line in which the second of two commands says why it does not run."""
NOT_KILLED = {"cache", "port"}
NOT_RACED = {"save session"}
"""Commands of the other kind alone."""
GRACE_S = 120.0
EARLIER = 0.7
"""Time for a killed command's processes to end, here; factor of a moment that came after the
command's end.
"""
PAGE = Command("live sim:bare-wall", "", lambda path, _: path.stat())
ADDRESS = re.compile(r"http://127\.0\.0\.1:(\d+)/#([\w-]+)")
SAVING_S = 2.0


def kill_once(command: Command, inputs: Path, random: Random) -> Row:
    """Kill a command at a random moment, run it again, and return the finding."""
    after_s = random.uniform(0, trials.duration_s(command, inputs))
    was_killed = False
    while not was_killed:
        with trials.empty_folder() as folder:
            with trials.started(command, folder, inputs) as process:
                time.sleep(after_s)
                children = children_of(process.pid) if process.poll() is None else []
            was_killed = process.wait() == -signal.SIGKILL
            output = folder / command.output
            if not was_killed:
                after_s *= EARLIER
                continue
            wrong = survivors(children)
            parts = len(trials.leftovers(folder))
            done = trials.finished_parts(command, folder)
            if output.exists() and command.is_atomic:
                wrong = wrong or trials.problem_of(command, folder, inputs)
            options = [command.again] if output.exists() and command.again else []
            again = trials.finish(command, folder, inputs, *options)
            if again.poll():
                wrong = wrong or f"the next run ends with {again.poll()}: {again.said[-300:]}"
            if lost := done.items() - trials.finished_parts(command, folder).items():
                wrong = wrong or f"the next run made again: {', '.join(sorted(dict(lost)))}"
            wrong = (
                wrong
                or trials.problem_of(command, folder, inputs)
                or ", ".join(trials.leftovers(folder))
            )
    return {"after_s": round(after_s, 3), "parts_left": parts, "wrong": wrong}


def survivors(children: list[int]) -> str:
    """Return which processes of a killed command run on; empty if they end."""
    deadline_s = time.monotonic() + GRACE_S
    while (
        left := [each for each in children if session_of(each) is not None]
    ) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    return f"{len(left)} of its processes run on" if left else ""


def race_once(command: Command, inputs: Path, random: Random) -> Row:
    """Start two commands on one output, and return the exit codes and the finding."""
    apart_s = random.uniform(
        0, 0.3 if command.endless else 0.6 * trials.duration_s(command, inputs)
    )
    with trials.empty_folder() as folder, trials.started(command, folder, inputs) as first:
        time.sleep(apart_s)
        with trials.started(command, folder, inputs, name="second") as second:
            if command.endless:
                end_winner([first, second])
            codes = sorted(process.wait() for process in (first, second))
            wrong = trials.problem_of(command, folder, inputs) or ", ".join(
                trials.leftovers(folder)
            )
            wanted = [1, INTERRUPTED] if command.endless else [0, 1]
            if codes != wanted and not (command.both_may_win and codes == [0, 0]):
                wrong = wrong or f"exit codes {codes}: {first.said[-300:]} {second.said[-300:]}"
            for loser in (process for process in (first, second) if process.poll() == 1):
                if "Traceback" in loser.said or not any(reason in loser.said for reason in REASONS):
                    wrong = wrong or f"no line that says so: {loser.said[-300:]}"
    return {"apart_s": round(apart_s, 3), "codes": codes, "wrong": wrong}


def end_winner(processes: list[Forked]) -> None:
    """Wait until one process has ended and the other serves its view, and end that."""
    deadline_s = time.monotonic() + trials.TIMEOUT_S
    while time.monotonic() < deadline_s and all(process.poll() is None for process in processes):
        time.sleep(0.02)
    for process in processes:
        if process.poll() is None:
            address_of(process)
            process.terminate()


def address_of(process: Forked) -> tuple[int, str]:
    """Return port and token of a live view, once it prints them. Raises TimeoutError."""
    deadline_s = time.monotonic() + trials.TIMEOUT_S
    while time.monotonic() < deadline_s and process.poll() is None:
        if found := ADDRESS.search(process.said):
            return int(found[1]), found[2]
        time.sleep(0.02)
    raise TimeoutError(f"no view: {process.said[-300:]}")


def ask(process: Forked, command: str) -> str:
    """Send a command as the page does, until it is accepted; return the answer."""
    port, token = address_of(process)
    deadline_s = time.monotonic() + trials.TIMEOUT_S
    while time.monotonic() < deadline_s:
        connection = HTTPConnection("127.0.0.1", port, timeout=60.0)
        connection.request("POST", "/command", json.dumps({"command": command}), {"X-Token": token})
        answer = connection.getresponse()
        said = answer.read().decode()
        connection.close()
        if answer.status == 200:
            return said
        time.sleep(0.1)
    raise TimeoutError(f"{command}: {said}")


def kill_page(inputs: Path, random: Random) -> Row:
    """Kill a live run while its page saves a session; the file has to play, and the next run to
    save a whole one.
    """
    after_s = random.uniform(0, SAVING_S)
    wrong = ""
    with trials.empty_folder() as folder:
        with trials.started(PAGE, folder, inputs) as process:
            ask(process, "save_session")
            time.sleep(after_s)
            children = children_of(process.pid)
        wrong = survivors(children)
        content = next(folder.glob("session-*.html")).read_bytes()
        with trials.started(PAGE, folder, inputs, name="next") as process:
            ask(process, "save_session")
            ask(process, "end_session")
            process.terminate()
            if (code := process.wait()) != INTERRUPTED:
                wrong = wrong or f"the next run ends with {code}: {process.said[-300:]}"
        whole = max(folder.glob("session-*.html")).read_bytes()
        unplayable = trials.in_fork(
            lambda: _unplayable(content, "of the killed run") or _unplayable(whole, "after it")
        )
        wrong = wrong or unplayable or ", ".join(trials.leftovers(folder))
    return {"after_s": round(after_s, 3), "bytes": len(content), "wrong": wrong}


def _unplayable(content: bytes, which: str) -> str:
    """Return why a session does not play; an empty one, of a run killed as it opened the file, is
    none at all.
    """
    try:
        if content:
            trials.check_session(content)
    except Exception as error:  # noqa: BLE001  any error is the finding
        return f"the session {which}: {error!r}"
    return ""


def main() -> int:
    """Kill, race, write after each trial; return 1 after a finding."""
    chosen = trials.options(__doc__, "kill_commands.json", kills=30, races=50).parse_args()
    trials.load_program()
    results = trials.Results(chosen.out, chosen.seed)
    with trials.inputs_of(chosen) as inputs:
        for name, command in trials.COMMANDS.items():
            if chosen.only in name and name not in NOT_KILLED:
                results.repeat(name, "kills", chosen.kills, partial(kill_once, command, inputs))
            if chosen.only in name and name not in NOT_RACED:
                results.repeat(name, "races", chosen.races, partial(race_once, command, inputs))
        if chosen.only in "page session":
            results.repeat("page session", "kills", chosen.kills, partial(kill_page, inputs))
    return int(bool(results.findings))


if __name__ == "__main__":
    sys.exit(main())
