"""The trainings that tools/ablations.py holds side by side, each at a fixed tenth of the shipped compressor's budget.

`python tools/ablation_runs.py RUNS --vae DIR --dataset DIR --held-out DIR [--only NAME ...]`: all, or those named; a
second call goes on where it was stopped, and leaves alone what is done. Each way differs from "two" as CHANGES says and
in nothing else: the same objects in the same order.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w
from nlos_models.recipe import Recipe, load_recipe

from nlos_cam.cli.main import main as nlos_cam

BASE = Path(__file__).parents[1] / "models/recipes/paper-rig-compressor-on.toml"
OBJECTS, EPOCHS = 14_000, 2
"""28,000 maps: a tenth of the recipe's 280,000."""
CHANGES: dict[str, dict[str, Any]] = {
    "two": {},
    "one": {"steps": "one", "latent_weight": 0.0},
    "joint": {
        "steps": "two-then-joint",
        "latent_weight": 0.0,
        "learning_rate": 3e-4,
        "objects": OBJECTS // 5,
        "epochs": 1,
    },
    "squared": {"image_loss": "squared"},
    "latent-alone": {"image_weight": 0.0, "latent_weight": 1.0},
    "half-width": {"width": 0.5},
    "difference": {"maps": "difference maps"},
    "of-7000": {"objects": OBJECTS // 2, "epochs": EPOCHS * 2},
    "of-3500": {"objects": OBJECTS // 4, "epochs": EPOCHS * 4},
    "of-1750": {"objects": OBJECTS // 8, "epochs": EPOCHS * 8},
}
"""What each way changes; "joint" goes on from "two" for a fifth of its maps more."""


def recipe_of(name: str) -> Recipe:
    """The recipe of one way, from nothing; its deviations begin with what it differs by."""
    told = ", ".join(f"{key} = {value}" for key, value in CHANGES[name].items()) or "the base of the others"
    base = load_recipe(BASE).model_dump() | {"start": "scratch", "objects": OBJECTS, "epochs": EPOCHS}
    base["deviations"] = [f"an ablation at a tenth of the budget: {told}", *base["deviations"][1:]]
    return Recipe.model_validate(base | CHANGES[name])


def options_of(name: str, runs: Path, sources: Mapping[str, Path]) -> list[str]:
    """The command line of one way's training."""
    given = {"--dataset": sources["dataset"], "--held-out": sources["held_out"], "--out": runs / name}
    steps = recipe_of(name).steps
    if steps == "two":
        given["--vae"] = sources["vae"]
    if steps == "two-then-joint":
        given["--weights"] = runs / "two"
    recipe = runs / f"{name}.toml"
    recipe.write_text(tomli_w.dumps(recipe_of(name).model_dump()), encoding="utf-8")
    return ["train", "compressor", "--recipe", str(recipe), *(str(word) for pair in given.items() for word in pair)]


def main() -> None:
    """Train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path)
    for name in ("vae", "dataset", "held-out"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--only", nargs="+", default=list(CHANGES), metavar="NAME", help=f"of {', '.join(CHANGES)}")
    given = parser.parse_args()
    if unknown := sorted(set(given.only) - CHANGES.keys()):
        parser.error(f"no way is called {unknown[0]!r}: choose from {', '.join(CHANGES)}")
    given.runs.mkdir(parents=True, exist_ok=True)
    for name in given.only:
        if code := nlos_cam(options_of(name, given.runs, vars(given))):
            raise SystemExit(code)


if __name__ == "__main__":
    main()
