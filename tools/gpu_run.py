"""One command for a GPU: renders, trains, evaluates, and writes the weights in parts of at most 16
MB.

`python tools/gpu_run.py --out DIR [--minutes 25] [--workers N] [--accelerator cuda]` builds
datasets in the background, trains the direct network on its shards as they appear, then an encoder
for the paper's decoder and the paper's compressor, each for a share of the time, and evaluates both
networks. `python tools/gpu_run.py --join DIR/direct.00 --out WEIGHTS` puts weights together again.
The same command resumes an interrupted run. Every step's log is in DIR/NAME.log, times and figures
in DIR/run.json.
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
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]
RECIPES = ROOT / "models" / "recipes"
PART_BYTES = 16 * 10**6
DIRECT_SHARE = 0.5
COMPRESSOR_SHARE = 0.2
TIMING_SHARE = 0.15
"""Shares of the time: for training each network, and at most for timing the direct one; the rest is
for all else.
"""
TIMING_EPOCHS = 3
KEPT_FIGURES = "silhouette_iou", "foreground_rmse_mm", "unseen", "recognised"
SEED = 2_000_000
HELD_OUT_SEED = 10_000_000
OBJECTS = 1_000_000
"""Upper limit of what is rendered; the time ends it earlier."""
BENCHES = ("--rig-spread-mm", "10", "--rig-spread-deg", "5", "--objects-per-rig", "50")
"""Half of the direct network's objects are on measured benches, and aligned with the one rig."""
PROGRAM = (
    sys.executable,
    "-P",
    "-c",
    "import sys; from nlos_cam.cli import run; sys.argv[0] = 'nlos-cam'; run()",
)


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
def rendering(
    out: Path, name: str, seed: int, workers: int, more: Sequence[str] = ()
) -> Generator[Path]:
    """Build a training set in the background, from its first shards on; it ends with the block."""
    folder = out / name
    command = [
        "dataset",
        "build",
        "--out",
        str(folder),
        "--count",
        str(OBJECTS),
        "--seed",
        str(seed),
        *more,
    ]
    options = [
        "--accuracy",
        "draft",
        "--share-generic",
        "0.5",
        "--expected-maps",
        "--workers",
        str(workers),
    ]
    with (out / f"{name}.log").open("a", encoding="utf-8") as log:
        child = subprocess.Popen([*PROGRAM, *command, *options], stdout=log, stderr=log)
        try:
            yield folder
        finally:
            child.send_signal(signal.SIGINT)
            child.wait()


def wait_for(folder: Path, objects: int, limit_s: float) -> None:
    """Wait until a dataset holds some objects. Raises SystemExit after a time."""
    end_s = time.perf_counter() + limit_s
    while 100 * len(list(folder.glob("shard-*.h5"))) < objects:
        if time.perf_counter() > end_s:
            raise SystemExit(
                f"{folder} has fewer than {objects} objects after {limit_s:.0f} s: see {folder}.log"
            )
        time.sleep(1)


def recipe_with(source: Path, target: Path, **changes: float) -> Path:
    """Write a copy of a recipe with other numbers."""
    text = source.read_text(encoding="utf-8")
    for key, value in changes.items():
        text = re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", text)
    target.write_text(text, encoding="utf-8")
    return target


def epoch_seconds(log: Path) -> list[float]:
    """Return the seconds of each epoch in a training log, which need not exist yet."""
    lines = log.read_text(encoding="utf-8").splitlines()[1:] if log.exists() else []
    return [float(line.rpartition(",")[2]) for line in lines]


def epochs_within(seconds: float, log: Path) -> int:
    """Return the epochs that fit, by the fastest of the epochs in a training log (the first one
    starts slowly).
    """
    if not (each := epoch_seconds(log)):
        raise SystemExit(f"{log} has no epoch: give more --minutes")
    return max(2, int(0.95 * seconds / min(each)))


def write_parts(folder: Path, names: Sequence[str], target: Path) -> list[Path]:
    """Write files of a folder as one ZIP file in parts of at most PART_BYTES; return the parts."""
    whole = target.with_suffix(".whole")
    with zipfile.ZipFile(whole, "w") as archive:  # float16 weights hardly shrink
        for name in names:
            archive.write(folder / name, name)
    content = whole.read_bytes()
    whole.unlink()
    parts = list[Path]()
    for number, start in enumerate(range(0, len(content), PART_BYTES)):
        parts.append(target.with_suffix(f".{number:02d}"))
        parts[-1].write_bytes(content[start : start + PART_BYTES])
    return parts


def join_parts(first: Path, out: Path) -> None:
    """Put weights in parts together again, into the folder `out`."""
    whole = out.with_suffix(".joining")
    whole.write_bytes(
        b"".join(
            part.read_bytes() for part in sorted(first.parent.glob(f"{first.stem}.[0-9][0-9]"))
        )
    )
    with zipfile.ZipFile(whole) as archive:
        archive.extractall(out)
    whole.unlink()


