"""Weights that serve a bench, and the verdict on them: a bench folder knows its forecast and what
its own weights reached.
"""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from nlos_calibration import Rig
from nlos_models import CheckpointRecord, Reconstructor, UncertaintyModel

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
    verdict = weights_verdict(calibrated.rig, network.record, bench, record)
    mismatches = reconstruct.compatibility_warnings(
        calibrated, network.record, uncertainty_model, verdict
    )
    return ServingNetworks(network, uncertainty_model, verdict, tuple(mismatches))


def weights_verdict(
    rig: Rig, trained: CheckpointRecord, bench: Bench | None, record: Path | None = None
) -> WeightsVerdict:
    """Return whether weights serve a rig, for the user, with the bench folder to train others in
    (or the wall record, where there is none) and what to expect of them.
    """
    if bench is None:
        place = shlex.quote(str(record or "bench/"))
        return weights_serve(rig, trained, bench=place)
    folder = shlex.quote(str(bench.folder))
    expected_iou = bench.expected_iou
    served = weights_serve(rig, trained, expected_iou=expected_iou, bench=folder)
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
