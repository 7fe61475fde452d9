"""Verdict on weights for a bench: whether networks that were trained for one rig serve another."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from nlos_calibration import (
    Rig,
    box_difference_m,
    lidar_visible_share,
    load_rig,
    missing_wall,
    rig_difference,
    view_difference_deg,
)
from nlos_models import RIG_WEIGHTS, CheckpointRecord, load_record, shipped_folder

from nlos_cam.objects import object_box
from nlos_cam.reconstruct.alignment import (
    grid_refusal,
    own_rig,
    rig_to_align_with,
    training_rig,
)
from nlos_cam.reconstruct.wall_grid import beyond_trained, grid_of

NEAR_M = 0.010
NEAR_DEG = 2.0
NEAR_OCCLUDER_M = 0.005
NEAR_BOX_M = 0.005
"""Differences of rigs that cost at most 0.07 of silhouette IoU, once maps are aligned
(docs/where-it-works.md)."""
SEEN_BOX = 0.001
"""Share of the object box that the lidar may see directly."""
NEAR_WALL = 0.05
"""Share of the view that a smaller wall may leave without any."""

Service = Literal["trained for it", "near", "far", "not"]
SERVICES: tuple[Service, ...] = ("trained for it", "near", "far", "not")
"""The best first."""


@dataclass(frozen=True)
class WeightsVerdict:
    """How well weights serve a bench."""

    service: Service
    """"near" and "far" are benches whose maps are aligned with the rig of the weights."""
    sentence: str
    """Verdict with its reason, for the user."""
    expected_iou: float | None = None
    """Silhouette IoU that weights trained for this bench can be expected to reach; None where it
    was not forecast."""
    falls_short: bool = False
    """True for weights that were trained for this bench, and reached less than was forecast."""

    @property
    def is_warning(self) -> bool:
        """True if larger errors than the bench's own good weights make are to be expected."""
        return self.service != "trained for it" or self.falls_short

    @property
    def serve(self) -> bool:
        """True if pictures are about as right as on the rig of the weights."""
        return self.service in {"trained for it", "near"}


def weights_serve(
    rig: Rig, trained: CheckpointRecord, *, expected_iou: float | None = None, bench: str = "bench/"
) -> WeightsVerdict:
    """Return whether weights serve the rig of a bench, by its distance from their own rig.

    `expected_iou` is a forecast for weights trained for this rig, and `bench` the folder to train
    them in.
    """
    # of maps of any bench the rig, if there is one, is where training went on
    wanted = own_rig(trained) if grid_of(trained) else training_rig(trained)
    if trained.rig_checksum == rig.checksum or (wanted and not rig_difference(rig, wanted)):
        sentence = "the weights serve this bench: they were trained for its rig"
        return WeightsVerdict("trained for it", sentence, expected_iou)

    forecast = "" if expected_iou is None else f" (expected silhouette IoU {expected_iou:.2f})"
    advice = f"`nlos-cam adapt {bench}` trains weights for it{forecast}"
    if grid_of(trained):
        service, sentence = _grid_serves(rig, wanted)
        return WeightsVerdict(service, f"{sentence}; {advice}", expected_iou)
    if wanted is None:
        sentence = (
            f"the networks were trained for another rig than {rig.name}: expect larger errors;"
            f" {advice}"
        )
        return WeightsVerdict("not", sentence, expected_iou)

    service = "not"
    outcome = "do not serve this bench: its maps cannot be aligned with their rig's"
    if rig_to_align_with(rig, trained):
        service = "near" if _deviation(rig, wanted) <= 1 else "far"
        outcome = (
            "may not serve this bench: it is far from their rig, with which its maps are aligned"
        )
        if service == "near":
            outcome = "serve this bench, aligned with their rig, with larger errors"
    difference = "; ".join(rig_difference(rig, wanted))
    return WeightsVerdict(service, f"the weights {outcome} ({difference}); {advice}", expected_iou)


def _grid_serves(rig: Rig, own: Rig | None) -> tuple[Service, str]:
    """Return whether weights on the wall grid serve a rig, and the sentence that says so; `own` is
    another rig that their training went on for, if there is one.
    """
    if why := grid_refusal(rig):
        return "not", f"the weights do not serve this bench: {why}"
    if own:
        difference = "; ".join(rig_difference(rig, own))
        if _deviation(rig, own) <= 1:
            return "near", f"the weights serve this bench, with larger errors ({difference})"
        return "far", f"the weights may not serve this bench: they are another's ({difference})"

    beyond = beyond_trained(rig)
    if missing_wall(rig, load_rig("paper-rig")) > NEAR_WALL:
        beyond.append("its wall ends in the lidar's view")
    if lidar_visible_share(rig, object_box(rig)) > SEEN_BOX:
        beyond.append("the lidar sees into the object box")
    if beyond:
        outside = "; ".join(beyond)
        return "far", f"the weights may not serve this bench: it is beyond their rigs ({outside})"
    return "near", (
        "the weights serve this bench as one of the many that they know, with larger errors than"
        " weights of its own"
    )


def weights_for(rig: Rig) -> Path:
    """Return the folder of the shipped weights that serve a rig best; those for the paper's rig
    where none does.
    """
    folders = [shipped_folder(name) for name in RIG_WEIGHTS]
    if rig.occluder is None:  # how wide its gap is decides
        return folders[0]

    services = [weights_serve(rig, load_record(folder)).service for folder in folders]
    by_service = dict(zip(services, folders, strict=True))  # of two alike the last one
    # Of two rigs that a bench's maps can be aligned with, the one with the wider gap has weights
    # that are 0.06 to 0.15 of IoU better there, even if its lidar is the farther one
    # (tools/studies/serving.py).
    return next(by_service[service] for service in SERVICES if service in by_service)


def _deviation(rig: Rig, wanted: Rig) -> float:
    """Return the largest difference of two rigs, in units of the limits within which they are
    near; infinite where only one has an occluder.
    """
    if (rig.occluder is None) != (wanted.occluder is None):
        return float("inf")
    apart = differences_of(rig, wanted)
    return max(
        apart.distance_m / NEAR_M,
        apart.turned_deg / NEAR_DEG,
        apart.view_deg / NEAR_DEG,
        apart.occluder_m / NEAR_OCCLUDER_M,
        apart.box_m / NEAR_BOX_M,
        missing_wall(rig, wanted) / NEAR_WALL,
    )


class RigDifferences(NamedTuple):
    """Absolute differences of two rigs."""

    distance_m: float
    """Of the lidars from the wall."""
    turned_deg: float
    """The larger of yaw and pitch."""
    view_deg: float
    """The largest of the four edges of the lidars' views."""
    occluder_m: float
    """The larger of the occluders' edges and gaps; 0 where a rig has none."""
    box_m: float
    """The largest of the object boxes' sides, from the lidars' feet."""


def differences_of(rig: Rig, other: Rig) -> RigDifferences:
    """Return how far apart two rigs are."""
    here = rig.lidar
    there = other.lidar
    turned_deg = max(abs(here.yaw_deg - there.yaw_deg), abs(here.pitch_deg - there.pitch_deg))
    occluder_m = 0.0
    if rig.occluder and other.occluder:
        along_m = abs(rig.occluder.x_m - other.occluder.x_m)
        occluder_m = max(along_m, abs(rig.occluder.z_min_m - other.occluder.z_min_m))
    return RigDifferences(
        abs(here.distance_m - there.distance_m),
        turned_deg,
        view_difference_deg(rig.pinhole, other.pinhole),
        occluder_m,
        box_difference_m(rig, other),
    )
