"""Full colour from objects to picture (simulation only: the L515's laser is infrared): figures.json and sheet.png.

Builds datasets in colour, trains VAE and compressor by the recipes of models/recipes, and judges them on test objects.
A second call goes on where the first was stopped. Without options it is the recipes' own scale, which wants a GPU;
`--objects 300 --held-out 40 --vae-epochs 10 --epochs 6 --accuracy draft` shows that the path works.
"""

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration.rig import load_rig
from nlos_models.checkpoint import load_pipeline, load_vae
from nlos_models.colour_tasks import rebuild, run_colour
from nlos_models.recipe import Recipe, load_recipe

from nlos_cam.cli.common import PAPER_RIG, tracked
from nlos_cam.colour_data import build_colour, read_colour
from nlos_cam.colour_evaluate import SIMULATION_ONLY, colour_guesses, draw_colour_sheet, judge_colour
from nlos_cam.colour_train import train_compressor, train_vae
from nlos_cam.dataset import HELD_OUT_SEED, TEST_SEED, TRAINING_SEED, DatasetPlan

RECIPES = Path(__file__).parents[1] / "models" / "recipes"
SETS = {"train": TRAINING_SEED, "held-out": HELD_OUT_SEED, "test": TEST_SEED}


def recipe_named(name: str, **changes: int | None) -> Recipe:
    """A recipe of this repository with some of its numbers changed; None keeps one."""
    recipe = load_recipe(RECIPES / f"colour-{name}.toml")
    changed = {**recipe.model_dump(), **{key: value for key, value in changes.items() if value is not None}}
    return Recipe.model_validate({**changed, "batch": min(changed["batch"], changed["objects"])})


def build_all(out: Path, compressor: Recipe, test: int, accuracy: str, workers: int) -> None:
    """The three datasets."""
    counts = {"train": compressor.objects, "held-out": compressor.held_out, "test": test}
    for name, seed in SETS.items():
        with tracked(f"rendering in colour: {name}") as on_progress:
            plan = DatasetPlan(load_rig(PAPER_RIG), seed, accuracy=accuracy)
            build_colour(plan, counts[name], out / name, workers=workers, on_progress=on_progress)


def train_both(out: Path, vae: Recipe, compressor: Recipe) -> None:
    """Both steps, into two folders."""
    with tracked("training the colour VAE") as on_step:
        train_vae(vae, load_rig(PAPER_RIG), out / "vae", on_step)
    with tracked("training the colour compressor") as on_step:
        train_compressor(compressor, out / "vae", out / "train", out / "held-out", out / "compressor", on_step)


def judge_all(out: Path) -> dict[str, Any]:
    """Figures of the pipeline, of the VAE alone and of what needs no network, on the test objects; and the picture."""
    maps, _ = read_colour(out / "test")
    training, _ = read_colour(out / "train")
    truth = maps.image.astype(np.float32)
    image = run_colour(load_pipeline(out / "compressor")[0], maps)
    alone = rebuild(load_vae(out / "vae")[0], maps.image)
    draw_colour_sheet(out / "sheet.png", image, truth)
    draw_colour_sheet(out / "sheet-vae.png", alone, truth)
    others = {"vae_alone": alone, **colour_guesses(image, training.image)}
    baselines = {name: judge_colour(guess, truth) for name, guess in others.items()}
    return {"note": SIMULATION_ONLY, "objects": len(truth), **judge_colour(image, truth), "baselines": baselines}


def main() -> None:
    """Build, train, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--test", type=int, default=54, help="test objects")
    parser.add_argument("--accuracy", default="standard", help="of the renderer")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    for name in ("--objects", "--held-out", "--vae-epochs", "--epochs", "--batch"):
        parser.add_argument(name, type=int, help="instead of the recipe's")
    given = parser.parse_args()
    shared = {"objects": given.objects, "held_out": given.held_out, "batch": given.batch}
    vae, compressor = (
        recipe_named("vae", **shared, epochs=given.vae_epochs),
        recipe_named("compressor", **shared, epochs=given.epochs),
    )
    started = time.perf_counter()
    build_all(given.out, compressor, given.test, given.accuracy, given.workers)
    train_both(given.out, vae, compressor)
    figures = {**judge_all(given.out), "seconds": time.perf_counter() - started}
    (given.out / "figures.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
