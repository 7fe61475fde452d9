"""What limits a figure of `evaluate`: the steps apart, less noise, more frames: docs/limits.json.

`--weights DIR` names other weights than the shipped ones; `--frames N` changes the frames averaged; `--out` where the
table goes. More data, and other ways to train: `tools/ablations.py`.
"""

import json
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from named_weights import errors_told
from nlos_calibration.arrays import Float32
from nlos_models.checkpoint import load_encoder, load_pipeline, load_record, shipped_folder
from nlos_models.data import MapSet
from nlos_models.losses import latent_error
from nlos_models.pipeline import cut_silhouette, lift_edges
from nlos_models.tasks import run

from nlos_cam.cli.common import say, tracked
from nlos_cam.dataset.build import TEST_SEED, TRAINING_SEED, DatasetPlan
from nlos_cam.evaluate.metrics import BARS, Figures, judge
from nlos_cam.evaluate.report import in_words
from nlos_cam.evaluate.subjects import (
    QUIET,
    Subject,
    as_eaten,
    as_map_set,
    bare_wall_for,
    echoes_of,
    rig_of,
    seeded_objects,
    sense,
    truth_of,
)
from nlos_cam.frames import LidarMaps
from nlos_cam.objects.benchmark import test_set
from nlos_cam.objects.depth_map import object_box

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
    """Of the compressor, in units of the encoder's own spread, summed over 256 entries; None without an encoder."""


class Network:
    """The two steps, apart and together."""

    def __init__(self, folder: Path) -> None:
        self.pipeline, self.record = load_pipeline(folder)
        recipe = self.record.compressor_recipe
        self.encoder = None if recipe and recipe.steps == "two-then-joint" else load_encoder(folder)
        """None, too, where the decoder has left what the encoder was trained with."""
        self.rig = rig_of(self.record)
        self._bare = bare_wall_for(self.record, DatasetPlan(self.rig, TEST_SEED))

    def eaten(self, maps: Sequence[LidarMaps], truth: Float32) -> MapSet:
        """Maps and their truths, as the compressor eats them."""
        return as_eaten(as_map_set(maps, truth), self._bare)

    def image(self, maps: MapSet) -> Float32:
        """Both steps: images (n, 64, 64)."""
        return run(self.pipeline, maps)

    @torch.inference_mode()
    def raw_image(self, maps: MapSet) -> Float32:
        """Both steps without the silhouette's: what the decoder says."""
        return self.pipeline.decoder(self._latent(maps))[:, 0].numpy()

    @torch.inference_mode()
    def rebuilt(self, truth: Float32) -> Float32 | None:
        """The VAE alone: the decoder's image of the true latent, cut and lifted as the pipeline does."""
        if self.encoder is None:
            return None
        image = self.pipeline.decoder(self.encoder(torch.from_numpy(truth)[:, None])[0])
        return torch.where(cut_silhouette(image) > 0, lift_edges(image), 0.0)[:, 0].numpy()

    @torch.inference_mode()
    def latent_error(self, maps: MapSet) -> float | None:
        """Of the compressor's latent, against the encoder's."""
        if self.encoder is None:
            return None
        truth = torch.from_numpy(maps.image)[:, None]
        return float(latent_error(self._latent(maps), *self.encoder(truth)))

    def _latent(self, maps: MapSet) -> torch.Tensor:
        return self.pipeline.latent(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity))


def experiments(
    folder: Path, subjects: Sequence[Subject], seen: Sequence[Subject], frames: Sequence[int] = FRAMES
) -> Iterator[Row]:
    """One row for each; `seen` are objects that the weights were trained on.

    Of weights that were trained in one step, or both steps together at last, what needs the VAE's latent is left out.
    """
    network = Network(folder)
    rig, box = network.rig, object_box(network.rig)
    truth, seen_truth = truth_of(subjects, box), truth_of(seen, box)
    with tracked("rendering") as on_progress:
        echoes = echoes_of([*subjects, *seen], rig, on_progress)
    echoes, seen_echoes = echoes[: len(subjects)], echoes[len(subjects) :]

    def row(name: str, tells: str, maps: MapSet) -> Row:
        return Row(name, tells, judge(network.image(maps), maps.image, box), network.latent_error(maps))

    maps = network.eaten(sense(echoes, rig), truth)
    yield row("as evaluated", "both steps, noise on, one frame", maps)
    if (rebuilt := network.rebuilt(truth)) is not None:
        yield Row("VAE alone", "no compressor: the decoder on the true latent", judge(rebuilt, truth, box))
        against = judge(network.image(maps), rebuilt, box)
        yield Row("compressor alone", "no VAE error: against the decoder's image of the true latent", against)
    raw = judge(network.raw_image(maps), truth, box)
    yield Row("no silhouette step", "what the decoder says, neither cut nor lifted", raw)
    yield row("noise off", "no noise, no dead pixels", network.eaten(sense(echoes, rig, QUIET), truth))
    for count in frames:
        yield row(f"{count} frames", "averaged", network.eaten(sense(echoes, rig, frames=count), truth))
    own = network.eaten(sense(seen_echoes, rig), seen_truth)
    yield row("training's objects", "by their seeds, with other noise", own)


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
    parser.add_argument("--weights", type=Path, default=shipped_folder())
    parser.add_argument("--frames", type=int, nargs="*", default=list(FRAMES))
    parser.add_argument("--out", type=Path, default=DOCS / "limits.json")
    asked = parser.parse_args()
    with errors_told():
        box = object_box(rig_of(load_record(asked.weights)))
        subjects = test_set(box)
        seen = seeded_objects(TRAINING_SEED, len(subjects), box)
        rows = [*experiments(asked.weights, subjects, seen, asked.frames)]
    table = {"objects": len(subjects), "rows": [asdict(row) for row in rows]}
    asked.out.write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
    print(as_markdown(rows))
    say(f"written to {asked.out}")


if __name__ == "__main__":
    main()
