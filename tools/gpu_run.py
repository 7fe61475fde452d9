"""One command for a GPU: renders, trains, evaluates, and writes the weights in parts of at most 16
MB.

`python tools/gpu_run.py --out DIR [--minutes 25] [--workers N] [--accelerator cuda]` builds
datasets in the background, trains the direct network on their shards as they appear, then an
encoder for the paper's decoder and the paper's compressor, each for a share of the time, and
evaluates both networks. `--rig RIG` trains for another rig, `--any-rig` for all that the paper
allows, `--weights DIR` goes on from trained weights (with a recipe whose start they are),
`--direct-only` leaves out the compressor, and `--no-evaluate` the evaluation.
`python tools/gpu_run.py --join DIR/direct.00 --out WEIGHTS` puts weights together again. The same
command resumes an interrupted run. Every step's log is in DIR/NAME.log, times and figures in
DIR/run.json.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
import zipfile
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

ROOT = Path(__file__).parents[1]
RECIPES = ROOT / "models" / "recipes"
PART_BYTES = 16 * 10**6
DIRECT_SHARE = 0.5
DIRECT_ONLY_SHARE = 0.95
COMPRESSOR_SHARE = 0.2
TIMING_SHARE = 0.15
"""Shares of the time: until the direct network is trained, with a compressor after it and without;
for training the compressor; and at most for timing the direct network.
"""
TIMING_EPOCHS = 2
SURE_SHARE = 0.7
"""Share of the time left that epochs are planned for: later ones pack more new shards than those
that were timed. Planned for 0.95 of it, a run took 1.2 times its minutes.
"""
SHARD = 100
"""Objects of a dataset's shard."""
PACKED_BY_ONE = 5
"""Processes that render for one that packs what they made: in the process that trains it took 70 %
of a GPU's time.
"""
KEPT_FIGURES = "silhouette_iou", "foreground_rmse_mm", "unseen", "recognised"
SEED = 2_000_000
HELD_OUT_SEED = 10_000_000
OBJECTS = 1_000_000
"""Upper limit of the rendered objects; the time ends it earlier."""
PROGRAM = (
    sys.executable,
    "-P",
    "-c",
    "import sys; from nlos_cam.cli import run; sys.argv[0] = 'nlos-cam'; run()",
)


@dataclass(frozen=True)
class Objects:
    """Dataset that is rendered while the network trains."""

    name: str
    options: tuple[str, ...]
    """Of `dataset build`, for the rigs that its objects are on."""
    share: float
    """Of the processes that render."""


OFF_RECORD = "--rig-spread-mm", "1", "--rig-spread-deg", "0.2"
ONE_RIG = (
    Objects("training", (), 0.4),
    # A calibration is never exact: the network learns what its error does to the maps.
    Objects("off-record", (*OFF_RECORD, "--off-record", "--objects-per-rig", "25"), 0.4),
    # Benches near the rig, whose maps are aligned with it: for benches without their own weights.
    Objects(
        "benches",
        ("--rig-spread-mm", "10", "--rig-spread-deg", "5", "--objects-per-rig", "50"),
        0.2,
    ),
)
ANY_RIG = (Objects("any-rig", ("--any-rig", *OFF_RECORD), 1.0),)


class Facts:
    """Times and figures of a run, written as they come."""

    def __init__(self, folder: Path, **first: object) -> None:
        self._path = folder / "run.json"
        self._facts = dict(first)

    def add(self, name: str, value: object) -> None:
        """Add one and write all of them."""
        self._facts[name] = value
        self._path.write_text(json.dumps(self._facts, indent=2) + "\n", encoding="utf-8")


