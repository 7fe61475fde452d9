"""Commands under attack: their table, processes that begin with the program loaded, and counts that
grow by trials.
"""

import argparse
import json
import multiprocessing
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from base64 import b64decode
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
from noise_recordings import record
from program_state import program_digest

from nlos_cam.cli.main import build_app, main
from nlos_cam.dataset import REQUIRED_ARRAYS, SHARD_PATTERN, build, open_dataset
from nlos_cam.evaluate import machine
from nlos_cam.recording import load_sidecar, verify
from nlos_cam.view import SESSION_MARK, element, unpack

T = TypeVar("T")
DOCS = Path(__file__).parents[2] / "docs"
FORK = multiprocessing.get_context("fork")
TIMEOUT_S = 1800.0
DONE = "done"
"""File that marks a complete folder of inputs."""
SHARD = 3
"""Objects in a shard of the datasets under attack."""
RECIPE = """task = "direct"
objects = 12
held_out = 4
epochs = 6
batch = 4
learning_rate = 1e-3
direct = {features = 4, width = 8, blocks = 1, token = 4, mixers = 1}
"""
SCENE = (
    'name = "a"\nrig = "paper-rig"\n[object]\ncategory = "cup"\nsize_m = 0.1\n[motion]\nposes ='
    " 1\nturn_deg = 9\n"
)
BUILD = "dataset build --count 12 --workers 2 --accuracy draft --out"
CACHE = "capture sim:{inputs}/scene.toml --frames 2 --out {folder}"
SAVE = "live sim:bare-wall --no-view --seconds 2 --save-view"
TRAIN = (
    "train direct --recipe {inputs}/small.toml --dataset {inputs}/data"
    " --held-out {inputs}/held-out --out"
)

Row = dict[str, Any]


@dataclass(frozen=True)
class Command:
    """Command line, its output, and the check of that.

    {folder} stands for an empty folder and {inputs} for one with recording, recipe, scene, dataset
    and trained weights.
    """

    arguments: str
    output: str
    is_whole: Callable[[Path, Path], object]
    """Called with the output and the folder of inputs; raises any error where the output is not
    whole.
    """
    again: str = "--overwrite"
    """Option of the run after the kill."""
    keeps: str = ""
    """Pattern of finished parts of the output, which the run after the kill must not make again."""
    is_atomic: bool = True
    """The output has its name only when it is whole."""
    other: str = ""
    """Command line of the second process of a pair, where it is another."""
    both_may_win: bool = False
    endless: bool = False
    """The winner of a pair is ended by SIGTERM once the other has ended."""


def _file(path: Path, _: Path) -> object:
    return path.read_bytes()[0]


def _folder(*names: str) -> Callable[[Path, Path], object]:
    return lambda path, _: [(path / name).read_bytes()[0] for name in names]


def _capture(path: Path, _: Path) -> object:
    return verify(path), load_sidecar(path.with_suffix(".json"))


def _session(path: Path, _: Path) -> object:
    return check_session(path.read_bytes())


def check_session(content: bytes) -> int:
    """Return the number of whole messages in a saved session. Raises ValueError where it does not
    play.
    """
    begin = element(b"").split(b"</")[0]
    end = b"</" + element(b"").split(b"</")[1]
    messages = [
        unpack(b64decode(each.split(b"<")[0])) for each in content.split(begin)[1:] if end in each
    ]
    if SESSION_MARK not in content[:1000] or not messages:
        raise ValueError("no saved session")
    return len(messages)


def differing(one: Path, other: Path) -> list[str]:
    """Return the arrays of two datasets that differ in any bit."""
    left = open_dataset(one)
    right = open_dataset(other)
    return [name for name in REQUIRED_ARRAYS if not _same(left.column(name), right.column(name))]


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    if one.dtype == object:
        return one.tolist() == other.tolist()
    return (
        one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    )


def _dataset(path: Path, inputs: Path) -> None:
    if wrong := differing(path, inputs / "data"):
        raise ValueError(f"{wrong} differ from those of an undisturbed build")


def _run(path: Path, inputs: Path) -> None:
    if _tensors(path) != _tensors(inputs / "run"):
        raise ValueError("weights differ from those of an undisturbed run")


def _tensors(folder: Path) -> set[str]:
    lines = (folder / "SHA256SUMS").read_text(encoding="ascii").splitlines()
    return {line for line in lines if line.endswith(".safetensors")}


def _cached(path: Path, inputs: Path) -> None:
    for name in ("a.bag", "b.bag"):
        _capture(path / name, inputs)
    if (count := len([*(path / "cache" / "worlds").iterdir()])) != 1:
        raise ValueError(f"{count} entries in the cache")