def train_and_judge(chosen: Namespace) -> None:
    """Run all steps within the time."""
    out = chosen.out
    start_s = time.perf_counter()
    budget_s = 60 * chosen.minutes
    out.mkdir(parents=True, exist_ok=True)
    facts: dict[str, object] = {"minutes": chosen.minutes, "workers": chosen.workers}

    def finish(name: str, value: object) -> None:
        facts[name] = value
        (out / "run.json").write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")

    held_out = out / "held-out"
    weights = {"direct": out / "direct", "compressor": out / "compressor"}
    common = ["--held-out", str(held_out), "--accelerator", chosen.accelerator]
    held = ["--count", str(chosen.held_out), "--seed", str(HELD_OUT_SEED), "--accuracy", "draft"]
    shared = ["--share-generic", "0.5", "--workers", str(chosen.workers)]
    finish(
        "held_out_s",
        go(out, "held-out", ["dataset", "build", "--out", str(held_out), *held, *shared]),
    )
    half = max(1, chosen.workers // 2)
    with (
        rendering(out, "training", SEED, half) as training,
        rendering(out, "benches", SEED + OBJECTS, half, BENCHES) as benches,
    ):
        for folder in (training, benches):
            wait_for(folder, chosen.first_objects // 2, 0.2 * budget_s)
        direct = [
            "--dataset",
            str(training),
            "--dataset",
            str(benches),
            *common,
            "--store",
            str(out / "packed"),
        ]
        recipe = out / "direct.toml"
        timing = out / "timing"
        if not recipe.exists():  # an interrupted run keeps its schedule
            trial = recipe_with(chosen.recipe, out / "timing.toml", epochs=10000)
            arguments = ["train", "direct", "--recipe", str(trial), "--out", str(timing), *direct]

            def timed(s: float) -> bool:
                return (
                    len(epoch_seconds(timing / "log.csv")) >= TIMING_EPOCHS
                    or s > TIMING_SHARE * budget_s
                )

            finish("timing_s", go(out, "timing", arguments, timed))
            epochs = epochs_within(DIRECT_SHARE * budget_s, timing / "log.csv")
            recipe_with(chosen.recipe, recipe, epochs=epochs)
        arguments = [
            "train",
            "direct",
            "--recipe",
            str(recipe),
            "--out",
            str(weights["direct"]),
            *direct,
        ]
        finish("direct_s", go(out, "direct", arguments))
    objects = 100 * len(list(training.glob("shard-*.h5")))
    finish("objects", objects)
    end_s = time.perf_counter() + min(
        COMPRESSOR_SHARE * budget_s, budget_s - (time.perf_counter() - start_s)
    )
    encoder = ["train", "vae", "--recipe", str(chosen.encoder), "--out", str(out / "encoder")]
    finish("encoder_s", go(out, "encoder", [*encoder, "--accelerator", chosen.accelerator]))
    if (left_s := end_s - time.perf_counter()) > 0:
        epochs = chosen.compressor_epochs
        ready = recipe_with(
            chosen.compressor, out / "compressor.toml", objects=objects, epochs=epochs
        )
        paper = [
            "train",
            "compressor",
            "--recipe",
            str(ready),
            "--vae",
            str(out / "encoder"),
            *common,
        ]
        arguments = [*paper, "--dataset", str(training), "--out", str(weights["compressor"])]
        finish("compressor_s", go(out, "compressor", arguments, lambda s: s > left_s))
    for name, folder in weights.items():
        if (folder / "checkpoint.json").exists():
            judged = [
                "evaluate",
                "--weights",
                str(folder),
                "--out",
                str(out / f"{name}-figures"),
                "--no-nearest",
            ]
            go(out, f"{name}-evaluate", [*judged, "--overwrite"])
            figures = json.loads(
                (out / f"{name}-figures" / "figures.json").read_text(encoding="utf-8")
            )
            finish(name, {key: figures[key] for key in KEPT_FIGURES})
            kept = sorted(
                path.name
                for path in folder.iterdir()
                if path.suffix in {".safetensors", ".json", ".onnx"}
            )
            finish(
                f"{name}_parts",
                [part.name for part in write_parts(folder, kept, out / f"{name}.zip")],
            )
    finish("total_s", time.perf_counter() - start_s)


def options() -> ArgumentParser:
    """Return the parser."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--join", type=Path)
    parser.add_argument("--minutes", type=float, default=25.0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--accelerator", default="auto")
    parser.add_argument("--recipe", type=Path, default=RECIPES / "paper-rig-direct-gpu.toml")
    parser.add_argument("--encoder", type=Path, default=RECIPES / "paper-rig-vae-encoder.toml")
    parser.add_argument(
        "--compressor", type=Path, default=RECIPES / "paper-rig-compressor-gpu.toml"
    )
    parser.add_argument("--compressor-epochs", type=int, default=20)
    parser.add_argument("--held-out", type=int, default=1000)
    parser.add_argument("--first-objects", type=int, default=4000)
    return parser


if __name__ == "__main__":
    given = options().parse_args()
    if given.join:
        join_parts(given.join, given.out)
    else:
        train_and_judge(given)
