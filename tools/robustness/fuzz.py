"""Damaged files of every format through everything that reads them: docs/fuzz.json.

`fuzz.py [--count N] [--seed S] [--minutes M] [--only NAME] [--out FILE] [--keep FOLDER]`. Each case runs in a forked
process with a limit of memory and of time. A second call resumes after the last seed of the file. A bad case is printed
with its seed, which makes the same damage again; its file stays in --keep. Exits with 1 where a case is bad.
"""

import argparse
import hashlib
import io
import json
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
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numba
import numpy as np
import torch
from mutations import mutate
from nlos_calibration import load_rig, load_wall, reference
from nlos_calibration.errors import CalibrationError
from nlos_models import load_cached, load_recipe, load_reconstructor, load_uncertainty_model, shipped_folder, train
from nlos_models.errors import ModelError
from noise_recordings import record
from rosbags.rosbag1 import Reader

from nlos_cam.camera import open_camera, simulated_world
from nlos_cam.cli.main import build_app, main
from nlos_cam.dataset import open_dataset, shards
from nlos_cam.errors import NlosCamError
from nlos_cam.evaluate import machine
from nlos_cam.files import atomic_file
from nlos_cam.recording import load_sidecar
from nlos_cam.render import load_scene

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
MEMORY_BYTES, TIMEOUT_S = 1 << 30, 30.0
"""Memory of a case beyond that of the loaded program, and its time."""
OURS = NlosCamError, CalibrationError, ModelError
EXIT_CODES = {0, 1, 2, 3, 4}
MAX_LINES, MAX_KEPT_BYTES = 12, 20_000
RARE = 0.15
"""Share of the recordings that also go through the slow commands."""
GOOD = "done", "refused"

SCENE = b"""name = "a"
rig = "paper-rig"
[object]
category = "cup"
size_m = 0.1
[motion]
poses = 2
turn_deg = 9
"""

Action = Callable[[Path, Path, np.random.Generator], None]
"""Reads a damaged file, may write into an empty folder; raises an error of the project's trees, or nothing."""


class Input(NamedTuple):
    """Whole file to be damaged, in a folder with what belongs to it, and what reads it."""

    path: Path
    action: Action


class Verdict(NamedTuple):
    """One of done, refused, unexpected, wrong, memory, crash, hang; and details."""

    kind: str
    details: str
    mib: int = 0


class WrongResultError(AssertionError):
    """A damaged file was accepted as whole."""


def command(*arguments: str | Path) -> dict[str, Any] | None:
    """Run a command; return its JSON object, or None where it refused in a line. Raises AssertionError otherwise."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main([*map(str, arguments), "--json"])
    lines = err.getvalue().splitlines()
    if code not in EXIT_CODES or len(lines) > MAX_LINES or "Traceback" in err.getvalue():
        raise AssertionError(f"{arguments[0]} ends with {code} and {len(lines)} lines: {err.getvalue()[-300:]}")
    result = json.loads(out.getvalue().splitlines()[-1], parse_constant=_refuse_constant)
    return result if code == 0 else None


def _refuse_constant(name: str) -> None:
    raise AssertionError(f"{name} in JSON")


def read_recording(path: Path, folder: Path, random: np.random.Generator) -> None:
    """Export, repair and describe a recording, now and then replay it, measure the wall, and check the results."""
    exported, refused = command("export", path, "--out", folder / "export", "--ply"), 0
    if exported:
        json.loads((folder / "export" / "export.json").read_text(encoding="utf-8"), parse_constant=_refuse_constant)
        for stream, count in exported["frames"].items():
            if len(list((folder / "export" / stream).iterdir())) != count:
                raise WrongResultError(f"reported {count} {stream}, and wrote others")
    refused += exported is None
    if repaired := command("repair", path, "--out", folder / "repaired.bag"):
        with Reader(folder / "repaired.bag") as reader:
            images = [each for each in reader.connections if each.topic.endswith("/image/data")]
            found = [(each.topic, time_ns) for each, time_ns, _ in reader.messages(images)]
        if sum(repaired["recovered_frames"].values()) != len(found):
            raise WrongResultError(f"repair claims {repaired['recovered_frames']}, {len(found)} can be read")
    refused += repaired is None
    refused += command("info", path) is None
    if random.random() < RARE:
        command("calibrate", "--bag", path, "--out", folder / "wall.toml")
        refused += command("replay", path, "--out", folder / "replayed") is None
    with open_camera(f"bag:{path}") as camera:
        for frame in camera:
            if any(image.shape != frame.depth_m.shape for image in (frame.ir, frame.confidence)):
                raise WrongResultError(f"frame {frame.frame_number} is not whole")
    if refused:
        raise NlosCamError(f"refused by {refused} commands")


def read_shard(path: Path, folder: Path, random: np.random.Generator, whole: dict[str, Any]) -> None:
    """Read a dataset of one shard; any array that comes out has to be the original's."""
    del folder, random
    command("info", path.parent)
    for head in shards.shards_of(path.parent):
        shards.check_arrays(head)
    found = open_dataset(path.parent)
    for name in ("depth_m", "intensity", "image", "seed"):
        if not np.array_equal(found.column(name), whole[name], equal_nan=whole[name].dtype.kind == "f"):
            raise WrongResultError(f"{name} differs and was accepted")


