"""What is made of each frame of a camera: maps, their difference from the bare wall, warnings, the hidden depth.

From a bench and networks to what is made of frames, and in words what does not fit between the two.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from nlos_calibration import Rig, load_rig, rig_difference
from nlos_calibration.errors import CalibrationError, RecordFileError
from nlos_models import CheckpointRecord, Reconstructor, UncertaintyModel, load_reconstructor, load_uncertainty_model

from nlos_cam.files import cache_folder
from nlos_cam.frames import Frame, LidarMaps, MapMean, maps_from_frame
from nlos_cam.reconstruct.bench import BenchObservation, CalibratedRig
from nlos_cam.reconstruct.network import Clock, Network, Reconstruction, reconstruct_all
from nlos_cam.reconstruct.physics_check import UNEXPLAINED, NullPhysicsCheck, PhysicsCheck, PhysicsCheckResult
from nlos_cam.reconstruct.verdict import FrameConditions, Verdict, VerdictFilter, VerdictLimits, frame_issues


@dataclass(frozen=True)
class Arrival:
    """A frame, and when the reader had it."""

    frame: Frame
    arrived_s: float


@dataclass(frozen=True)
class FrameResult:
    """One frame's way through the loop."""

    frame: Frame
    maps: LidarMaps
    reconstruction: Reconstruction
    published_s: float
    stages_s: Mapping[str, float]
    difference: LidarMaps | None = None
    """The maps less the bare wall's; None without a reference."""
    warnings: tuple[str, ...] = ()
    verdict: Verdict | None = None
    """None from networks that do not tell."""
    check: PhysicsCheckResult | None = None
    """The newest physics check, of this frame or an earlier one."""
    arrived_s: float | None = None
    """When the loop's reader had the frame."""


@dataclass(frozen=True)
class PreparedFrame:
    """A frame, and what the networks eat of it."""

    arrival: Arrival
    maps: LidarMaps
    look: BenchObservation
    corrected: LidarMaps
    """Raw maps with the range that the lidar is known to lack added."""
    eaten: LidarMaps
    stages_s: Mapping[str, float]


class Pipeline:
    """What is made of a camera's frames, in their order: maps, their difference from the bare wall, the hidden depth.

    Maps are the mean over the last `average` frames. With a doubt network each reconstruction has an uncertainty and a
    verdict, and shows nothing where nothing is hidden. The newest of the `checks`, which whoever goes over the frames
    enters, goes along with each. Raises CalibrationError where the networks eat difference maps and there is no bare
    wall to form them from.
    """

    def __init__(
        self,
        bench: CalibratedRig,
        network: Network,
        *,
        eats_difference: bool = False,
        average: int = 1,
        doubter: UncertaintyModel | None = None,
        checks: PhysicsCheck | None = None,
    ) -> None:
        if eats_difference and bench.reference is None:
            raise CalibrationError(
                "these weights eat difference maps: give --wall with a reference (calibrate the wall again)"
            )
        self.bench, self.network, self.doubter = bench, network, doubter
        self._judge = VerdictFilter(limits_of(doubter) if doubter else None)
        self.checks = checks or NullPhysicsCheck()
        self._eats_difference, self._mean = eats_difference, MapMean(average)

    def step(self, arrival: Arrival, clock: Clock, start_s: float) -> FrameResult:
        """All of it, for one frame that is waited for since `start_s`."""
        seen = self.see(arrival, clock, start_s)
        (made,) = self.reconstruct([seen], clock)
        return self.finish(seen, made, clock)

    def see(self, arrival: Arrival, clock: Clock, start_s: float) -> PreparedFrame:
        """What the lidar saw, up to what the networks eat; frames in their order."""
        got_s = clock()
        maps = maps_from_frame(arrival.frame)
        mapped_s = clock()
        maps = self._mean.add(maps)
        look = self.bench.look(arrival.frame, maps)
        looked_s = clock()
        stages_s = {"wait": got_s - start_s, "queue": got_s - arrival.arrived_s}
        stages_s |= {"maps": mapped_s - got_s, "bench": looked_s - mapped_s}
        corrected = self.bench.corrected(maps)
        eaten = look.difference if self._eats_difference and look.difference else corrected
        return PreparedFrame(arrival, maps, look, corrected, eaten, stages_s)

    def reconstruct(self, several: Sequence[PreparedFrame], clock: Clock) -> list[Reconstruction]:
        """What the networks make of each, and of no other frame: what it takes does not change, nor is it changed."""
        eaten = [seen.eaten for seen in several]
        return reconstruct_all(eaten, self.bench.rig, self.network, clock, self.doubter)

    def finish(self, seen: PreparedFrame, made: Reconstruction, clock: Clock) -> FrameResult:
        """What is shown of it, and what is said; frames in their order."""
        frame, look = seen.arrival.frame, seen.look
        shown, verdict = self._judge.look(made, signs_of(frame, look, self.checks.newest))
        self.checks.offer(frame.frame_number, seen.corrected, shown.depth_m)
        stages_s = {**seen.stages_s, **made.timings_s}
        told = shown, clock(), stages_s, look.difference, look.warnings, verdict
        return FrameResult(frame, seen.maps, *told, check=self.checks.newest, arrived_s=seen.arrival.arrived_s)


def limits_of(doubter: UncertaintyModel) -> VerdictLimits:
    """The limits that a doubt network was calibrated with."""
    return VerdictLimits(doubter.record.nothing_above, doubter.record.outside_above, UNEXPLAINED)


def signs_of(frame: Frame, look: BenchObservation, check: PhysicsCheckResult | None) -> FrameConditions:
    """What is amiss with a frame itself, with its bench, and with what was made of the last frame that was checked."""
    names = frame_issues(frame)
    invalid = "blank" in names or "half_invalid" in names
    return FrameConditions("saturated" in names, invalid, look.moved, check)


NO_DOUBT = "these weights have no doubt network (`train doubt`): no uncertainty is told, and no verdict"


def load_networks(weights: Path | None = None) -> Reconstructor:
    """The shipped weights, or a checkpoint folder's, exported once into the cache folder. Raises CheckpointError."""
    return load_reconstructor(weights, cache_folder() / "onnx")


def load_doubt(weights: Path | None = None) -> UncertaintyModel | None:
    """The doubt network beside the shipped weights, or a folder's; None where there is none."""
    return load_uncertainty_model(weights, cache_folder() / "onnx")


def set_up(
    bench: CalibratedRig,
    network: Reconstructor,
    average: int = 1,
    *,
    doubter: UncertaintyModel | None = None,
    checks: PhysicsCheck | None = None,
) -> Pipeline:
    """What these networks make of frames of this bench: raw maps or difference maps, as the networks eat."""
    eats_difference = network.record.input == "difference maps"
    return Pipeline(bench, network, eats_difference=eats_difference, average=average, doubter=doubter, checks=checks)


def misfits(bench: CalibratedRig, trained: CheckpointRecord, doubter: UncertaintyModel | None) -> list[str]:
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


def _of_reference(bench: CalibratedRig) -> list[str]:
    if not bench.measured or bench.reference:
        return []
    told = "no difference maps are formed, and a lidar that moves is not noticed: calibrate the wall again"
    return [f"this wall's record has no reference: {told}"]
