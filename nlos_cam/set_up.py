"""From a bench and networks to what is made of frames, and in words what does not fit between the two."""

from pathlib import Path

from nlos_calibration.errors import RecordFileError
from nlos_calibration.rig import Rig, load_rig
from nlos_calibration.rig_difference import rig_difference
from nlos_models.checkpoint import CheckpointRecord
from nlos_models.doubt_inference import Doubter, load_doubter
from nlos_models.inference import Reconstructor, load_reconstructor

from nlos_cam.bench import Bench
from nlos_cam.cache import cache_folder
from nlos_cam.physics_check import Checks
from nlos_cam.processing import Processing

NO_DOUBT = "these weights have no doubt network (`train doubt`): no uncertainty is told, and no verdict"


def load_networks(weights: Path | None = None) -> Reconstructor:
    """The shipped weights, or a checkpoint folder's, exported once into the cache folder. Raises CheckpointError."""
    return load_reconstructor(weights, cache_folder() / "onnx")


def load_doubt(weights: Path | None = None) -> Doubter | None:
    """The doubt network beside the shipped weights, or a folder's; None where there is none."""
    return load_doubter(weights, cache_folder() / "onnx")


def set_up(
    bench: Bench,
    network: Reconstructor,
    average: int = 1,
    *,
    doubter: Doubter | None = None,
    checks: Checks | None = None,
) -> Processing:
    """What these networks make of frames of this bench: raw maps or difference maps, as the networks eat."""
    eats_difference = network.record.input == "difference maps"
    return Processing(bench, network, eats_difference=eats_difference, average=average, doubter=doubter, checks=checks)


def misfits(bench: Bench, trained: CheckpointRecord, doubter: Doubter | None) -> list[str]:
    """What a person should know of networks on this bench before believing them; empty where all fits."""
    return [*_of_rig(bench.rig, trained), *_of_reference(bench), *([] if doubter else [NO_DOUBT])]


def _of_rig(rig: Rig, trained: CheckpointRecord) -> list[str]:
    """How the bench differs from the one that the networks were trained for."""
    try:
        theirs = load_rig(trained.rig_name)
    except RecordFileError:  # trained for a rig of a file that is not here
        theirs = None
    if theirs is None or theirs.checksum != trained.rig_checksum:
        unlike = trained.rig_checksum != rig.checksum
        return [f"the networks were trained for another rig than {rig.name}: what they show is off"] if unlike else []
    difference = rig_difference(rig, theirs)
    return (
        [f"unlike the rig of the networks, this one has {'; '.join(difference)}: they err more"] if difference else []
    )


def _of_reference(bench: Bench) -> list[str]:
    if not bench.measured or bench.reference:
        return []
    told = "no difference maps are formed, and a lidar that moves is not noticed: calibrate the wall again"
    return [f"this wall's record has no reference: {told}"]