def read_weights(path: Path, folder: Path, random: np.random.Generator, content: bytes) -> None:
    """Load networks from a folder of weights."""
    del random
    load_reconstructor(path.parent, folder)
    load_uncertainty_model(path.parent, folder)
    if path.read_bytes() != content:
        raise WrongResultError("changed weights were accepted")


def read_cache(path: Path, folder: Path, random: np.random.Generator, content: bytes) -> None:
    """Read a cached world whose file may be damaged: it has to be as made, and whole the next time."""
    del folder, random
    entry, made = path.with_name("0123456789ab.npz"), list[int]()

    def make() -> bytes:
        made.append(1)
        return content

    wanted = simulated_world._unpack(content)  # noqa: SLF001  what the cache's reader makes of it
    for _ in range(2):
        echoes, truths = load_cached(entry, simulated_world._unpack, make)  # noqa: SLF001
        same = [np.array_equal(one.peak, two.peak) for one, two in zip(echoes, wanted[0], strict=True)]
        if not all(same) or len(truths) != len(wanted[1]) or len(made) > 1:
            raise WrongResultError("another world came out of the cache, or the damage stayed")


def read_text(path: Path, folder: Path, random: np.random.Generator, load: Callable[[Path], Any]) -> None:
    """Load a TOML or JSON file and describe it."""
    del folder, random
    command("info", path)
    load(path)


def read_npz(path: Path, folder: Path, random: np.random.Generator) -> None:
    """Load a bare-wall reference, with the checksum that its record would have now."""
    del folder, random
    reference.load_reference(path, hashlib.sha256(path.read_bytes()).hexdigest())


def read_state(path: Path, folder: Path, random: np.random.Generator) -> None:
    """Read the last state of a training run."""
    del folder, random
    train.read_last(path.parent, lambda _: None)