class Clock:
    """Time of a run, from its start on."""

    def __init__(self, minutes: float) -> None:
        self._start_s = time.perf_counter()
        self.budget_s = 60 * minutes

    @property
    def passed_s(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self._start_s

    def left_s(self, share: float = 1.0) -> float:
        """Seconds until a share of the time is over; negative after it."""
        return share * self.budget_s - self.passed_s


def go(
    out: Path, name: str, arguments: Sequence[str], ends: Callable[[float], bool] = lambda _: False
) -> float:
    """Run nlos-cam with arguments, log it, and return its seconds; once `ends(seconds)`, interrupt
    it: it saves.
    """
    start_s = time.perf_counter()
    with (out / f"{name}.log").open("a", encoding="utf-8") as log:
        log.write(f"nlos-cam {' '.join(arguments)}\n")
        log.flush()
        child = subprocess.Popen([*PROGRAM, *arguments], stdout=log, stderr=log)
        interrupted = False
        try:
            while child.poll() is None and not (interrupted := ends(time.perf_counter() - start_s)):
                time.sleep(0.2)
        finally:
            if child.poll() is None:
                child.send_signal(signal.SIGINT)
            code = child.wait()
    if code and not interrupted:
        raise SystemExit(f"{name} ended with {code}: see {out / f'{name}.log'}")
    return time.perf_counter() - start_s


@contextmanager
def rendering(chosen: Namespace, every: Sequence[Objects]) -> Generator[list[Path]]:
    """Build datasets in the background, from their first shards on; they end with the block."""
    children = list[subprocess.Popen[bytes]]()
    folders = [chosen.out / each.name for each in every]
    try:
        for number, (each, folder) in enumerate(zip(every, folders, strict=True)):
            workers = max(1, round(each.share * chosen.workers))
            command = [
                *("dataset", "build", "--out", str(folder), "--count", str(OBJECTS)),
                *("--seed", str(chosen.seed + number * OBJECTS), "--expected-maps"),
                *common_options(chosen),
                *("--workers", str(workers)),
                *each.options,
            ]
            with (chosen.out / f"{each.name}.log").open("a", encoding="utf-8") as log:
                log.write(f"nlos-cam {' '.join(command)}\n")
                log.flush()
                children.append(subprocess.Popen([*PROGRAM, *command], stdout=log, stderr=log))
        yield folders
    finally:
        for child in children:
            child.send_signal(signal.SIGINT)
        for child in children:
            child.wait()


def common_options(chosen: Namespace) -> Iterator[str]:
    """Yield the options of `dataset build` that all datasets of a run have."""
    yield from ("--accuracy", "draft", "--share-generic", "0.5", "--rig", chosen.rig)


def objects_in(folder: Path) -> int:
    """Return the number of objects of a dataset in whole shards."""
    return SHARD * len(list(folder.glob("shard-*.h5")))


def wait_for(folder: Path, objects: int, limit_s: float) -> None:
    """Wait until a dataset holds some objects. Raises SystemExit after a time."""
    end_s = time.perf_counter() + limit_s
    while objects_in(folder) < objects:
        if time.perf_counter() > end_s:
            raise SystemExit(
                f"{folder} has fewer than {objects} objects after {limit_s:.0f} s: see {folder}.log"
            )
        time.sleep(1)


def recipe_with(source: Path, target: Path, **changes: float) -> Path:
    """Write a copy of a recipe with other numbers. Raises SystemExit for one that it does not have."""
    text = source.read_text(encoding="utf-8")
    for key, value in changes.items():
        text, found = re.subn(rf"(?m)^{key} = .*$", f"{key} = {value}", text)
        if not found:
            raise SystemExit(f"{source} has no line `{key} = ...`: add one, its number is replaced")
    target.write_text(text, encoding="utf-8")
    return target


def epoch_seconds(log: Path) -> list[float]:
    """Return the seconds of each epoch in a training log, which need not exist yet."""
    lines = log.read_text(encoding="utf-8").splitlines()[1:] if log.exists() else []
    return [float(line.rpartition(",")[2]) for line in lines]


def epochs_within(seconds: float, log: Path) -> int:
    """Return the epochs that fit, by those in a training log without the first, which starts
    slowly: later ones too take up the objects that were rendered while it ran.
    """
    if not (each := epoch_seconds(log)):
        raise SystemExit(f"{log} has no epoch: give more --minutes")
    return max(2, int(SURE_SHARE * seconds / mean(each[1:] or each)))


def write_parts(folder: Path, names: Sequence[str], target: Path) -> list[Path]:
    """Write files of a folder as one ZIP file in parts of at most PART_BYTES; return the parts."""
    whole = target.with_suffix(".whole")
    with zipfile.ZipFile(whole, "w") as archive:  # float16 weights hardly shrink
        for name in names:
            archive.write(folder / name, name)
    content = whole.read_bytes()
    whole.unlink()
    for old in parts_of(target):  # an earlier run's, which would be joined too
        old.unlink()
    parts = list[Path]()
    for number, start in enumerate(range(0, len(content), PART_BYTES)):
        parts.append(target.with_suffix(f".{number:02d}"))
        parts[-1].write_bytes(content[start : start + PART_BYTES])
    return parts


def parts_of(target: Path) -> list[Path]:
    """Return the parts of a file, or of one of its parts, in order."""
    return sorted(target.parent.glob(f"{target.stem}.[0-9][0-9]"))


def join_parts(first: Path, out: Path) -> None:
    """Put weights in parts together again, into the folder `out`."""
    whole = out.with_suffix(".joining")
    whole.write_bytes(b"".join(part.read_bytes() for part in parts_of(first)))
    with zipfile.ZipFile(whole) as archive:
        archive.extractall(out)
    whole.unlink()


def train_direct(chosen: Namespace, clock: Clock, facts: Facts) -> int:
    """Render, and train the direct network beside it; return the number of objects of its rig."""
    out: Path = chosen.out
    held_out = out / "held-out"
    kinds = ANY_RIG if chosen.any_rig else ONE_RIG
    # Held-out objects come with noise, on the record, and on rigs of their own with --any-rig.
    judged = ["dataset", "build", "--out", str(held_out), "--count", str(chosen.held_out)]
    judged += ["--seed", str(HELD_OUT_SEED), *common_options(chosen)]
    judged += ["--workers", str(chosen.workers), *(["--any-rig"] if chosen.any_rig else [])]

    # Before the others: its processes compile the kernels, and all later ones find them compiled.
    facts.add("held_out_s", go(out, "held-out", judged))

    with rendering(chosen, kinds) as folders:
        for kind, folder in zip(kinds, folders, strict=True):
            wait_for(folder, int(kind.share * chosen.first_objects), 0.3 * clock.budget_s)
        facts.add("first_objects_s", clock.passed_s)

        options = ["--held-out", str(held_out), "--store", str(out / "packed")]
        options += [word for folder in folders for word in ("--dataset", str(folder))]
        options += ["--weights", str(chosen.weights)] if chosen.weights else []
        options += ["--accelerator", chosen.accelerator]
        options += ["--pack-workers", str(max(1, chosen.workers // PACKED_BY_ONE))]
        recipe = out / "direct.toml"
        if not recipe.exists():  # an interrupted run keeps its schedule
            epochs = epochs_that_fit(chosen, clock, facts, options)
            recipe_with(chosen.recipe, recipe, epochs=epochs)
            facts.add("epochs", epochs)
        command = ["train", "direct", "--recipe", str(recipe), "--out", str(out / "direct")]
        facts.add("direct_s", go(out, "direct", [*command, *options]))

    for folder in folders:
        facts.add(f"objects in {folder.name}", objects_in(folder))
    return objects_in(folders[0])


def epochs_that_fit(chosen: Namespace, clock: Clock, facts: Facts, options: Sequence[str]) -> int:
    """Return the epochs that fit into the direct network's share of the time, by a trial."""
    timing = chosen.out / "timing"
    trial = recipe_with(chosen.recipe, chosen.out / "timing.toml", epochs=10000)
    command = ["train", "direct", "--recipe", str(trial), "--out", str(timing), *options]

    def timed(seconds: float) -> bool:
        done = len(epoch_seconds(timing / "log.csv"))
        return done >= TIMING_EPOCHS or seconds > TIMING_SHARE * clock.budget_s

    facts.add("timing_s", go(chosen.out, "timing", command, timed))
    share = DIRECT_ONLY_SHARE if chosen.direct_only else DIRECT_SHARE
    return epochs_within(clock.left_s(share), timing / "log.csv")


def train_compressor(chosen: Namespace, clock: Clock, facts: Facts, objects: int) -> None:
    """Train an encoder for the paper's decoder, and the paper's compressor."""
    out: Path = chosen.out
    share = min(COMPRESSOR_SHARE * clock.budget_s, clock.left_s())
    end_s = clock.passed_s + share
    device = ["--accelerator", chosen.accelerator]
    encoder = ["train", "vae", "--recipe", str(chosen.encoder), "--out", str(out / "encoder")]
    facts.add("encoder_s", go(out, "encoder", [*encoder, *device]))
    left_s = end_s - clock.passed_s
    if left_s <= 0:
        return
    epochs = chosen.compressor_epochs
    ready = out / "compressor.toml"
    if not ready.exists():  # an interrupted run keeps its objects: more may be there by now
        recipe_with(chosen.compressor, ready, objects=objects, epochs=epochs)
    command = ["train", "compressor", "--recipe", str(ready), "--vae", str(out / "encoder")]
    command += ["--held-out", str(out / "held-out"), "--dataset", str(out / "training"), *device]
    command += ["--out", str(out / "compressor")]
    facts.add("compressor_s", go(out, "compressor", command, lambda seconds: seconds > left_s))


def judge(chosen: Namespace, facts: Facts, name: str) -> None:
    """Evaluate a network on the test objects."""
    out: Path = chosen.out
    figures = out / f"{name}-figures"
    command = ["evaluate", "--weights", str(out / name), "--out", str(figures), "--no-nearest"]
    command += [] if chosen.any_rig else ["--rig", chosen.rig]
    go(out, f"{name}-evaluate", [*command, "--overwrite"])
    found = json.loads((figures / "figures.json").read_text(encoding="utf-8"))
    facts.add(name, {key: found[key] for key in KEPT_FIGURES})


def train_and_judge(chosen: Namespace) -> None:
    """Run all steps within the time."""
    out: Path = chosen.out
    out.mkdir(parents=True, exist_ok=True)
    clock = Clock(chosen.minutes)
    facts = Facts(out, minutes=chosen.minutes, workers=chosen.workers, rig=chosen.rig)

    objects = train_direct(chosen, clock, facts)
    facts.add("objects", objects)
    if not chosen.direct_only:
        train_compressor(chosen, clock, facts, objects)

    for name in ("direct", "compressor"):
        folder = out / name
        if not (folder / "checkpoint.json").exists():
            continue
        kept = sorted(
            path.name
            for path in folder.iterdir()
            if path.suffix in {".safetensors", ".json", ".onnx"}
        )
        parts = write_parts(folder, kept, out / f"{name}.zip")
        facts.add(f"{name}_parts", [part.name for part in parts])
        if not chosen.no_evaluate:
            judge(chosen, facts, name)
    facts.add("total_s", clock.passed_s)


def options() -> ArgumentParser:
    """Return the parser."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--join", type=Path)
    parser.add_argument("--minutes", type=float, default=25.0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--accelerator", default="auto")
    parser.add_argument("--rig", default="paper-rig")
    parser.add_argument("--any-rig", action="store_true")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--recipe", type=Path, default=RECIPES / "paper-rig-direct-gpu.toml")
    parser.add_argument("--direct-only", action="store_true")
    parser.add_argument("--no-evaluate", action="store_true")
    parser.add_argument("--encoder", type=Path, default=RECIPES / "paper-rig-vae-encoder.toml")
    parser.add_argument(
        "--compressor", type=Path, default=RECIPES / "paper-rig-compressor-gpu.toml"
    )
    parser.add_argument("--compressor-epochs", type=int, default=20)
    parser.add_argument("--held-out", type=int, default=1000)
    parser.add_argument("--first-objects", type=int, default=4000)
    return parser


if __name__ == "__main__":
    parser = options()
    given = parser.parse_args()
    if given.any_rig and not given.direct_only:
        parser.error("--any-rig needs --direct-only: the paper's compressor is for one rig")
    end_seed = given.seed + OBJECTS * len(ANY_RIG if given.any_rig else ONE_RIG)
    if given.seed <= HELD_OUT_SEED + given.held_out and end_seed > HELD_OUT_SEED:
        parser.error(
            f"--seed {given.seed}: objects up to {end_seed} would be among those held out, from"
            f" {HELD_OUT_SEED}: give another one"
        )
    if given.join:
        join_parts(given.join, given.out)
    else:
        train_and_judge(given)
