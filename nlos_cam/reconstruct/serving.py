"""Verdict on weights for a bench: whether networks that were trained for one rig serve another."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from nlos_calibration import (
    TOLERANCE_DEG,
    TOLERANCE_M,
    Rig,
    box_difference_m,
    lidar_visible_share,
    load_rig,
    missing_wall,
    rig_difference,
    view_difference_deg,
)
from nlos_models import (
    BENCH_WEIGHTS,
    DIRECT,
    WIDE,
    CheckpointRecord,
    load_record,
    shipped_folder,
    shipped_name,
)

from nlos_cam.objects import object_box
from nlos_cam.reconstruct.alignment import (
    grid_refusal,
    own_rig,
    rig_to_align_with,
    training_rig,
)
from nlos_cam.reconstruct.wall_grid import (
    ALONG_RANGE_M,
    ASIDE_RANGE_M,
    OCCLUDER_RANGE_M,
    PITCH_RANGE_DEG,
    beyond_trained,
    grid_of,
    is_wall_grid,
)

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

HOME_IOU = {DIRECT: 0.790, WIDE: 0.852}
"""Silhouette IoU of the shipped weights for one rig, by their name, on that rig."""
GUESS_IOU = 0.3
"""Silhouette IoU of a guess: weights on a rig far from theirs are expected to do no better."""
_PAPERS_YAW_DEG = 45.0

Service = Literal["trained for it", "near", "far", "not"]


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
    present_iou: float | None = None
    """Silhouette IoU that these weights can be expected to reach on this bench; None where it is
    not known."""
    falls_short: bool = False
    """True for weights that were trained for this bench, and reached less than was forecast."""

    @property
    def is_warning(self) -> bool:
        """True if larger errors than the bench's own good weights make are to be expected."""
        return self.service != "trained for it" or self.falls_short

    @property
    def adapting_helps(self) -> bool:
        """True unless weights trained for this bench are expected to do no better than these."""
        if self.expected_iou is None or self.present_iou is None:
            return True
        return self.expected_iou > self.present_iou

    @property
    def serve(self) -> bool:
        """True if pictures are about as right as on the rig of the weights."""
        return self.service in {"trained for it", "near"}


def weights_serve(
    rig: Rig,
    trained: CheckpointRecord,
    *,
    expected_iou: float | None = None,
    present_iou: float | None = None,
    bench: str = "bench/",
) -> WeightsVerdict:
    """Return whether weights serve the rig of a bench, by its distance from their own rig.

    `expected_iou` is a forecast for weights trained for this rig, `present_iou` what these can be
    expected to reach (`shipped_iou`), and `bench` the folder to train others in.
    """
    # Weights on the wall grid hold a rig where training went on for it.
    wanted = own_rig(trained) if grid_of(trained) else training_rig(trained)
    if trained.rig_checksum == rig.checksum or (wanted and not rig_difference(rig, wanted)):
        sentence = "the weights serve this bench: they were trained for its rig"
        return WeightsVerdict("trained for it", sentence, expected_iou)

    advice = _advice(bench, expected_iou, present_iou)
    if grid_of(trained) and (wanted or not trained.rig):
        service, sentence = _grid_serves(rig, wanted)
        return WeightsVerdict(service, f"{sentence}; {advice}", expected_iou, present_iou)
    if wanted is None:
        sentence = (
            f"the networks were trained for another rig than {rig.name}: expect larger errors;"
            f" {advice}"
        )
        return WeightsVerdict("not", sentence, expected_iou)

    service, outcome = _aligned_serves(rig, trained, wanted)
    difference = "; ".join(rig_difference(rig, wanted))
    sentence = f"the weights {outcome} ({difference}); {advice}"
    return WeightsVerdict(service, sentence, expected_iou, present_iou)


def _advice(bench: str, expected_iou: float | None, present_iou: float | None) -> str:
    """Return what weights of a bench's own would bring, and the command that trains them where they
    are worth it.
    """
    advice = f"`nlos-cam adapt {bench}` trains weights for it"
    if expected_iou is None:
        return advice
    expected = f"expected silhouette IoU {expected_iou:.2f} after hours of training"
    if present_iou is None:
        return f"{advice} ({expected})"
    if expected_iou <= present_iou:
        advice = "weights of its own are not expected to do better"
    return f"{advice} ({expected}; those in use about {present_iou:.2f})"


def _aligned_serves(rig: Rig, trained: CheckpointRecord, own: Rig) -> tuple[Service, str]:
    """Return whether weights that were trained for one rig, `own`, serve another, and the predicate
    of the sentence that says so.
    """
    if not rig_to_align_with(rig, trained):
        return "not", "do not serve this bench: its maps cannot be aligned with their rig's"
    if _deviation(rig, own) <= 1:
        return "near", "serve this bench, aligned with their rig, with larger errors"
    return "far", (
        "may not serve this bench: it is far from their rig, with which its maps are aligned"
    )


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


class AlignedTerms(NamedTuple):
    """Differences of a rig from that of weights, which cost IoU although its maps are aligned."""

    farther_m: float
    """Distance from lidar to wall beyond that of the weights' rig; 0 for a nearer lidar."""
    nearer_m2: float
    """Distance from lidar to wall short of that of the weights' rig, squared: 2 cm cost little."""
    turned_deg: float
    """Absolute difference in yaw."""
    gap_m: float
    """Absolute difference in the occluder's gap."""