def make_inputs(folder: Path) -> dict[str, Input]:
    """Make one whole file of each kind, each in a folder of its own."""
    os.environ["NLOS_CAM_CACHE"] = str(folder / "cache")
    numba.config.THREADING_LAYER = "workqueue"  # GNU OpenMP ends a forked process whose parent has used it
    inputs = dict[str, Input]()

    def place(name: str, source: Path | bytes, action: Action, beside: str = "*") -> None:
        home = folder / name.replace(".", "-")
        home.mkdir()
        if isinstance(source, bytes):
            (home / name).write_bytes(source)
        else:
            for path in source.parent.glob(beside):
                os.link(path, home / path.name) if path.is_file() else None
        path = home / (name if isinstance(source, bytes) else source.name)
        inputs[name] = Input(path, action)

    for name in ("packed", "plain"):
        bag = record(folder / f"{name}.bag", packed=name == "packed", frames=4)
        place(f"{name}.bag", bag.read_bytes(), read_recording)
    command("dataset", "build", "--count", "3", "--accuracy", "draft", "--workers", "1", "--out", folder / "data")
    shard = next((folder / "data").glob("*.h5"))
    with h5py.File(shard) as file:
        whole = {name: file[name][:] for name in ("depth_m", "intensity", "image", "seed")}
    place("shard.h5", shard, partial(read_shard, whole=whole), "*.h5")
    for name in ("preprocess", "doubt", "compressor"):
        weights = shipped_folder() / f"{name}.safetensors"
        place(weights.name, weights, partial(read_weights, content=weights.read_bytes()))
    command("calibrate", "--wall", "sim:bare-wall", "--frames", "8", "--out", folder / "wall.toml")
    place("wall.npz", (folder / "wall.npz").read_bytes(), read_npz)
    place("wall.toml", (folder / "wall.toml").read_bytes(), partial(read_text, load=load_wall))
    place("rig.toml", (next(ROOT.rglob("rigs/paper-rig.toml"))).read_bytes(), partial(read_text, load=load_rig))
    place(
        "recipe.toml",
        next((ROOT / "models/recipes").glob("*vae*.toml")).read_bytes(),
        partial(read_text, load=load_recipe),
    )
    scene = (
        'name = "a"\nrig = "paper-rig"\n[object]\ncategory = "cup"\nsize_m = 0.1\n[motion]\nposes = 2\nturn_deg = 9\n'
    )
    place("scene.toml", scene.encode(), partial(read_text, load=load_scene))
    command("capture", "sim:bare-wall", "--frames", "3", "--out", folder / "short.bag")
    place("sidecar.json", (folder / "short.json").read_bytes(), partial(read_text, load=load_sidecar))
    state, content = (
        {"recipe": "{}", "module": {"x": torch.zeros(3)}, "epoch": 1, "rows": [{"loss": 1.0}]},
        io.BytesIO(),
    )
    torch.save(state, content)
    place(train.LAST, hashlib.sha256(content.getvalue()).digest() + content.getvalue(), read_state)
    scene = simulated_world.bare_wall_scene()
    world = simulated_world.pack_loop(*(simulated_world.read_packaged(scene) or simulated_world.render_loop(scene)))
    load_cached(folder / "worlds" / "0123456789ab.npz", bytes, lambda: world)
    place("world.npz", next((folder / "worlds").iterdir()), partial(read_cache, content=world), "*.npz")
    return inputs


def judge(action: Callable[[], None], memory_bytes: int = MEMORY_BYTES, timeout_s: float = TIMEOUT_S) -> Verdict:
    """Run an action in a forked process and return how it ended."""
    read_end, write_end = os.pipe()
    if (pid := os.fork()) == 0:
        os.close(read_end)
        try:
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            limit = pages * resource.getpagesize() + memory_bytes
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
            os.write(write_end, json.dumps(_end_of(action)).encode())
        finally:
            os._exit(0)
    os.close(write_end)
    try:
        if not select.select([read_end], [], [], timeout_s)[0]:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return Verdict("hang", f"no answer in {timeout_s:.0f} s")
        answer = os.read(read_end, 1 << 16)
    finally:
        os.close(read_end)
    _, status, usage = os.wait4(pid, 0)
    mib = usage.ru_maxrss >> 10
    if not answer:
        return Verdict("crash", f"exit code {os.waitstatus_to_exitcode(status)}", mib)
    return Verdict(*json.loads(answer), mib)


