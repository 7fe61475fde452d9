import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import date
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_wall import SERIAL, WallCamera, write_sidecar
from nlos_calibration import WayUp
from nlos_calibration.errors import CalibrationError, OccluderRefusedError, WallRefusedError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.reference import BareWall, BareWallStatistics
from nlos_calibration.rig import LidarPose, Occluder, Rig, load_rig
from nlos_calibration.wall import wall_depth
from nlos_calibration.wall_record import MeasuredWall, new_wall_record

from nlos_cam.calibrate import measure
from nlos_cam.calibrate.measure import (
    CaptureStatistics,
    collect_statistics,
    fit_frame,
    measure_occluder,
)
from nlos_cam.frames import Frame, maps_from_frame
from nlos_cam.recording.sidecar import Temperatures
from nlos_cam.render.geometry import cast

RIG = load_rig("bare-wall")
BENCH = load_rig("paper-rig")
INTRINSICS = RIG.pinhole.scaled(160, 120)
ALL = np.ones((64, 80), np.bool_)
TWO_SECONDS = 61
"""Frames, the first and the last one two seconds apart."""


class Warming(WallCamera):
    """Its temperature rises by a degree with each reading."""

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        self._celsius += 1.0
        return super().telemetry(ending)


@pytest.fixture(scope="module")
def twenty() -> BareWall:
    return collect_statistics(Warming(20), 1000).reference(ALL)


def test_reference_is_the_mean_of_all_frames(twenty: BareWall) -> None:
    depths_m = [frame.depth_m.astype(np.float64) for frame in Warming(20)]
    np.testing.assert_allclose(twenty.depth_m, np.mean(depths_m, axis=0), rtol=1e-6)


def test_reference_maps_are_the_means_of_the_frames_maps(twenty: BareWall) -> None:
    maps = [maps_from_frame(frame) for frame in Warming(20)]
    depth_m = np.mean([each.depth_m for each in maps], axis=0)
    counts = [np.where(each.valid, each.intensity, np.nan) for each in maps]

    np.testing.assert_allclose(twenty.map_depth_m, depth_m, rtol=1e-6)
    np.testing.assert_allclose(twenty.map_intensity, np.mean(counts, axis=0), rtol=1e-6)


def test_reference_names_the_device(twenty: BareWall) -> None:
    assert twenty.frames == 20
    assert twenty.serial == SERIAL
    assert twenty.settings == {"laser_power": 40.0}


def test_collect_statistics_stops_at_the_number_of_frames() -> None:
    assert collect_statistics(Warming(10), 4).statistics.depth.frames == 4


def test_collect_statistics_refuses_a_camera_without_frames() -> None:
    with pytest.raises(WallRefusedError, match="fake"):
        collect_statistics(Warming(0), 1000)


def test_statistics_read_temperatures_now_and_then() -> None:
    capture = collect_statistics(Warming(TWO_SECONDS, celsius=30.0), 1000)

    assert capture.facts()["temperatures_c"] == {"ldd_temperature": 32.0}
    assert capture.reference(ALL).celsius_span == {"ldd_temperature": 2.0}


class Mad(WallCamera):
    """Its thermometer shows no temperature at first."""

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        celsius = super().telemetry(ending)
        return celsius if self.asked > 1 else dict.fromkeys(celsius, self._celsius_at_first)

    _celsius_at_first = float("nan")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -9999.0])
def test_statistics_leave_out_what_is_no_temperature(value: float) -> None:
    camera = Mad(TWO_SECONDS, celsius=30.0)
    camera._celsius_at_first = value
    capture = collect_statistics(camera, 1000)

    assert capture.facts()["temperatures_c"] == {"ldd_temperature": 30.0}
    assert capture.reference(ALL).celsius_span == {"ldd_temperature": 0.0}


def test_recording_has_the_temperatures_of_its_sidecar(tmp_path: Path) -> None:
    series = [Temperatures(time_s=t_s, celsius={"ldd_temperature": 40.0 + t_s}) for t_s in (0, 1)]
    bag = tmp_path / "wall.bag"
    write_sidecar(bag, temperatures=series)
    camera = WallCamera(TWO_SECONDS, celsius=99.0)
    camera.uri = f"bag:{bag}"

    capture = collect_statistics(camera, 1000)

    assert capture.reference(ALL).celsius_span == {"ldd_temperature": 1.0}


@pytest.mark.parametrize("wanted", [60, 1000])
@pytest.mark.parametrize("moved", [range(30), range(45, 60)])
def test_a_lidar_that_moved_while_it_measured_is_refused(moved: range, wanted: int) -> None:
    capture = collect_statistics(WallCamera(60, moved), wanted)

    with pytest.raises(WallRefusedError, match="let it stand still"):
        measure.measure_by_depth(capture)
    measure.measure_by_depth(collect_statistics(WallCamera(60), 60))