class AnyTerms(NamedTuple):
    """Numbers of a rig that decide how well weights for any rig do on it."""

    always: float
    """1, whose gain is the constant of the fit."""
    gap_m: float
    """Occluder's gap, at most ENOUGH_GAP_M."""
    flatter_deg: float
    """Yaw below the paper's 45 degrees; 0 for a larger one."""
    distance_m: float
    """Distance from lidar to wall."""


LOSSES = AlignedTerms(farther_m=2.035, nearer_m2=44.79, turned_deg=0.00372, gap_m=1.478)
"""Loss of silhouette IoU for a unit of each term; the fit of tools/studies/serving.py errs by 0.049
(root mean square)."""
ANY_GAINS = AnyTerms(always=0.4907, gap_m=2.181, flatter_deg=-0.00292, distance_m=-0.412)
"""Gain of silhouette IoU of the shipped weights for any rig, for a unit of each term; the fit of
the same study errs by 0.039."""
ENOUGH_GAP_M = 0.13
"""Gap beyond which a wider one does not help the weights for any rig."""


def aligned_terms(rig: Rig, own: Rig) -> AlignedTerms:
    """Return the differences of a rig from that of weights; both have an occluder."""
    farther_m = rig.lidar.distance_m - own.lidar.distance_m
    return AlignedTerms(
        max(farther_m, 0.0),
        min(farther_m, 0.0) ** 2,
        abs(rig.lidar.yaw_deg - own.lidar.yaw_deg),
        abs(_gap_m(rig) - _gap_m(own)),
    )


def any_terms(rig: Rig) -> AnyTerms:
    """Return the numbers of a rig that has an occluder."""
    flatter_deg = max(_PAPERS_YAW_DEG - rig.lidar.yaw_deg, 0.0)
    return AnyTerms(1.0, min(_gap_m(rig), ENOUGH_GAP_M), flatter_deg, rig.lidar.distance_m)


def _gap_m(rig: Rig) -> float:
    return rig.occluder.z_min_m if rig.occluder else 0.0


def weights_for(rig: Rig, names: Sequence[str] = BENCH_WEIGHTS) -> Path:
    """Return the folder of the shipped weights, of those named, that can be expected to serve a rig
    best; the first where none serves.
    """
    if rig.occluder is None:  # how wide its gap is decides
        return shipped_folder(names[0])

    def iou_or_guess(name: str) -> float:
        found = _shipped_iou(rig, name)
        return GUESS_IOU if found is None else found

    return shipped_folder(max(names, key=iou_or_guess))


def shipped_iou(rig: Rig, weights: Path) -> float | None:
    """Return the silhouette IoU that can be expected of a folder of shipped weights on a rig; None
    for other weights, for those of the paper's network, for a rig without an occluder, and where no
    figure is known.
    """
    name = shipped_name(weights)
    return _shipped_iou(rig, name) if name in BENCH_WEIGHTS and rig.occluder else None


def _shipped_iou(rig: Rig, name: str) -> float | None:
    """Return the silhouette IoU that can be expected of shipped weights on a rig with an occluder:
    0 where they do not serve it, None beyond the rigs that LOSSES or ANY_GAINS are fitted to.
    """
    trained = load_record(shipped_folder(name))
    service = weights_serve(rig, trained).service
    if service == "not":
        return 0.0
    own = training_rig(trained)
    if own is None or is_wall_grid(own):
        return float(np.dot(ANY_GAINS, any_terms(rig))) if service == "near" else None
    if not _costs_are_known(rig, own):
        return None
    lost = float(np.dot(LOSSES, aligned_terms(rig, own)))
    return max(HOME_IOU[name] - lost, GUESS_IOU)


def _costs_are_known(rig: Rig, own: Rig) -> bool:
    """Return whether a rig differs from that of weights in what LOSSES has terms for, and otherwise
    by no more than the rigs that it is fitted to.
    """
    here = object_box(rig)
    there = object_box(own)
    moved_m = here.x_min_m - there.x_min_m
    lowest_m, highest_m = ALONG_RANGE_M
    if not lowest_m - TOLERANCE_M <= moved_m <= highest_m + TOLERANCE_M:
        return False
    # The box and the occluder of a lidar that was put elsewhere along the wall move together.
    back = here.model_copy(
        update={"x_min_m": here.x_min_m - moved_m, "x_max_m": here.x_max_m - moved_m}
    )
    box_m = max(
        abs(getattr(back, name) - getattr(there, name)) for name in type(there).model_fields
    )
    occluder_m = 0.0
    if rig.occluder and own.occluder:
        occluder_m = abs(rig.occluder.x_m - moved_m - own.occluder.x_m)
    return (
        abs(rig.lidar.pitch_deg - own.lidar.pitch_deg) <= PITCH_RANGE_DEG[1] + TOLERANCE_DEG
        and box_m <= ASIDE_RANGE_M[1] + TOLERANCE_M
        and occluder_m <= OCCLUDER_RANGE_M[1] + TOLERANCE_M
        and view_difference_deg(rig.pinhole, own.pinhole) <= NEAR_DEG
        and missing_wall(rig, own) <= NEAR_WALL
    )


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