RESUMED: dict[str, Any] = {"again": "", "is_atomic": False, "both_may_win": True}
COMMANDS = {
    "capture": Command(
        "capture sim:bare-wall --frames 8 --out {folder}/a.bag", "a.bag", _capture, is_atomic=False
    ),
    "export": Command(
        "export {inputs}/noise.bag --out {folder}/out", "out", _folder("export.json", "depth.csv")
    ),
    "repair": Command(
        "repair {inputs}/noise.bag --out {folder}/a.bag", "a.bag", lambda path, _: verify(path)
    ),
    "replay": Command("replay {inputs}/noise.bag --out {folder}/out", "out", _folder("report.md")),
    "save session": Command(f"{SAVE} {{folder}}/a.html", "a.html", _session, is_atomic=False),
    "render": Command("render cup --accuracy draft --out {folder}/a.npz", "a.npz", _file),
    "dataset build": Command(
        f"{BUILD} {{folder}}/data", "data", _dataset, keeps=SHARD_PATTERN, **RESUMED
    ),
    "train": Command(f"{TRAIN} {{folder}}/run", "run", _run, **RESUMED),
    "cache": Command(f"{CACHE}/a.bag", ".", _cached, other=f"{CACHE}/b.bag", both_may_win=True),
    "port": Command(
        "live sim:bare-wall --view-port 18765",
        ".",
        lambda path, _: path.stat(),
        again="",
        endless=True,
    ),
}


class Forked:
    """Command in a process forked from one that has loaded the program: a random moment falls into
    its work.

    Its current folder and cache lie in `folder`. The methods are those of `subprocess.Popen`.
    """

    def __init__(self, arguments: list[str], folder: Path, said: Path) -> None:
        self._process = FORK.Process(target=_main, args=(arguments, folder, said))
        self._said = said
        self._process.start()
        self.pid = self._process.pid or 0
        self.kill = self._process.kill
        self.terminate = self._process.terminate

    @property
    def said(self) -> str:
        """Everything that the command has printed so far."""
        return (
            self._said.read_text(encoding="utf-8", errors="replace") if self._said.exists() else ""
        )

    def poll(self) -> int | None:
        """Return the exit code; None while the command runs."""
        return self._process.exitcode

    def wait(self, timeout_s: float = TIMEOUT_S) -> int:
        """Return the exit code. Raises TimeoutExpired."""
        self._process.join(timeout_s)
        if (code := self.poll()) is None:
            raise subprocess.TimeoutExpired(self._said.stem, timeout_s)
        return code


