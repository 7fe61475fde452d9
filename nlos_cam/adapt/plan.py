"""Plan of an adaptation: how many objects and steps fit into the minutes, on this machine.

The pace of rendering and training is measured once and kept in the plan with everything else that
decides the weights. So an adaptation that was killed goes on to the same weights, also if the
machine is slower then.
"""

import json
from pathlib import Path
from typing import Annotated

from nlos_calibration import MeasuredWall, Record, depth_offset_m
from nlos_models.training import DirectRecipe, UncertaintyRecipe
from pydantic import Field, ValidationError

from nlos_cam.dataset import HELD_OUT_SEED, SHARD, RigSpread
from nlos_cam.errors import RecordingError
from nlos_cam.files import TEXT_LIMIT, atomic_file, read_bounded
from nlos_cam.reconstruct import measured_counts
from nlos_cam.render import Material, Radiometry, SensorModel

PLAN = "plan.json"
BATCH = 256
NETWORK_SHARE = 0.7
"""Share of the minutes for the network itself; uncertainty, quality and figures get the rest."""
HELD_OUT_OBJECTS = 400
"""Objects by which an epoch is chosen, and of which as many at most calibrate the uncertainty."""
FIRST_OBJECTS = 1000
"""Fewest objects of a stage, also where its minutes are too few for them."""
PASSES = 6
"""Samples of each object: with more, weights that know many rigs learn these objects by heart, with
fewer the minutes would be better spent on training.
"""
STEPS_PER_EPOCH = 40
SAME_MINUTES = 1e-6
"""Difference of two sums of minutes that is rounding's."""
MIN_EPOCHS = 4
MAX_EPOCHS = 60
WHOLE_MINUTES = 100.0
"""Minutes from which on uncertainty and quality get the samples of the shipped weights' recipe."""
MIN_SHARE = 0.04
CERTAIN_TIMES = 2.0
"""Standard uncertainties that a bench may be off its record by: 95 % of benches are within."""
MIN_SPREAD = RigSpread(place_m=0.0005, angle_deg=0.1, gain_share=0.05)
"""A fit's own uncertainty leaves out what it has no model of: a bent wall, a bench that settles.
One column of cells at the occluder's edge flips between wall and occluder at 0.2 mm."""
RULER_STD_M = 0.0005
"""Standard uncertainty of an occluder's place that was measured with a ruler."""
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(gt=0, le=10**9)]


class Pace(Record):
    """Speed of a machine."""

    objects_per_s: Positive
    samples_per_s: Positive


