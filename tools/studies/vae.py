"""What the weight of the divergence does to a Res-VAE: sharpness and used latent entries, docs/vae_divergence.json.

`python tools/studies/vae.py [--images 8000] [--epochs 3] [--weights 0.2 0.05 0.0125 0.003 0] [--out DIR]` trains one
Res-VAE from scratch for each weight, by models/recipes/paper-rig-vae.toml otherwise, on the same images and seed, and
judges it alone on the 54 test objects: image to latent mean to image. Each finished weight is kept.
"""

import json
from argparse import Namespace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import harness
import numpy as np
import torch
from nlos_calibration import rig_named
from nlos_calibration.arrays import Float32
from nlos_models import Recipe, Running, load_recipe, rebuild, train_vae

from nlos_cam.cli.common import tracked
from nlos_cam.dataset import HELD_OUT_SEED, TRAINING_SEED, procedural_images
from nlos_cam.evaluate import machine, over_objects, per_object, plain
from nlos_cam.objects import benchmark_objects, image_from_depth, object_box

USED = 0.05
"""Divergence in nats from which on an entry counts as used: below, it is its prior for every object."""


def slope(images: Float32) -> Float32:
    """Return each image's total variation (n,): blurred edges have the same, lost parts and details less."""
    return np.abs(np.diff(images, axis=1)).sum((1, 2)) + np.abs(np.diff(images, axis=2)).sum((1, 2))


def steepest(images: Float32) -> Float32:
    """Return the mean of each image's steepest hundred steps between neighbors (n,): sharp edges have large ones."""
    steps = np.concatenate([np.abs(np.diff(images, axis=axis)).reshape(len(images), -1) for axis in (1, 2)], axis=1)
    return np.sort(steps, axis=1)[:, -100:].mean(1)


def measure(recipe: Recipe, images: Any, held_out: Any, truth: Float32, on_step: Any) -> dict[str, Any]:
    """Train a VAE; return its metrics over the test objects, and what its latent carries."""
    with TemporaryDirectory() as folder:
        vae, figures = train_vae(recipe, images, held_out, Path(folder), Running(on_step=on_step))
    image = rebuild(vae, truth)
    with torch.inference_mode():
        mean, log_variance = (part.double().numpy() for part in vae.encoder(torch.from_numpy(truth)[:, None]))
    nats = 0.5 * (mean**2 + np.exp(log_variance) - 1 - log_variance).mean(0)
    box = object_box(rig_named("paper-rig"))
    values = per_object(image, truth, box) | {
        "steepest_steps_of_truth": steepest(image) / steepest(truth),
        "total_variation_of_truth": slope(image) / slope(truth),
    }
    row = {"kl_weight": recipe.kl_weight, "samples": recipe.objects * recipe.epochs, **figures}
    return row | plain(over_objects(values)) | {"nats": float(nats.sum()), "used_entries": int((nats > USED).sum())}


def main(chosen: Namespace) -> None:
    """Train and judge a VAE for each weight; write the figures after each."""
    base, box = (
        load_recipe(harness.ROOT / "models" / "recipes" / "paper-rig-vae.toml"),
        object_box(rig_named("paper-rig")),
    )
    base = base.model_copy(update={"objects": chosen.images, "epochs": chosen.epochs})
    images, held_out = (
        procedural_images(seed, count, box)
        for seed, count in ((TRAINING_SEED, chosen.images), (HELD_OUT_SEED, base.held_out))
    )
    truth = np.stack([image_from_depth(one.depth_m, box) for one in benchmark_objects(box)])
    path = (chosen.out or harness.DOCS) / "vae_divergence.json"
    rows: list[Any] = json.loads(path.read_text(encoding="utf-8"))["rows"] if path.exists() else []
    for weight in chosen.weights:
        recipe = base.model_copy(update={"kl_weight": weight})
        if any(row["kl_weight"] == weight and row["samples"] == recipe.objects * recipe.epochs for row in rows):
            continue
        with tracked(f"training a VAE with a divergence weight of {weight:g}") as on_progress:
            rows.append(measure(recipe, images, held_out, truth, on_progress))
        harness.write("vae_divergence", {"machine": machine(), "rows": rows}, chosen.out)
        print(rows[-1], flush=True)


if __name__ == "__main__":
    parser = harness.options(__doc__)
    parser.add_argument("--images", type=int, default=8000)
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--weights", type=float, nargs="+", default=[0.2, 0.05, 0.0125, 0.003, 0.0])
    parser.add_argument("--out", type=Path)
    main(parser.parse_args())