class TooShort(WallCamera):
    """Its depths are so short that no part of the capture is a bare wall by itself."""

    def __iter__(self) -> Iterator[Frame]:
        for frame in super().__iter__():
            yield replace(frame, depth_m=frame.depth_m - np.float32(0.022))


def test_bump_is_found_also_where_a_tape_tells_of_an_offset() -> None:
    still = collect_statistics(TooShort(60), 60)
    bumped = collect_statistics(TooShort(60, range(30)), 60)

    with pytest.raises(WallRefusedError):
        measure.measure_by_depth(still)
    assert measure.measure_by_depth(still, 0.2)[1]["range_offset_cause"] == "depth"
    with pytest.raises(WallRefusedError, match="let it stand still"):
        measure.measure_by_depth(bumped, 0.2)


def test_parts_of_a_long_capture_are_few_and_span_it() -> None:
    capture = collect_statistics(WallCamera(400, range(390, 400)), 400)
    first_m, *_, last_m = capture.parts_m

    assert len(capture.parts_m) <= measure.MAX_PARTS
    assert np.nanmean(last_m - first_m) < -1e-3


def seen_of(
    depth_m: np.ndarray, frames: int, intrinsics: Intrinsics = INTRINSICS, seed: int = 0
) -> CaptureStatistics:
    statistics = BareWallStatistics(intrinsics)
    dark = np.zeros(depth_m.shape, np.uint8)
    cells = np.full((64, 80), 0.2, np.float32)
    generator = np.random.default_rng(seed)
    for _ in range(frames):
        noise_m = generator.standard_normal(depth_m.shape) * (0.0005 + 0.002 * depth_m)
        statistics.add((depth_m + noise_m).astype(np.float32), dark, cells, cells)
    return CaptureStatistics("sim", statistics, intrinsics, "", "", {})


def bench_seen(intrinsics: Intrinsics = INTRINSICS, **changes: object) -> CaptureStatistics:
    """Return statistics of the paper's rig with its occluder and no hidden object, rendered by its
    beams.
    """
    beams = cast(BENCH.model_copy(update=changes), intrinsics)
    depth_m = beams.length_m * beams.cos_axis
    shape = intrinsics.height, intrinsics.width
    return seen_of(depth_m.reshape(shape), 20, intrinsics, 1)


@pytest.fixture(scope="module")
def seen() -> CaptureStatistics:
    return seen_of(wall_depth(RIG.wall_from_lidar, INTRINSICS), 10)


def measured(seen: CaptureStatistics, tape_m: float | None = None) -> MeasuredWall:
    fit, facts = measure.measure_by_depth(seen, tape_m)
    about = {"camera": "sim", "frames": 10, "created": date(2026, 1, 2)}
    return MeasuredWall(new_wall_record(fit, INTRINSICS, **about, others=facts), None)


@pytest.fixture(scope="module")
def bare(seen: CaptureStatistics) -> MeasuredWall:
    return measured(seen)


@pytest.mark.parametrize(("x_m", "gap_m"), [(0.2, 0.1), (0.22, 0.08), (0.19, 0.11)])
def test_measure_occluder_finds_it_beside_the_known_wall(
    bare: MeasuredWall, x_m: float, gap_m: float
) -> None:
    record, _ = measure_occluder(bench_seen(occluder=Occluder(x_m=x_m, z_min_m=gap_m)), bare)
    found = record.occluder

    assert found.source == "detected"
    assert found.x_m == pytest.approx(x_m, abs=0.002)
    assert found.gap_m == pytest.approx(gap_m, abs=0.002)
    assert record.verdict == "good"
    assert record.rig.occluder == Occluder(x_m=found.x_m, z_min_m=found.gap_m)
    assert record.rig.lidar == bare.record.rig.lidar


@pytest.mark.parametrize("offset_m", [0.0045, -0.0045])
def test_beams_see_the_bench_from_where_they_meet(seen: CaptureStatistics, offset_m: float) -> None:
    """A tape is held to the glass, from which an offset of the origin is as far as it says."""
    tape_m = RIG.lidar.distance_m + offset_m * np.cos(np.radians(RIG.facing_deg))
    bare = measured(seen, tape_m)
    record, _ = measure_occluder(bench_seen(), bare)
    beams = record.beam_rig

    assert record.range_offset_cause == "origin"
    assert record.rig.lidar.distance_m == pytest.approx(tape_m, abs=1e-4)
    assert beams.lidar.distance_m == pytest.approx(RIG.lidar.distance_m, abs=1e-4)
    assert beams.occluder.x_m == pytest.approx(BENCH.occluder.x_m, abs=0.001)
    assert beams.occluder.x_m - record.rig.occluder.x_m == pytest.approx(
        -offset_m * np.sin(np.radians(RIG.facing_deg)), abs=1e-4
    )


