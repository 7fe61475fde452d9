"""Full colour from objects to picture (simulation only: the L515's laser is infrared): figures.json and sheet.png.

Runs `dataset build --colour`, `train vae` and `train compressor`, says each command, and judges the weights on the 54
test objects, painted. A second call goes on where the first was stopped. Without options it is the recipes' own scale,
which wants a GPU; `--small` is for two CPU cores: some minutes of rendering, half an hour for each training.
"""

import argparse
import json
import os
import shlex
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import load_rig
from nlos_models import load_pipeline, load_recipe, load_vae, rebuild, run

from nlos_cam.cli.common import PAPER_RIG, tracked
from nlos_cam.cli.main import main as nlos_cam
from nlos_cam.dataset import HELD_OUT_SEED, TEST_SEED, TRAINING_SEED, open_dataset
from nlos_cam.evaluate import draw_color_sheet, figures_of_color, painted_maps
from nlos_cam.objects import OBJECTS_PER_CATEGORY, benchmark_objects, object_box

RECIPES = Path(__file__).parents[2] / "models" / "recipes"


def commands(out: Path, accuracy: str, workers: int, *, small: bool) -> Iterator[list[str]]:
    """Yield the arguments of each call of `nlos-cam`, in order."""
    vae, compressor = (RECIPES / f"colour-{task}{'-small' if small else ''}.toml" for task in ("vae", "compressor"))
    recipe = load_recipe(compressor)
    how = ["--accuracy", accuracy, "--workers", str(workers)]
    sets = {"train": (TRAINING_SEED, recipe.objects), "held-out": (HELD_OUT_SEED, recipe.held_out)}
    for name, (seed, count) in sets.items():
        of = ["--out", str(out / name), "--count", str(count), "--seed", str(seed)]
        yield ["dataset", "build", "--colour", *of, *how]
    yield ["train", "vae", "--recipe", str(vae), "--out", str(out / "vae")]
    maps = ["--dataset", str(out / "train"), "--held-out", str(out / "held-out")]
    into = ["--vae", str(out / "vae"), "--out", str(out / "compressor")]
    yield ["train", "compressor", "--recipe", str(compressor), *maps, *into]


def judge_all(out: Path, accuracy: str) -> dict[str, Any]:
    """Figures of the pipeline, of the VAE alone and of what needs no network, on the test objects; and the pictures."""
    rig = load_rig(PAPER_RIG)
    depths = [one.depth_m for one in benchmark_objects(object_box(rig))]
    with tracked("rendering test objects in colour") as on_progress:
        maps = painted_maps(depths, rig, TEST_SEED, accuracy, on_progress)
    truth = maps.image.astype(np.float32)
    image, alone = run(load_pipeline(out / "compressor")[0], maps), rebuild(load_vae(out / "vae")[0], maps.image)
    for name, made in (("sheet", image), ("sheet-vae", alone)):
        draw_color_sheet(out / f"{name}.png", made[::OBJECTS_PER_CATEGORY], truth[::OBJECTS_PER_CATEGORY])
    training = open_dataset(out / "train", color=True).column("image")
    return figures_of_color(image, truth, {"vae_alone": alone}, training)


def main() -> None:
    """Build, train, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--small", action="store_true", help="by the small recipes")
    parser.add_argument("--accuracy", default="standard", help="of the renderer")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    started = time.perf_counter()
    for command in commands(given.out, given.accuracy, given.workers, small=given.small):
        print(f"nlos-cam {shlex.join(command)}", file=sys.stderr)
        if code := nlos_cam(command):
            raise SystemExit(code)
    figures = {**judge_all(given.out, given.accuracy), "seconds": time.perf_counter() - started}
    (given.out / "figures.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
