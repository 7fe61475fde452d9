"""Weights that serve a bench, and the verdict on them: a bench folder knows its forecast and what
its own weights reached.
"""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from nlos_calibration import Rig
from nlos_models import (
    CheckpointRecord,
    Reconstructor,
    UncertaintyModel,
    checksum_of_watched,
    load_record,
    shipped_name,
    weights_folder,
)

from nlos_cam import reconstruct
from nlos_cam.bench.edit import TEST_IOU
from nlos_cam.bench.folder import Bench
from nlos_cam.forecast import SCATTER_IOU
from nlos_cam.reconstruct import CalibratedRig, WeightsVerdict, weights_serve


class ServingNetworks(NamedTuple):
    """Networks for a bench, and how well they serve it."""

    network: Reconstructor
    uncertainty_model: UncertaintyModel | None
    verdict: WeightsVerdict
    mismatches: tuple[str, ...]
    """Sentences on what the bench and the weights disagree in: expect larger errors."""
    weights: str
    """Name of shipped weights, else their folder, with the checksum of the networks."""


def load_serving(
    calibrated: CalibratedRig,
    weights: Path | None,
    bench: Bench | None,
    record: Path | None = None,
) -> ServingNetworks:
    """Load weights for a bench, or the shipped ones that serve its rig best, with the verdict on
    them; `bench` and the wall `record` are as for `weights_verdict`. Raises CheckpointError.
    """
    folder = weights or reconstruct.weights_for(calibrated.rig)
    network = reconstruct.load_networks(folder)
    uncertainty_model = reconstruct.load_uncertainty(folder)
    verdict = weights_verdict(calibrated.rig, folder, bench, record, trained=network.record)
    mismatches = reconstruct.compatibility_warnings(
        calibrated, network.record, uncertainty_model, verdict
    )
    return ServingNetworks(
        network, uncertainty_model, verdict, tuple(mismatches), _weights_in_words(folder)
    )


def _weights_in_words(weights: Path) -> str:
    """Return what a reader needs to find weights again, such as "direct 89ce399040ef"."""
    return f"{shipped_name(weights) or weights} {checksum_of_watched(weights_folder(weights))}"


def weights_verdict(
    rig: Rig,
    weights: Path,
    bench: Bench | None,
    record: Path | None = None,
    *,
    trained: CheckpointRecord | None = None,
) -> WeightsVerdict:
    """Return whether a folder of weights serves a rig, for the user, with the bench folder to train
    others in (or the wall record, where there is none) and what to expect of both.

    `trained` is the weights' record, where it was read before. Raises CheckpointError.
    """
    trained = trained or load_record(weights)
    if bench is None:
        place = shlex.quote(str(record or "bench/"))
        return weights_serve(rig, trained, bench=place)
    folder = shlex.quote(str(bench.folder))
    expected_iou = bench.expected_iou
    served = weights_serve(
        rig,
        trained,
        expected_iou=expected_iou,
        present_iou=reconstruct.shipped_iou(rig, weights),
        bench=folder,
    )
    if bench.has_old_forecast:
        old = (
            f"{served.sentence} (the forecast is of another object box or an earlier version:"
            f" `nlos-cam predict {folder}` makes it again)"
        )
        served = replace(served, sentence=old)
    if bench.hidden_share > 0:
        hidden = (
            f"{served.sentence}; {bench.hidden_share:.0%} of the test objects change no cell of this"
            ' bench\'s maps: they are "nothing there" (what to change: `nlos-cam predict'
            f" {folder}`)"
        )
        served = replace(served, sentence=hidden)

    reached_iou = trained.figures.get(TEST_IOU)
    if served.service != "trained for it" or reached_iou is None:
        return served
    sentence = f"{served.sentence} (silhouette IoU {reached_iou:.2f} on the test objects"

    # weights of few minutes are the bench's own, and may still be poor
    falls_short = expected_iou is not None and reached_iou < expected_iou - SCATTER_IOU
    if falls_short:
        sentence += (
            f", where {expected_iou:.2f} is expected: more --minutes of `nlos-cam adapt {folder}`"
        )
    return replace(served, sentence=f"{sentence})", falls_short=falls_short)
