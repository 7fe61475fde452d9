"""Per-frame reconstruction pipeline: maps, difference maps, hidden depth, verdict.

Built from a rig and networks, whose mismatches it lists.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32
from nlos_calibration.errors import CalibrationError
from nlos_models import (
    CheckpointRecord,
    Reconstructor,
    UncertaintyModel,
    load_reconstructor,
    load_uncertainty_model,
)

from nlos_cam.files import cache_folder
from nlos_cam.frames import Frame, LidarMaps, MapMean, maps_from_frame
from nlos_cam.objects import MAX_UNCERTAINTY_M, SurfaceMesh
from nlos_cam.reconstruct.alignment import MapAlignment, alignment, check_alignable
from nlos_cam.reconstruct.bench import BenchObservation, CalibratedRig
from nlos_cam.reconstruct.consistency import COMPLETE, MapConsistency, MapFindings
from nlos_cam.reconstruct.frame_reader import Arrival
from nlos_cam.reconstruct.network import (
    Clock,
    Network,
    Quality,
    Reconstruction,
    reconstruct_all,
)
from nlos_cam.reconstruct.own_maps import OwnMaps
from nlos_cam.reconstruct.physics_check import (
    UNEXPLAINED,
    UNEXPLAINED_EMPTY,
    NullPhysicsCheck,
    PhysicsCheck,
    PhysicsCheckResult,
)
from nlos_cam.reconstruct.serving import WeightsVerdict, weights_serve
from nlos_cam.reconstruct.verdict import (
    FrameConditions,
    FrozenFrames,
    Verdict,
    VerdictFilter,
    VerdictLimits,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CHECK_HOLDS_FRAMES = 150
"""Frames (5 s) for which a physics check counts: it runs once a second, longer on a busy machine."""
TRUSTED_MISSING = 0.02
"""Share of cells without a depth from which on no frame is trusted: what the quality model was
fitted to had none."""
MAX_AVERAGE = 1000
"""Largest number of frames that maps are the mean of: half a minute."""
FROZEN = "the camera repeats the same frame: unplug it and plug it in again"
EDGE_IS_OFF = (
    "the occluder's edge is not where the record has it, and its cells are repaired: if this stays,"
    " measure wall and occluder again"
)


@dataclass(frozen=True, repr=False)
class FrameResult:
    """Result of one frame: the hidden surface with its uncertainty and verdict."""

    frame: Frame
    """The frame itself, in SI units."""
    maps: LidarMaps
    """Lidar maps of (64, 80) cells: of this frame, or the mean over several."""
    reconstruction: Reconstruction
    """Hidden surface with its pose, its box and the networks' timings."""
    published_s: float
    """Time at which the result was ready, by the loop's clock."""
    stages_s: Mapping[str, float]
    """Seconds by stage."""
    difference: LidarMaps | None = None
    """Maps less those of the bare wall; None without a wall record that has a reference."""
    warnings: tuple[str, ...] = ()
    """Warnings that hold now, such as that the lidar has moved."""
    verdict: Verdict | None = None
    """Reliability of the reconstruction, such as "object seen"; None without an uncertainty model,
    unless the lidar moved or is saturated.
    """
    check: PhysicsCheckResult | None = None
    """Newest physics check, of this frame or one shortly before; None until there is one, and where
    the newest is old.
    """
    arrived_s: float | None = None
    """Time at which the reader received the frame."""

    @property
    def depth_m(self) -> Float32:
        """(64, 64) over the box: distance from the wall, NaN where there is no surface.

        Column j grows with wall x (away from the lidar's foot), row i with wall -y (row 0 is the
        top).
        """
        return self.reconstruction.depth_m

    @property
    def uncertainty_m(self) -> Float32 | None:
        """(64, 64): expected absolute error of `depth_m`; None without an uncertainty model."""
        return self.reconstruction.uncertainty_m

    @property
    def points_m(self) -> Float32:
        """(n, 3): points of the hidden surface in the wall frame, x along the wall, y up, z into
        the room.
        """
        return self.reconstruction.points_m

    @property
    def quality(self) -> Quality | None:
        """Predicted quality: outline (IoU) and depth error; None without a surface or a quality
        model.
        """
        return self.reconstruction.quality

    def __repr__(self) -> str:
        words = [f"frame {self.frame_number}", str(self.verdict or "no verdict")]
        if self.reconstruction.has_surface:
            seen_cm = 100 * self.depth_m[np.isfinite(self.depth_m)]
            words.append(f"{seen_cm.size} pixels, {seen_cm.min():.1f} to {seen_cm.max():.1f} cm")
        if self.quality:
            words.append(f"outline typically {self.quality.iou[1]:.0%} right")
        return f"<FrameResult: {', '.join(words)}>"

    def plot(self) -> "Figure":
        """Return a figure of hidden depth in cm and its uncertainty in mm, over wall coordinates in
        cm, in the colors of the page.
        """
        return plot_result(self)

    def to_mesh(self) -> SurfaceMesh:
        """Return the hidden surface as a mesh in the wall frame; its `save` writes .ply, .glb,
        .obj, .csv or .npz.
        """
        return self.reconstruction.to_mesh()

    @property
    def timestamp_s(self) -> float:
        """Time of the frame by the camera's clock."""
        return self.frame.timestamp_s

    @property
    def frame_number(self) -> int:
        """Number of the frame, counted by the camera."""
        return self.frame.frame_number

    @property
    def truth_depth_m(self) -> Float32 | None:
        """Ground truth of `depth_m` from a simulated camera; else None."""
        return self.frame.truth_depth_m