class Stage(Record):
    """Training run of a plan: it starts where the stage before it ended, the first one from the
    start weights.
    """

    minutes: Positive
    """Of this stage alone."""
    objects: Annotated[int, Field(ge=SHARD)]
    """Objects that are rendered by its end, those of earlier stages included."""
    epochs: Count
    steps: Count
    """Of an epoch."""

    @property
    def samples(self) -> int:
        """Number of samples of all epochs."""
        return self.epochs * self.steps * BATCH

    def recipe(self) -> DirectRecipe:
        """Return the recipe: the one that trains the shipped weights on, at a length of this
        stage.
        """
        return DirectRecipe(
            task="direct",
            start="weights",
            objects=self.steps * BATCH,
            held_out=HELD_OUT_OBJECTS,
            epochs=self.epochs,
            batch=BATCH,
            # A higher rate forgets what the start weights know, and has to learn it again.
            learning_rate=4e-4,
            betas=(0.9, 0.98),
            schedule="cosine",
            warm_up_steps=min(100, self.epochs * self.steps // 5),
            weight_decay=0.05,
            # the average forgets the start within a tenth of the run
            average=min(0.998, max(0.0, 1 - 10 / (self.epochs * self.steps))),
            keep="best",
            gradient_limit=1.0,
            dropout=0.1,
            noise=0.02,
            wall_texture=0.05,
            range_offset_m=0.002,
            precision="bf16-mixed",
            deviations=["not the paper's network: two heads, no latent (docs/direct.md)"],
        )


class Locked(Record):
    """Locked differences in place of maps: object in less object out, averaged over many frames."""

    frames: Annotated[int, Field(ge=4, le=10**8)]
    """Averaged in all, half of them with the object."""
    radiometry: Radiometry = "lambertian"
    material: Material = Material()


FIRST_RENDERING = 6
"""Version of the renderer of plans that do not name it."""


class Plan(Record):
    """Everything that decides the weights of an adaptation."""

    rig_checksum: str
    start: str
    """SHA-256 of the start weights' network."""
    spread: RigSpread
    sensor: SensorModel
    seed: Annotated[int, Field(ge=0)]
    pace: Pace
    stages: tuple[Stage, ...] = ()
    locked: Locked | None = None
    """None: maps of single frames, in the paper's radiometry."""
    rendering_version: int = FIRST_RENDERING
    """Of the renderer of its objects."""

    @property
    def minutes(self) -> float:
        """Minutes of all stages."""
        return sum(stage.minutes for stage in self.stages)

    @property
    def objects(self) -> int:
        """Number of objects that all stages have rendered."""
        return self.stages[-1].objects if self.stages else 0

    def extended(self, minutes: float) -> "Plan":
        """Return the plan with a stage for what `minutes` are more than its own; itself where they
        are not.
        """
        further = minutes - self.minutes
        if further <= SAME_MINUTES:
            return self
        seconds = 60 * further * NETWORK_SHARE
        before = self.objects
        objects_per_s = self.pace.objects_per_s
        samples_per_s = self.pace.samples_per_s

        # A new object costs its rendering and its samples, an earlier one its samples alone.
        left_s = seconds - PASSES * before / samples_per_s
        fitting = left_s / (1 / objects_per_s + PASSES / samples_per_s)
        rendered = SHARD * max(round(fitting / SHARD), 0)
        if not before:
            rendered = max(rendered, FIRST_OBJECTS)
        # Seeds of training end where those of held-out objects begin.
        objects = min(before + rendered, HELD_OUT_SEED - self.seed)

        trained_s = seconds - (objects - before) / objects_per_s
        steps = max(round(samples_per_s * trained_s / BATCH), 2 * MIN_EPOCHS)
        epochs = min(max(steps // STEPS_PER_EPOCH, MIN_EPOCHS), MAX_EPOCHS)
        stage = Stage(minutes=further, objects=objects, epochs=epochs, steps=steps // epochs)
        return self.model_copy(update={"stages": (*self.stages, stage)})

    def uncertainty_recipe(self, whole: UncertaintyRecipe) -> UncertaintyRecipe:
        """Return the recipe of the uncertainty network, with a share of the samples of `whole` that
        goes with the minutes.
        """
        share = min(max(self.minutes / WHOLE_MINUTES, MIN_SHARE), 1.0)
        counts = {
            name: max(round(share * getattr(whole, name)), 20)
            for name in ("outliers", "empties", "objects")
        }
        counts["objects"] = max(counts["objects"], 2 * whole.batch)
        held_out = min(whole.held_out, HELD_OUT_OBJECTS)
        return whole.model_copy(update={**counts, "held_out": held_out})

    def save(self, folder: Path) -> None:
        """Write the plan into a folder."""
        with atomic_file(folder / PLAN) as part:
            part.write_text(self.model_dump_json(indent=1) + "\n", encoding="utf-8")


def load_plan(folder: Path) -> Plan | None:
    """Return the plan in a folder; None where there is none. Raises RecordingError for a damaged
    one.
    """
    path = folder / PLAN
    if not path.exists():
        return None
    try:
        return Plan.model_validate(json.loads(read_bounded(path, TEXT_LIMIT)))
    except (OSError, ValueError, ValidationError, RecursionError) as error:
        raise RecordingError(
            f"{path} is damaged: delete {folder} to adapt from the beginning"
        ) from error


def calibration_spread(measured: MeasuredWall | None) -> RigSpread:
    """Return how far a bench may be off its record: CERTAIN_TIMES the standard uncertainties of its
    calibration, occluder included, and at least MIN_SPREAD.
    """
    if measured is None:
        return MIN_SPREAD
    record = measured.record
    place_m = [record.distance_std_m, record.range_offset_std_m or 0.0]
    if record.occluder:
        found = record.occluder.x_std_m, record.occluder.gap_std_m
        place_m += [RULER_STD_M if std_m is None else std_m for std_m in found]
    angle_deg = [record.yaw_std_deg, record.pitch_std_deg]
    return RigSpread(
        place_m=max(MIN_SPREAD.place_m, CERTAIN_TIMES * max(place_m)),
        angle_deg=max(MIN_SPREAD.angle_deg, CERTAIN_TIMES * max(angle_deg)),
        gain_share=MIN_SPREAD.gain_share,
    )


def bench_sensor(measured: MeasuredWall | None) -> SensorModel:
    """Return the sensor of a bench: the simulated one, at the gain that its reference shows."""
    if measured is None or measured.reference is None:
        return SensorModel()
    record = measured.record
    offset_m = depth_offset_m(record)
    counts = measured_counts(record.beam_rig, measured.reference, offset_m)
    return SensorModel() if counts is None else SensorModel(bare_wall_counts=max(counts, 1.0))