def test_walls_pixels_are_those_beside_the_occluder(bare: MeasuredWall) -> None:
    seen = bench_seen()
    _, inliers = measure_occluder(seen, bare)
    wall_m = wall_depth(RIG.wall_from_lidar, INTRINSICS)
    far = np.abs(wall_m - seen.statistics.depth.mean_m()) > 0.02

    assert 0.1 < far.mean() < 0.5
    assert not (inliers & far).any()
    assert inliers[~far].mean() > 0.95


@pytest.mark.parametrize(
    ("lidar", "amount"),
    [
        (LidarPose(distance_m=0.203, yaw_deg=45.0), r"3\.0 mm"),
        (
            LidarPose(distance_m=0.2, yaw_deg=45.0, pitch_deg=1.0),
            r"\+1\.00",
        ),  # facing the wall at 45 degrees as before
    ],
)
def test_measure_occluder_refuses_a_lidar_that_moved(
    bare: MeasuredWall, lidar: LidarPose, amount: str
) -> None:
    with pytest.raises(WallRefusedError, match=amount):
        measure_occluder(bench_seen(lidar=lidar), bare)


@pytest.mark.parametrize("distance_m", [0.19, 0.21])
def test_wall_that_moved_far_is_taken_for_no_occluder(
    seen: CaptureStatistics, bare: MeasuredWall, distance_m: float
) -> None:
    depth_m = seen.statistics.depth.mean_m().astype(np.float32)
    reference: Any = SimpleNamespace(
        depth_m=depth_m, inliers=np.isfinite(depth_m), intrinsics=INTRINSICS
    )
    moved = bench_seen(lidar=LidarPose(distance_m=distance_m, yaw_deg=45.0))

    with pytest.raises(WallRefusedError, match=r"the lidar has moved .* 10\.0 mm"):
        measure_occluder(moved, replace(bare, reference=reference))


@pytest.mark.parametrize(("tape_m", "verdict"), [(0.205, "good"), (0.214, "doubtful")])
def test_tape_far_from_the_lidar_is_doubtful(
    seen: CaptureStatistics, tape_m: float, verdict: str
) -> None:
    fit, _ = measure.measure_by_depth(seen, tape_m)

    assert fit.verdict == verdict
    assert ("from the glass again" in fit.advice) == (verdict == "doubtful")


def test_measure_occluder_refuses_a_lidar_that_was_turned_over(bare: MeasuredWall) -> None:
    upright = bare.record.model_copy(update={"gravity_m_s2": (0.0, 9.81, 0.0)})
    over = replace(bench_seen(), gravity_m_s2=(0.0, -9.81, 0.0))
    with pytest.raises(WallRefusedError, match="turned by 180"):
        measure_occluder(over, MeasuredWall(upright, None))


UP = (0.0, 9.81, 0.0)
OVER = (0.0, -9.81, 0.0)
SIDE = (9.81, 0.0, 0.0)


@pytest.mark.parametrize(
    ("gravity", "said", "known"),
    [
        (UP, "unknown", "upright"),
        (UP, "upright", "upright"),
        (OVER, "upside down", "upside down"),
        (None, "upside down", "upside down"),
        (None, "unknown", "unknown"),
    ],
)
def test_way_up_is_gravitys_or_the_owners(
    gravity: tuple[float, float, float] | None, said: WayUp, known: WayUp
) -> None:
    assert measure.check_way_up(gravity, said) == known


@pytest.mark.parametrize(
    ("gravity", "said", "advice"),
    [
        (OVER, "unknown", "turn it over"),
        (OVER, "upright", "turn it over"),
        (UP, "upside down", "leave out"),
        (SIDE, "unknown", "on its side"),
        (SIDE, "upside down", "on its side"),
    ],
)
def test_camera_that_is_not_as_said_is_refused(
    gravity: tuple[float, float, float], said: WayUp, advice: str
) -> None:
    with pytest.raises(CalibrationError, match=advice):
        measure.check_way_up(gravity, said)