def plot_result(result: FrameResult) -> "Figure":
    """Draw a result; see `FrameResult.plot`."""
    from nlos_cam.report import figure_of

    box = result.reconstruction.box
    sides_m = box.x_min_m, box.x_max_m, box.y_min_m, box.y_max_m
    extent_cm = tuple(100 * side_m for side_m in sides_m)
    near_cm, far_cm = 100 * box.z_near_m, 100 * box.z_far_m
    maps = [("distance from the wall (cm)", 100 * result.depth_m, "inferno_r", near_cm, far_cm)]
    if result.uncertainty_m is not None:
        shown_mm = np.where(np.isnan(result.depth_m), np.nan, 1e3 * result.uncertainty_m)
        maps.append(("uncertainty (mm)", shown_mm, "viridis", 0.0, 1e3 * MAX_UNCERTAINTY_M))

    figure = figure_of(4.2 * len(maps), 3.6)
    axes = figure.subplots(1, len(maps), squeeze=False)[0]
    for axis, (name, values, colors, low, high) in zip(axes, maps, strict=True):
        drawn = axis.imshow(values, cmap=colors, vmin=low, vmax=high, extent=extent_cm)
        axis.set(xlabel="wall x (cm)", ylabel="wall y (cm)")
        figure.colorbar(drawn, ax=axis, label=name)
    figure.suptitle(f"frame {result.frame_number}: {result.verdict or 'no verdict'}")
    return figure


class PreparedBench(NamedTuple):
    """Bench with what is computed from it once."""

    bench: CalibratedRig
    aligned: MapAlignment | None
    own: OwnMaps
    consistency: MapConsistency | None
    """None without an uncertainty model: then no verdict depends on it."""


@dataclass(frozen=True)
class PreparedFrame:
    """Frame with the maps that go into the networks."""

    arrival: Arrival
    rig: Rig
    """Rig of the bench that the maps were prepared for."""
    maps: LidarMaps
    observation: BenchObservation
    checked: LidarMaps
    """Maps for the physics check: as the renderer would give them, of a uniform wall."""
    network_input: LidarMaps
    edge_is_repaired: bool
    findings: MapFindings
    frozen: bool
    stages_s: Mapping[str, float]


