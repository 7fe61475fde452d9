"""What limits a figure of `evaluate`: the steps apart, less noise, more frames, more data: docs/limits.json.

`--weights DIR` names other weights than the shipped ones; given more than once, the further ones are a learning curve,
by the objects that each was trained on. `--frames N` changes the frames averaged; `--out` where the table goes.
"""

import json
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from nlos_calibration.wall_record import rig_named
from nlos_models.checkpoint import load_pipeline, load_record, load_vae, shipped_folder
from nlos_models.losses import latent_error
from nlos_models.pipeline import Pipeline
from nlos_models.res_vae import ResVae
from nlos_models.silhouette import cut_silhouette, lift_edges

from nlos_cam.cli.common import say, tracked
from nlos_cam.dataset import TRAINING_SEED
from nlos_cam.evaluate import BARS, Figures, judge
from nlos_cam.evaluate_objects import QUIET, Subject, echoes_of, seeded_objects, sense, truth_of
from nlos_cam.evaluate_report import in_words
from nlos_cam.frames import Float32, LidarMaps
from nlos_cam.objects.depth_image import object_box
from nlos_cam.objects.test_set import test_set

DOCS = Path(__file__).parents[1] / "docs"
FRAMES = 10, 100


@dataclass(frozen=True)
class Row:
    """One experiment."""

    name: str
    tells: str
    """What it leaves out or adds."""
    figures: Figures
    latent_error: float | None = None
    """Of the compressor, in units of the encoder's own spread, summed over 256 entries."""


class Network:
    """The two steps, apart and together."""

    def __init__(self, folder: Path) -> None:
        self.pipeline: Pipeline = load_pipeline(folder)[0]
        self.vae: ResVae = load_vae(folder)[0]

    @torch.inference_mode()
    def image(self, maps: Sequence[LidarMaps]) -> Float32:
        """Both steps: images (n, 64, 64)."""
        return self.pipeline(*_tensors(maps)).numpy()

    @torch.inference_mode()
    def raw_image(self, maps: Sequence[LidarMaps]) -> Float32:
        """Both steps without the silhouette's: what the decoder says."""
        return self.pipeline.decoder(self.pipeline.latent(*_tensors(maps)))[:, 0].numpy()

    @torch.inference_mode()
    def rebuilt(self, truth: Float32) -> Float32:
        """The VAE alone: the decoder's image of the true latent, cut and lifted as the pipeline does."""
        image = self.pipeline.decoder(self.vae.encoder(torch.from_numpy(truth)[:, None])[0])
        return torch.where(cut_silhouette(image) > 0, lift_edges(image), 0.0)[:, 0].numpy()

    @torch.inference_mode()
    def latent_error(self, maps: Sequence[LidarMaps], truth: Float32) -> float:
        """Of the compressor's latent, against the encoder's."""
        return float(
            latent_error(self.pipeline.latent(*_tensors(maps)), *self.vae.encoder(torch.from_numpy(truth)[:, None]))
        )


def _tensors(maps: Sequence[LidarMaps]) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(np.stack([m.depth_m for m in maps])), torch.from_numpy(
        np.stack([m.intensity for m in maps])
    )


def experiments(
    folder: Path, subjects: Sequence[Subject], seen: Sequence[Subject], frames: Sequence[int] = FRAMES
) -> Iterator[Row]:
    """One row for each; `seen` are objects that the weights were trained on."""
    network = Network(folder)
    rig = rig_named(load_record(folder).rig_name)
    box = object_box(rig)
    truth, seen_truth = truth_of(subjects, box), truth_of(seen, box)
    with tracked("rendering") as on_progress:
        echoes = echoes_of([*subjects, *seen], rig, on_progress)
    echoes, seen_echoes = echoes[: len(subjects)], echoes[len(subjects) :]
    maps, rebuilt = sense(echoes, rig), network.rebuilt(truth)
    image = network.image(maps)

    def against(of: Float32, what: Float32 = truth) -> Figures:
        return judge(of, what, box)

    yield Row("as evaluated", "both steps, noise on, one frame", against(image), network.latent_error(maps, truth))
    yield Row("VAE alone", "no compressor: the decoder on the true latent", against(rebuilt))
    yield Row(
        "compressor alone", "no VAE error: against the decoder's image of the true latent", against(image, rebuilt)
    )
    yield Row("no silhouette step", "what the decoder says, neither cut nor lifted", against(network.raw_image(maps)))
    quiet = sense(echoes, rig, QUIET)
    yield Row(
        "noise off", "no noise, no dead pixels", against(network.image(quiet)), network.latent_error(quiet, truth)
    )
    for count in frames:
        mean = sense(echoes, rig, frames=count)
        yield Row(f"{count} frames", "averaged", against(network.image(mean)), network.latent_error(mean, truth))
    own = sense(seen_echoes, rig)
    name, error = "training's objects", network.latent_error(own, seen_truth)
    yield Row(name, "by their seeds, with other noise", against(network.image(own), seen_truth), error)


def learning_curve(folders: Sequence[Path], subjects: Sequence[Subject]) -> Iterator[Row]:
    """One row for each folder of weights, from few training objects to many, on the rig of each."""
    for folder in sorted(folders, key=_objects):
        record, network = load_record(folder), Network(folder)
        rig = rig_named(record.rig_name)
        with tracked(f"rendering for {folder.name}") as on_progress:
            maps = sense(echoes_of(subjects, rig, on_progress), rig)
        truth = truth_of(subjects, object_box(rig))
        epochs = record.compressor_recipe.epochs if record.compressor_recipe else 0
        name, tells = f"{_objects(folder)} objects", f"{epochs} epochs: {folder.name}"
        yield Row(name, tells, judge(network.image(maps), truth, object_box(rig)), network.latent_error(maps, truth))


def _objects(folder: Path) -> int:
    recipe = load_record(folder).compressor_recipe
    return recipe.objects if recipe else 0


def as_markdown(rows: Sequence[Row]) -> str:
    """The table for people."""
    head = ["experiment", "what it leaves out or adds", *BARS, "latent error"]
    lines = [head, ["---"] * len(head)]
    for row in rows:
        latent = "" if row.latent_error is None else f"{row.latent_error:.0f}"
        lines.append([row.name, row.tells, *(in_words(row.figures[name]) for name in BARS), latent])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    """Measure, write, print."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--weights", type=Path, action="append", default=[])
    parser.add_argument("--frames", type=int, nargs="*", default=list(FRAMES))
    parser.add_argument("--out", type=Path, default=DOCS / "limits.json")
    asked = parser.parse_args()
    folder: Path = asked.weights[0] if asked.weights else shipped_folder()
    box = object_box(rig_named(load_record(folder).rig_name))
    subjects = test_set(box)
    seen = seeded_objects(TRAINING_SEED, len(subjects), box)
    rows = [*experiments(folder, subjects, seen, asked.frames)]
    if asked.weights[1:]:
        rows += learning_curve(asked.weights, subjects)
    table = {"objects": len(subjects), "rows": [asdict(row) for row in rows]}
    asked.out.write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
    print(as_markdown(rows))
    say(f"written to {asked.out}")


if __name__ == "__main__":
    main()