def test_measure_occluder_is_not_moved_by_an_origin_offset(seen: CaptureStatistics) -> None:
    """The beams meet 4 sqrt(2) mm before the glass at 45 degrees: x and distance of the glass are 4
    mm from theirs.
    """
    wall = measured(seen, 0.204)

    assert wall.record.range_offset_cause == "origin"

    record, _ = measure_occluder(bench_seen(), wall)

    assert record.occluder.x_m == pytest.approx(0.204, abs=2e-4)
    assert record.occluder.gap_m == pytest.approx(0.1, abs=0.002)
    assert record.occluder.x_std_m == pytest.approx(0.0005, rel=0.02)  # the tape's


@pytest.mark.parametrize("tape_m", [0.2, 0.204])
@pytest.mark.parametrize("short_m", [0.0, 0.004])
def test_known_range_offset_gives_the_wall_by_tape_again(tape_m: float, short_m: float) -> None:
    depth_m = wall_depth(RIG.wall_from_lidar, INTRINSICS) - short_m
    seen = seen_of(depth_m, 10)
    taped = measured(seen, tape_m).record
    fit, facts = measure.measure_by_depth(seen, known=taped)
    offset = {name: getattr(taped, f"range_offset_{name}") for name in ("m", "std_m", "cause")}

    assert facts == {f"range_offset_{name}": value for name, value in offset.items()}
    assert fit.distance_m == pytest.approx(taped.distance_m, abs=1e-9)
    assert fit.yaw_deg == pytest.approx(taped.yaw_deg, abs=1e-9)
    # the tape's, and the noise of both fits
    assert fit.distance_std_m == pytest.approx(taped.distance_std_m, rel=0.15)


def test_measure_occluder_refuses_another_image_size(bare: MeasuredWall) -> None:
    with pytest.raises(CalibrationError, match=r"160x120.*80x60"):
        measure_occluder(bench_seen(RIG.pinhole.scaled(80, 60)), bare)


def test_measure_occluder_refuses_another_camera(bare: MeasuredWall) -> None:
    first = replace(bare, record=bare.record.model_copy(update={"serial": "f1"}))
    with pytest.raises(CalibrationError, match=r"f1.*f2"):
        measure_occluder(replace(bench_seen(), serial="f2"), first)


def test_measure_occluder_warns_of_changed_settings(
    bare: MeasuredWall, seen: CaptureStatistics
) -> None:
    then = replace(seen, settings={"laser_power": 80.0}).reference(np.ones((120, 160), np.bool_))
    now = replace(bench_seen(), settings={"laser_power": 40.0})
    record, _ = measure_occluder(now, replace(bare, reference=then))

    assert re.search("laser_power.*80.*40", record.warnings[-1])


def test_measure_occluder_refuses_a_bench_without_one(
    bare: MeasuredWall, seen: CaptureStatistics
) -> None:
    with pytest.raises(OccluderRefusedError, match="--occluder-x-m"):
        measure_occluder(seen, bare)


def frame_of(rig: Rig, width: int, height: int) -> Frame:
    intrinsics = rig.pinhole.scaled(width, height)
    depth_m = wall_depth(rig.wall_from_lidar, intrinsics)
    depth_m[depth_m > 5.0] = np.nan
    depth_m += np.random.default_rng(0).standard_normal(depth_m.shape) * (0.0005 + 0.002 * depth_m)
    counts = np.full(depth_m.shape, 48, np.uint8)
    return Frame(depth_m.astype(np.float32), counts, counts, 0.0, 0, intrinsics)


@pytest.mark.parametrize(("width", "height"), [(640, 480), (1024, 768), (100, 75)])
@pytest.mark.parametrize(("distance_m", "yaw_deg"), [(0.2, 45.0), (0.15, 15.0), (0.3, -60.0)])
def test_fit_frame_measures_wall_in_a_thinned_frame(
    width: int, height: int, distance_m: float, yaw_deg: float
) -> None:
    pose = LidarPose(distance_m=distance_m, yaw_deg=yaw_deg)
    seen = fit_frame(frame_of(RIG.model_copy(update={"lidar": pose}), width, height))
    within_m = max(0.0005, 4 * seen.fit.distance_std_m)
    within_deg = max(0.1, 4 * seen.fit.yaw_std_deg)

    assert seen.fit.distance_m == pytest.approx(distance_m, abs=within_m)
    assert seen.fit.yaw_deg == pytest.approx(yaw_deg, abs=within_deg)


def test_fit_frame_reports_refusal_and_saturation() -> None:
    frame = frame_of(RIG, 640, 480)
    nothing = np.full_like(frame.depth_m, np.nan)
    blinded = np.full_like(frame.ir, 255)
    seen = fit_frame(replace(frame, depth_m=nothing, ir=blinded))

    assert seen.fit is None
    assert "0.0%" in seen.refusal
    assert seen.saturated == 1.0