class Pipeline:
    """Per-frame reconstruction: frame -> maps -> difference maps -> networks -> uncertainty ->
    verdict.

    Maps are the mean of the last `average` frames; those of a bench other than the rig that
    networks were `trained` for are aligned with it. An uncertainty model adds expected errors and a
    verdict, and removes the surface where nothing is hidden. Stateful (running mean, drift,
    smoothed verdict): give `prepare` and `finish` the frames in order, from one thread;
    `reconstruct` keeps no state. The caller enters `checks`. Raises CalibrationError if the
    networks need difference maps and the bench has no reference.
    """

    def __init__(
        self,
        bench: CalibratedRig,
        network: Network,
        *,
        uses_difference: bool = False,
        average: int = 1,
        uncertainty_model: UncertaintyModel | None = None,
        checks: PhysicsCheck | None = None,
        trained: CheckpointRecord | None = None,
        weights: str = "",
    ) -> None:
        if uses_difference and bench.reference is None:
            raise CalibrationError(
                "these weights expect difference maps: give --wall with a reference (calibrate the"
                " wall again)"
            )
        self.network = network
        self.uncertainty_model = uncertainty_model
        self.trained = trained
        """Record of the networks' training; None where it is not known."""
        self.weights = weights
        """Name and checksum of the networks' weights, for reports; empty where they are not known."""
        self.checks = checks or NullPhysicsCheck()
        self._verdicts = VerdictFilter(
            verdict_limits(uncertainty_model) if uncertainty_model else None
        )
        self._frozen = FrozenFrames()
        self._uses_difference = uses_difference
        self.average = average
        self.bench = bench

    @property
    def bench(self) -> CalibratedRig:
        """Bench of the frames; setting it aligns their maps with the training rig again, and has
        the physics check compare with its rig. Any thread may set it. Raises SceneError as
        `check_alignable`.
        """
        return self._bench.bench

    @bench.setter
    def bench(self, bench: CalibratedRig) -> None:
        aligned = None
        if self.trained:
            check_alignable(bench.rig, self.trained)
            aligned = alignment(bench.rig, self.trained, bench.reference, bench.range_offset_m)
        consistency = MapConsistency(bench) if self.uncertainty_model else None
        # in one assignment: `prepare` must not see half of it
        self._bench = PreparedBench(bench, aligned, OwnMaps(bench), consistency)
        # After it: a frame of this bench that is still compared with the old rig is forgotten, one
        # of the old bench that is compared with this rig would not be.
        self.checks.use_rig(bench.rig)

    @property
    def average(self) -> int:
        """Frames whose maps are averaged; setting it begins a new mean. Any thread may set it."""
        return self._average

    @average.setter
    def average(self, frames: int) -> None:
        self._average = frames
        self.begin_mean()

    def begin_mean(self) -> None:
        """Average from the next frame on: those before are of another scene or setting."""
        self._mean = MapMean(self._average)

    def process(self, arrival: Arrival, clock: Clock, start_s: float) -> FrameResult:
        """Return the result of one frame; `start_s` is when the loop began to wait for it."""
        prepared = self.prepare(arrival, clock, start_s)
        (reconstruction,) = self.reconstruct([prepared], clock)
        return self.finish(prepared, reconstruction, clock)

    def prepare(self, arrival: Arrival, clock: Clock, start_s: float) -> PreparedFrame:
        """Return the maps of a frame as the networks need them; call in frame order."""
        taken_s = clock()
        # another thread may replace it
        bench, aligned, own, consistency = self._bench
        maps = maps_from_frame(arrival.frame)
        mapped_s = clock()

        # Drift is watched in the frame, not in the mean, which would hide a move for its length.
        maps = self._mean.add(maps)
        observation = bench.observe(arrival.frame, maps)
        difference = observation.difference
        corrected = own.steps(maps, observation.drift_m)
        if aligned:
            network_input = aligned.align(corrected.repaired)
        elif self._uses_difference and difference:
            network_input = difference
        else:
            network_input = corrected.exact
        findings = consistency.examine(corrected.ranged) if consistency else COMPLETE
        frozen = self._frozen.add(arrival.frame)
        observed_s = clock()

        stages_s = {
            "wait": taken_s - start_s,
            "queue": taken_s - arrival.arrived_s,
            "maps": mapped_s - taken_s,
            "bench": observed_s - mapped_s,
        }
        return PreparedFrame(
            arrival=arrival,
            rig=bench.rig,
            maps=maps,
            observation=observation,
            checked=own.as_rendered(corrected.exact),
            network_input=network_input,
            edge_is_repaired=corrected.edge_is_repaired,
            findings=findings,
            frozen=frozen,
            stages_s=stages_s,
        )

    def reconstruct(self, frames: Sequence[PreparedFrame], clock: Clock) -> list[Reconstruction]:
        """Return the reconstruction of each frame, all of one bench; reads and changes no state, so
        any thread may call it.
        """
        maps = [frame.network_input for frame in frames]
        return reconstruct_all(maps, frames[0].rig, self.network, clock, self.uncertainty_model)

    def finish(
        self, prepared: PreparedFrame, reconstruction: Reconstruction, clock: Clock
    ) -> FrameResult:
        """Offer a frame to the physics check, and return its result with the verdict; call in frame
        order.
        """
        frame, arrived_s, _ = prepared.arrival
        observation = prepared.observation
        # The check renders a uniform wall as an exact lidar sees it, and gets maps corrected to
        # that: else ripples of the lidar and texture of the wall would look like an object. It
        # knows the newest bench alone, which another thread may have set since `prepare`.
        if prepared.rig is self.bench.rig:
            hidden_m = self._verdicts.shown(reconstruction).depth_m
            self.checks.offer(frame.frame_number, prepared.checked, hidden_m)
        # Read after the offer: a check in this thread has judged this very frame.
        newest = self.checks.newest
        conditions = frame_conditions(prepared, newest)
        judged = with_quality_of_maps(reconstruction, conditions)
        shown, verdict = self._verdicts.decide(judged, conditions)
        warnings = observation.warnings
        if prepared.edge_is_repaired:
            warnings = (*warnings, EDGE_IS_OFF)
        if shown.uncertainty:
            warnings += problems_of(conditions)

        return FrameResult(
            frame,
            prepared.maps,
            shown,
            published_s=clock(),
            stages_s={**prepared.stages_s, **reconstruction.timings_s},
            difference=observation.difference,
            warnings=warnings,
            verdict=verdict,
            check=conditions.check,
            arrived_s=arrived_s,
        )