def _main(arguments: list[str], folder: Path, said: Path) -> None:
    with said.open("w", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.chdir(folder)
    os.environ["NLOS_CAM_CACHE"] = str(folder / "cache")
    sys.modules["__main__"] = ModuleType("__main__")  # workers start without this tool
    raise SystemExit(main(arguments))


def in_fork(act: Callable[[], T]) -> T:
    """Return the result of a function in a forked process: the threads of libraries that it starts
    end there.
    """
    receive, send = FORK.Pipe(duplex=False)
    process = FORK.Process(target=lambda: send.send(act()))
    process.start()
    send.close()
    try:
        return receive.recv()
    finally:
        process.join()


def load_program() -> None:
    """Import the libraries that commands import when they run."""
    build.SHARD = SHARD
    build_app()
    for name in (
        "torch",
        "onnxruntime",
        "pyrealsense2",
        "h5py",
        "matplotlib.figure",
        "nlos_models.training.loop",
    ):
        import_module(name)


def line_of(arguments: str, folder: Path, inputs: Path, *options: str) -> list[str]:
    """Return a command's arguments."""
    return [*arguments.format(folder=folder, inputs=inputs).split(), *options]


@contextmanager
def started(
    command: Command, folder: Path, inputs: Path, *options: str, name: str = "first"
) -> Generator[Forked]:
    """Start a command; kill it at the end of the block if it still runs."""
    line = line_of(
        command.other if name == "second" and command.other else command.arguments,
        folder,
        inputs,
        *options,
    )
    process = Forked(line, folder, folder.with_name(f"{folder.name}.{name}"))
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextmanager
def empty_folder() -> Generator[Path]:
    """Yield an empty folder, beside which a trial's processes write what they say."""
    with tempfile.TemporaryDirectory() as name:
        (folder := Path(name) / "trial").mkdir()
        yield folder


def finish(command: Command, folder: Path, inputs: Path, *options: str) -> Forked:
    """Run a command to its end."""
    with started(command, folder, inputs, *options, name="next") as process:
        process.wait()
    return process


@cache
def duration_s(command: Command, inputs: Path) -> float:
    """Return how long the command takes here. Raises RuntimeError where it fails undisturbed."""
    with empty_folder() as folder:
        start_s = time.monotonic()
        if (ended := finish(command, folder, inputs)).poll():
            raise RuntimeError(ended.said)
        return time.monotonic() - start_s


def problem_of(command: Command, folder: Path, inputs: Path) -> str:
    """Return why an output is not whole; empty if it is."""

    def problem() -> str:
        try:
            command.is_whole(folder / command.output, inputs)
        except Exception as error:  # noqa: BLE001  any error of reading it is the finding
            return f"{command.output} is not whole: {error}".replace(str(folder), "")[:300]
        return ""

    return in_fork(problem)


def finished_parts(command: Command, folder: Path) -> dict[str, int]:
    """Return the time of the last change of each finished part of an output, in ns."""
    output = folder / command.output
    return (
        {path.name: path.stat().st_mtime_ns for path in output.glob(command.keeps)}
        if command.keeps
        else {}
    )


def leftovers(folder: Path) -> list[str]:
    """Return the entries that no finished command leaves."""
    return [
        str(path.relative_to(folder)) for path in folder.rglob("*") if path.name.endswith(".part")
    ]


@contextmanager
def inputs_of(chosen: argparse.Namespace) -> Generator[Path]:
    """Yield a folder with the inputs of all commands: the one that was chosen, filled if it is
    empty, or a new one.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(chosen.inputs or name).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        done = folder / DONE
        if not done.exists() or done.read_text(encoding="ascii") != program_digest():
            make_inputs(folder)
        yield folder


def make_inputs(folder: Path) -> None:
    """Write the inputs of all commands into a folder; those of another program go."""
    for name in ("data", "held-out", "run"):
        shutil.rmtree(folder / name, ignore_errors=True)
    in_fork(lambda: bool(record(folder / "noise.bag", packed=True, frames=8)))
    (folder / "small.toml").write_text(RECIPE, encoding="utf-8")
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    held_out = f"{BUILD} {folder}/held-out --seed 1000"
    for arguments in (f"{BUILD} {folder}/data", held_out, f"{TRAIN} {folder}/run"):
        with empty_folder() as empty:
            if (ended := finish(Command(arguments, "", _folder()), empty, folder)).poll():
                raise RuntimeError(ended.said)
    (folder / DONE).write_text(program_digest(), encoding="ascii")


def options(about: str | None, file: str, **counts: int) -> argparse.ArgumentParser:
    """Return the parser of a tool that repeats trials: its counts, and the options of all such
    tools.
    """
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, count in counts.items():
        parser.add_argument(f"--{name}", type=int, default=count)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="only commands with this in their name")
    parser.add_argument("--out", type=Path, default=DOCS / "figures" / file)
    parser.add_argument(
        "--inputs", type=Path, help="folder of the commands' inputs, kept for the next call"
    )
    return parser


class Results:
    """Rows of trials in a JSON file, which is written after each; a second call of a tool resumes
    there, and begins again where the program has changed since, or the seed is another one.
    """

    def __init__(self, path: Path, seed: int) -> None:
        self._path = path
        self._seed = seed
        earlier = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        begun = {"program": program_digest(), "seed": seed}
        if all(earlier.get(key) == value for key, value in begun.items()):
            self.facts: dict[str, Any] = earlier
        else:  # a machine's description starts numba's threads
            self.facts = {"machine": in_fork(machine), **begun}

    def repeat(
        self, name: str, kind: str, count: int, trial: Callable[[random.Random], Row]
    ) -> None:
        """Append the rows of trials until there are `count`; each has random numbers of its own."""
        rows = self.facts.setdefault(name, {}).setdefault(kind, [])
        while len(rows) < count:
            try:
                row = trial(random.Random(f"{self._seed} {name} {kind} {len(rows)}"))  # noqa: S311
            except (
                OSError,
                RuntimeError,
                subprocess.SubprocessError,
            ) as error:  # a process ended, or never does
                row = {"wrong": f"{error!r:.300}"}
            rows.append({key: value for key, value in row.items() if value != ""})
            print(name, kind, len(rows), rows[-1], flush=True)
            self._path.write_text(
                json.dumps(self.facts, separators=(",", ":")) + "\n", encoding="utf-8"
            )

    @property
    def findings(self) -> list[Row]:
        """Rows with something wrong."""
        tables = [kinds for kinds in self.facts.values() if isinstance(kinds, dict)]
        return [
            row for kinds in tables for rows in kinds.values() for row in rows if "wrong" in row
        ]