def _end_of(action: Callable[[], None]) -> tuple[str, str]:
    try:
        action()
    except OURS as error:
        return ("unexpected", f"several lines: {error}") if "\n" in str(error) else ("refused", str(error)[:300])
    except WrongResultError as error:
        return "wrong", str(error)[:300]
    except MemoryError as error:
        return "memory", repr(error)[:300]
    except BaseException as error:  # noqa: BLE001  any other error is a finding
        return "unexpected", f"{type(error).__name__}: {error}"[:600]
    return "done", ""


@dataclass
class Findings:
    """Counts of all cases so far by verdict, and by input; the bad ones with their seeds."""

    cases: int
    verdicts: Counter[str]
    by_input: dict[str, Counter[str]]
    most_mib: int
    bad: list[dict[str, str | int]]


def fuzz(inputs: dict[str, Input], findings: Findings, seeds: range, keep: Path, until_s: float) -> None:
    """Damage and judge one input per seed until a time; bad cases stay in a folder."""
    for seed in seeds:
        if time.monotonic() > until_s:
            return
        random = np.random.default_rng(seed)
        name = list(inputs)[seed % len(inputs)]
        path, action = inputs[name]
        with tempfile.TemporaryDirectory() as folder:
            home, out = Path(folder) / "in", Path(folder) / "out"
            home.mkdir()
            out.mkdir()
            for beside in path.parent.iterdir():
                if beside != path:
                    os.link(beside, home / beside.name) if beside.suffix == ".safetensors" else shutil.copy(
                        beside, home
                    )
            try:
                ways, content = mutate(path, path.read_bytes(), random)
            except (ValueError, OSError, TypeError, KeyError) as error:  # the library refuses to write such a file
                ways, content = f"none ({error!r:.50})", path.read_bytes()
            target = home / path.name
            target.write_bytes(content)
            verdict = judge(partial(action, target, out, random))
            findings.cases = seed + 1
            findings.verdicts[verdict.kind] += 1
            findings.by_input.setdefault(name, Counter())[verdict.kind] += 1
            findings.most_mib = max(findings.most_mib, verdict.mib)
            if verdict.kind not in GOOD:
                findings.bad.append(
                    {"seed": seed, "input": name, "ways": ways, "verdict": verdict.kind, "why": verdict.details}
                )
                print(f"{verdict.kind}: seed {seed}, {name} ({ways}): {verdict.details}", flush=True)
                if len(content) <= MAX_KEPT_BYTES:
                    shutil.copy(target, keep / f"{seed}-{name}")


def run(count: int, seed: int, minutes: float, only: str, out: Path, keep: Path) -> Findings:
    """Fuzz from where the file ended, and write it every hundred cases."""
    before = json.loads(out.read_text(encoding="utf-8")) if out.exists() else {}
    counters = {name: Counter(found) for name, found in before.get("by_input", {}).items()}
    findings = Findings(
        before.get("cases", 0),
        Counter(before.get("verdicts", {})),
        counters,
        before.get("most_mib", 0),
        before.get("bad", []),
    )
    until_s = time.monotonic() + 60 * minutes
    torch.set_num_threads(1)  # a forked process has none of its parent's threads
    build_app()  # import here what each forked process would import again
    import_module("nlos_models.export")
    with tempfile.TemporaryDirectory() as folder:
        inputs = make_inputs(Path(folder))
        chosen = {name: each for name, each in inputs.items() if only in name}
        for start in range(findings.cases or seed, seed + count, 100):
            fuzz(chosen, findings, range(start, min(start + 100, seed + count)), keep, until_s)
            facts = {"machine": machine(), "timeout_s": TIMEOUT_S, "memory_mib": MEMORY_BYTES >> 20, **vars(findings)}
            with atomic_file(out) as part:
                part.write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    return findings


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=1e6)
    parser.add_argument("--only", default="", help="only inputs with this in their name")
    parser.add_argument("--out", type=Path, default=DOCS / "fuzz.json")
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()))
    sys.exit(bool(run(**vars(parser.parse_args())).bad))