def verdict_limits(uncertainty_model: UncertaintyModel) -> VerdictLimits:
    """Return the probabilities and the physics-check score above which verdicts change."""
    record = uncertainty_model.record
    return VerdictLimits(record.nothing_above, record.outside_above, UNEXPLAINED, UNEXPLAINED_EMPTY)


def frame_conditions(prepared: PreparedFrame, newest: PhysicsCheckResult | None) -> FrameConditions:
    """Return what affects a frame's verdict, from its issues (`frame_issues`), its maps, the bench,
    and the newest physics check, if that is recent.
    """
    frame, _, issues = prepared.arrival
    # A device that starts again counts its frames from 0.
    recent = (
        newest is not None and 0 <= frame.frame_number - newest.frame_number <= CHECK_HOLDS_FRAMES
    )
    return FrameConditions(
        saturated="saturated" in issues,
        invalid="blank" in issues or "half_invalid" in issues,
        moved=prepared.observation.moved,
        frozen=prepared.frozen,
        findings=prepared.findings,
        check=newest if recent else None,
    )


def with_quality_of_maps(
    reconstruction: Reconstruction, conditions: FrameConditions
) -> Reconstruction:
    """Return a reconstruction whose predicted quality knows what its maps lack."""
    findings = conditions.findings
    quality = reconstruction.quality
    if quality is None or (findings.missing_share == 0 and not conditions.contradicted):
        return reconstruction
    trusted = not conditions.contradicted and findings.missing_share < TRUSTED_MISSING
    return reconstruction.with_quality(
        quality.of_incomplete_maps(findings.kept_share, trusted=trusted)
    )


def problems_of(conditions: FrameConditions) -> tuple[str, ...]:
    """Return what is wrong with a frame's maps, for the user."""
    problems = tuple(str(problem) for problem in conditions.findings.problems)
    return (*problems, FROZEN) if conditions.frozen else problems


def load_networks(weights: Path | None = None) -> Reconstructor:
    """Load the shipped networks, or those of a folder, exported to the cache once. Raises
    CheckpointError.
    """
    return load_reconstructor(weights, cache_folder() / "onnx")


def load_uncertainty(weights: Path | None = None) -> UncertaintyModel | None:
    """Load the uncertainty model beside the shipped weights, or of a folder; None
    without one.
    """
    return load_uncertainty_model(weights, cache_folder() / "onnx")


def build_pipeline(
    bench: CalibratedRig,
    network: Reconstructor,
    average: int = 1,
    *,
    uncertainty_model: UncertaintyModel | None = None,
    checks: PhysicsCheck | None = None,
    weights: str = "",
) -> Pipeline:
    """Build a pipeline with raw or difference maps, depending on the networks' input."""
    return Pipeline(
        bench,
        network,
        uses_difference=network.record.input == "difference maps",
        average=average,
        uncertainty_model=uncertainty_model,
        checks=checks,
        trained=network.record,
        weights=weights,
    )


def compatibility_warnings(
    bench: CalibratedRig,
    trained: CheckpointRecord,
    uncertainty_model: UncertaintyModel | None,
    served: WeightsVerdict | None = None,
) -> list[str]:
    """Return the mismatches between networks and bench, one sentence each; empty if all fits.

    `served` is the verdict of `weights_serve`, for callers that have more to say in it.
    """
    served = served or weights_serve(bench.rig, trained)
    warnings = [served.sentence] if served.is_warning else []
    if bench.measured and not bench.reference:
        warnings.append(
            "this wall record has no reference: no difference maps, and a moved lidar goes"
            " unnoticed; calibrate the wall again"
        )
    if not uncertainty_model:
        warnings.append(
            "these weights have no uncertainty model (`train doubt`): no uncertainty and no verdict"
        )
    return warnings
