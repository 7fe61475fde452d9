import time
from dataclasses import replace
from itertools import count as count_up
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_uncertainty import FakeUncertainty
from fake_wall import (
    RIG,
    SERIAL,
    SMALL,
    WallCamera,
    bare_wall,
    measured_wall,
    other_intrinsics,
    wall_frame,
    write_wall,
)
from nlos_calibration.errors import CalibrationError, RecordFileError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import load_rig
from small_frames import NOTHING, SheetNetwork, sheet_network

from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.reconstruct import (
    Arrival,
    Clock,
    FrameConditions,
    FrameReader,
    FrameResult,
    OwnMaps,
    Pipeline,
    Verdict,
    build_pipeline,
    frame_issues,
    iterate_batched,
    iterate_results,
    load_networks,
)
from nlos_cam.reconstruct.bench import (
    NOT_MEASURED,
    BenchObservation,
    CalibratedRig,
    occluder_assumed,
    open_bench,
    subtract_reference,
)
from nlos_cam.reconstruct.consistency import COMPLETE, MapFindings, MapProblem
from nlos_cam.reconstruct.flat_field import FlatField
from nlos_cam.reconstruct.network import Quality, Uncertainty
from nlos_cam.reconstruct.physics_check import (
    NullPhysicsCheck,
    PeriodicPhysicsCheck,
    PhysicsCheckResult,
)
from nlos_cam.reconstruct.pipeline import (
    TRUSTED_MISSING,
    compatibility_warnings,
    frame_conditions,
    with_quality_of_maps,
)
from nlos_cam.reconstruct.streaming import BATCH_FRAMES, MAX_BATCHES_AHEAD, warm_up
from nlos_cam.recording import with_telemetry


def all_steps(
    pipeline: Pipeline, camera: WallCamera, clock: Clock = lambda: 0.0, *, ahead: bool = False
) -> list[FrameResult]:
    """Results of a camera's frames: one by one, or `ahead` in batches."""
    frames, telemetry = with_telemetry(camera)
    with (
        FrameReader(frames, lossless=True, stop=Event(), clock=lambda: 0.0) as reader,
        pipeline.checks,
    ):
        if ahead:
            return list(iterate_batched(reader, pipeline, clock, telemetry))
        return list(iterate_results(reader, pipeline, clock, temperatures=telemetry))


@pytest.fixture
def walled(tmp_path: Path) -> CalibratedRig:
    return CalibratedRig(RIG, measured_wall(tmp_path))


def test_steps_time_every_stage_with_the_given_clock() -> None:
    ticks = iter(range(10_000))
    done = all_steps(
        Pipeline(CalibratedRig(RIG), sheet_network), WallCamera(3), lambda: float(next(ticks))
    )

    assert [step.frame.frame_number for step in done] == [0, 1, 2]

    for step in done:
        stages_s = dict(step.stages_s)
        assert stages_s.pop("queue") > (step.arrived_s or 0.0) == 0.0
        assert stages_s == {"wait": 1.0, "maps": 1.0, "bench": 1.0, "network": 1.0}


def test_pipeline_feeds_the_mean_of_raw_or_difference_maps(walled: CalibratedRig) -> None:
    noting = SheetNetwork()
    for uses_difference in (False, True):
        done = all_steps(
            Pipeline(walled, noting, uses_difference=uses_difference, average=4), WallCamera(6)
        )
    mean_m = np.mean([wall_frame(number).depth_m for number in range(2, 6)], axis=0)
    raw = replace(done[5].maps, depth_m=mean_m.astype(np.float32))

    np.testing.assert_allclose(noting.given[5], OwnMaps(walled).correct(raw).depth_m, atol=1e-6)
    np.testing.assert_allclose(noting.given[11], mean_m - walled.reference.map_depth_m, atol=1e-6)
    assert done[5].frame.frame_number == 5
    np.testing.assert_array_equal(done[5].difference.depth_m, noting.given[11])

    with pytest.raises(CalibrationError, match="--wall"):
        Pipeline(CalibratedRig(RIG), sheet_network, uses_difference=True)


@pytest.mark.parametrize("offset_m", [0.0, 0.0045])
def test_pipeline_adds_the_measured_offset_to_raw_maps(
    walled: CalibratedRig, offset_m: float
) -> None:
    noting = SheetNetwork()
    record = walled.measured.record.model_copy(update={"range_offset_m": offset_m})
    bench = CalibratedRig(RIG, replace(walled.measured, record=record))
    (step,) = all_steps(Pipeline(bench, noting), WallCamera(1))

    np.testing.assert_array_equal(noting.given[0], OwnMaps(bench).correct(step.maps).depth_m)


def test_pipeline_watches_drift_in_the_frame_not_the_mean(walled: CalibratedRig) -> None:
    done = all_steps(
        Pipeline(walled, sheet_network, average=1000), WallCamera(100, moved=range(50, 100))
    )

    assert not any(step.warnings for step in done[:50])
    assert done[-1].warnings


def test_telemetry_is_read_periodically_with_or_without_wall(walled: CalibratedRig) -> None:
    for bench in (CalibratedRig(RIG), walled):
        camera = WallCamera(25, celsius=80.0, period_s=1.0)
        done = all_steps(Pipeline(bench, sheet_network), camera)
        assert camera.asked == 3
        assert all(bool(step.warnings) == (bench is walled) for step in done), (
            "too hot from the first frame on"
        )


CALLS = count_up()


def looking(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
    """Show the maps; every other call takes longer, so that calls side by side end out of order."""
    time.sleep(0.02 * (next(CALLS) % 2 == 0))
    return np.clip(np.nan_to_num(depth_m[:, :, :64]) + 0.5, 0.0, 1.0)


@pytest.mark.parametrize("count", [0, 1, BATCH_FRAMES, BATCH_FRAMES * (MAX_BATCHES_AHEAD + 3) + 3])
def test_batched_results_equal_results_in_turn(tmp_path: Path, count: int) -> None:
    done: list[list[FrameResult]] = []
    for ahead in (False, True):
        checks = PeriodicPhysicsCheck(RIG, every=5, accuracy="draft")
        bench = CalibratedRig(RIG, measured_wall(tmp_path))
        pipeline = Pipeline(
            bench, looking, average=3, uncertainty_model=FakeUncertainty(), checks=checks
        )
        done.append(all_steps(pipeline, WallCamera(count, moved=range(count // 2)), ahead=ahead))

    assert [step.frame.frame_number for step in done[1]] == list(range(count))

    for one, other in zip(*done, strict=True):
        assert (one.verdict, one.warnings, one.arrived_s) == (
            other.verdict,
            other.warnings,
            other.arrived_s,
        )
        assert (one.check.frame_number, one.check.score) == (
            other.check.frame_number,
            other.check.score,
        )
        for name in ("maps", "reconstruction", "difference"):
            np.testing.assert_array_equal(getattr(one, name).depth_m, getattr(other, name).depth_m)


@pytest.mark.parametrize(("ahead", "count"), [(False, 12), (True, 40)])
def test_results_raise_the_error_of_a_frame(ahead: bool, count: int) -> None:
    odd_m = maps_from_frame(wall_frame(9)).depth_m

    def failing(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
        if any(np.array_equal(one_m, odd_m, equal_nan=True) for one_m in depth_m):
            raise ZeroDivisionError("an odd frame")
        return sheet_network()

    with pytest.raises(ZeroDivisionError, match="an odd frame"):
        all_steps(Pipeline(CalibratedRig(RIG), failing), WallCamera(count), ahead=ahead)


@pytest.mark.parametrize(("nothing", "verdict"), [(0.9, Verdict.NOTHING), (0.0, Verdict.SEEN)])
def test_result_shows_what_its_verdict_says(
    walled: CalibratedRig, nothing: float, verdict: Verdict
) -> None:
    noting = SheetNetwork()
    doubter = FakeUncertainty(lambda *_: (nothing, 0.0))
    pipeline = Pipeline(walled, noting, uses_difference=True, average=3, uncertainty_model=doubter)
    done = all_steps(pipeline, WallCamera(100, moved=range(50, 100)))
    for step, asked, given in zip(done[:50], doubter.asked[:50], noting.given[:50], strict=True):
        assert step.verdict == verdict
        assert step.reconstruction.has_surface == (verdict is Verdict.SEEN)
        assert step.reconstruction.uncertainty_m is not None
        np.testing.assert_array_equal(asked[0][0], given)

    assert done[-1].verdict == Verdict.WALL_MOVED


@pytest.mark.parametrize("missing", [0, 40, 80])
@pytest.mark.parametrize("saturated", [False, True])
def test_frame_conditions_follow_frame_issues_and_bench(missing: int, saturated: bool) -> None:
    depth_m = np.where(np.arange(80) < missing, np.float32(np.nan), np.float32(0.3)) * np.ones(
        (64, 1), np.float32
    )
    frame = replace(
        wall_frame(0), depth_m=depth_m, ir=np.full((64, 80), 255 if saturated else 9, np.uint8)
    )
    check = PhysicsCheckResult(0, depth_m, depth_m, score=1.0, seconds=0.0)
    observation = BenchObservation(None, (), moved=saturated)
    prepared = SimpleNamespace(
        arrival=Arrival(frame, 0.0, frame_issues(frame)),
        observation=observation,
        frozen=saturated,
        findings=COMPLETE,
    )

    conditions = frame_conditions(prepared, check)  # type: ignore[arg-type]

    assert conditions == FrameConditions(
        saturated, missing > 0, moved=saturated, frozen=saturated, check=check
    )


def test_an_offset_of_the_origin_is_in_the_rig_not_the_depth(tmp_path: Path) -> None:
    offset = {"range_offset_m": 0.004, "range_offset_cause": "origin"}
    bench = open_bench(write_wall(tmp_path / "wall.toml", bare_wall(), **offset), WallCamera(1))
    maps = maps_from_frame(wall_frame(0))

    assert bench.correct_range(maps) is maps
    assert bench.rig != bench.measured.record.rig
    moved_m = bench.rig.lidar.distance_m - RIG.lidar.distance_m
    assert moved_m == pytest.approx(-0.004 * np.cos(np.radians(RIG.facing_deg)), abs=1e-6)


def test_a_check_of_later_frames_does_not_count() -> None:
    """A device that starts again counts its frames from 0."""
    frame = wall_frame(3)
    prepared = SimpleNamespace(
        arrival=Arrival(frame, 0.0, ()),
        observation=BenchObservation(None, ()),
        frozen=False,
        findings=COMPLETE,
    )
    check = PhysicsCheckResult(50_000, frame.depth_m, frame.depth_m, score=1.0, seconds=0.0)

    assert frame_conditions(prepared, check).check is None  # type: ignore[arg-type]


def test_checked_maps_are_without_the_ranges_drift(walled: CalibratedRig) -> None:
    offered: list[LidarMaps] = []
    checks = SimpleNamespace(
        newest=None,
        use_rig=lambda _: None,
        offer=lambda _number, maps, _depth_m: offered.append(maps),
    )
    pipeline = Pipeline(walled, sheet_network, checks=checks)  # type: ignore[arg-type]
    for number in range(40):
        frame = wall_frame(number, nearer_m=-0.0008)
        pipeline.process(Arrival(frame, 0.0, ()), lambda: 0.0, 0.0)

    flat_field = FlatField(walled)
    exact = flat_field.as_rendered(flat_field.correct(maps_from_frame(wall_frame(39))))
    off_m = np.nanmean(offered[-1].depth_m - exact.depth_m)
    assert abs(off_m) < 2e-4
    assert np.nanmean(offered[0].depth_m - exact.depth_m) == pytest.approx(8e-4, abs=1e-4)


class ScoringCheck(NullPhysicsCheck):
    """Check in the caller's thread that finds one score for every frame."""

    def __init__(self, score: float) -> None:
        self.newest: PhysicsCheckResult | None = None
        self.offered: list[int] = []
        self._score = score

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: np.ndarray) -> None:
        self.offered.append(frame_number)
        has_surface = bool(np.isfinite(depth_m).any())
        self.newest = PhysicsCheckResult(
            frame_number, maps.depth_m, maps.depth_m, self._score, 0.0, has_surface=has_surface
        )


@pytest.mark.parametrize(
    ("score", "nothing", "verdict"),
    [
        (0.1, 0.0, Verdict.SEEN),
        (0.1, 0.9, Verdict.NOTHING),
        (1.0, 0.0, Verdict.OUTSIDE),
        (1.0, 0.9, Verdict.OUTSIDE),
    ],
)
def test_frame_is_judged_by_its_own_check(score: float, nothing: float, verdict: Verdict) -> None:
    doubter = FakeUncertainty(lambda *_: (nothing, 0.0))
    checks = ScoringCheck(score)
    bench = CalibratedRig(RIG)
    pipeline = Pipeline(bench, sheet_network, uncertainty_model=doubter, checks=checks)

    result = pipeline.process(Arrival(wall_frame(0), 0.0, ()), lambda: 0.0, 0.0)

    assert result.check is not None
    assert result.check.frame_number == 0
    assert result.verdict == verdict


def test_result_has_no_check_that_is_too_old_for_its_verdict() -> None:
    checks = ScoringCheck(0.1)
    pipeline = Pipeline(CalibratedRig(RIG), sheet_network, checks=checks)
    pipeline.process(Arrival(wall_frame(0), 0.0, ()), lambda: 0.0, 0.0)
    checks.offer = lambda *_: None  # type: ignore[method-assign]
    first, last = (
        pipeline.process(Arrival(wall_frame(number), 0.0, ()), lambda: 0.0, 0.0)
        for number in (150, 151)
    )

    assert first.check is not None
    assert last.check is None


def test_frame_of_the_bench_before_stays_on_it_unchecked() -> None:
    box = RIG.object_box
    assert box
    aside = box.model_copy(update={"x_min_m": box.x_min_m + 0.1, "x_max_m": box.x_max_m + 0.1})
    checks = ScoringCheck(0.0)
    pipeline = Pipeline(CalibratedRig(RIG), sheet_network, checks=checks)
    prepared = pipeline.prepare(Arrival(wall_frame(0), 0.0, ()), lambda: 0.0, 0.0)

    pipeline.bench = CalibratedRig(RIG.model_copy(update={"object_box": aside}))
    (made,) = pipeline.reconstruct([prepared], lambda: 0.0)
    pipeline.finish(prepared, made, lambda: 0.0)

    assert made.box == box
    assert checks.offered == []


DOUBTER: Any = object()


def trained(
    rig_name: str = RIG.name, rig_checksum: str = RIG.checksum, eats: str = "raw maps"
) -> Any:
    return SimpleNamespace(
        rig_name=rig_name, rig_checksum=rig_checksum, rig=None, input=eats, bare_wall_counts=None
    )


def test_warnings_name_mismatches_with_the_training(
    walled: CalibratedRig,
) -> None:
    farther = RIG.model_copy(update={"lidar": RIG.lidar.model_copy(update={"distance_m": 0.3})})

    assert compatibility_warnings(CalibratedRig(RIG), trained(), DOUBTER) == []

    (note,) = compatibility_warnings(CalibratedRig(farther), trained(), DOUBTER)

    assert "100 mm" in note

    (note,) = compatibility_warnings(CalibratedRig(RIG), trained(), None)

    assert "uncertainty" in note

    bare = CalibratedRig(RIG, replace(walled.measured, reference=None))
    found, more = (compatibility_warnings(each, trained(), DOUBTER) for each in (walled, bare))

    assert ["reference" in note for note in set(more) - set(found)] == [True]

    for checksum, notes in ((RIG.checksum, 0), ("0" * 12, 1)):  # a rig of another name
        unnamed = trained("a rig of somebody else's", checksum)
        assert len(compatibility_warnings(CalibratedRig(RIG), unnamed, DOUBTER)) == notes


@pytest.mark.parametrize("eats", ["raw maps", "difference maps"])
def test_build_pipeline_feeds_the_networks_their_kind_of_maps(
    walled: CalibratedRig, eats: str
) -> None:
    network = SheetNetwork()
    network.record = trained(eats=eats)
    pipeline: Any = build_pipeline(walled, network, average=7)
    done = all_steps(pipeline, WallCamera(1))

    assert pipeline.network is network

    flat = OwnMaps(walled).correct(done[0].maps)
    fed = {"raw maps": flat, "difference maps": done[0].difference}[eats]

    np.testing.assert_array_equal(network.given[0], fed.depth_m)
    assert pipeline.average == 7


def test_load_networks_exports_into_the_cache(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[Any] = []
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path))
    monkeypatch.setattr(
        "nlos_cam.reconstruct.pipeline.load_reconstructor", lambda *given: asked.append(given) or np
    )

    assert load_networks(Path("mine")) is np
    assert asked == [(Path("mine"), tmp_path / "onnx")]


def camera(intrinsics: Intrinsics = SMALL, **others: Any) -> Any:
    return SimpleNamespace(
        **{"intrinsics": intrinsics, "rig": None, "identity": {"serial": SERIAL}, **others}
    )


@pytest.fixture
def wall(tmp_path: Path) -> Path:
    return write_wall(tmp_path / "wall.toml", bare_wall())


def observe(bench: CalibratedRig, number: int = 0, nearer_m: float = 0.0) -> BenchObservation:
    frame = wall_frame(number, nearer_m)
    return bench.observe(frame, maps_from_frame(frame))


def test_open_bench_takes_a_record_or_the_cameras_rig(wall: Path, tmp_path: Path) -> None:
    own = RIG.model_copy(update={"name": "own"})

    assert open_bench(None, camera(rig=own)).rig is own
    assert open_bench(None, camera(rig=load_rig("bare-wall"))).rig == RIG

    bench = open_bench(None, camera(Intrinsics(320, 240, 1.0, 1.0, 0.0, 0.0)))
    bench.update_temperatures({"ldd_temperature": 90.0})
    look = observe(bench)

    assert bench.rig == RIG
    assert (look.difference, look.warnings, bench.reference) == (None, (NOT_MEASURED,), None)

    bench = open_bench(wall, camera())

    assert (bench.rig.name, bench.reference.frames, bench.measured.record.serial) == (
        "measured",
        20,
        SERIAL,
    )

    bare = open_bench(write_wall(tmp_path / "bare.toml"), camera())

    assert bare.rig.name == "measured"
    assert observe(bare).difference is None


def test_difference_of_the_bare_wall_is_noise_less_drift(walled: CalibratedRig) -> None:
    levels_m = list[float]()
    for number in range(100, 160):
        difference = observe(walled, number, nearer_m=0.0006).difference
        off_m = difference.depth_m[difference.valid]
        levels_m.append(float(off_m.mean()))
        assert off_m.std() == pytest.approx(5e-4, rel=0.1)
        assert abs(difference.intensity[difference.valid].mean()) < 0.5

    assert levels_m[0] == pytest.approx(-0.0006, abs=1e-4)
    assert np.mean(levels_m[-20:]) == pytest.approx(0.0, abs=1e-4)


def test_difference_is_valid_where_maps_and_reference_are() -> None:
    reference = bare_wall()
    added_m, added = np.random.default_rng(0).normal(0.0, 0.01, (2, 64, 80)).astype(np.float32)
    depth_m = reference.map_depth_m + added_m
    depth_m[:, 3] = np.nan
    maps = LidarMaps(depth_m, reference.map_intensity + added, ~np.isnan(depth_m))
    found = subtract_reference(maps, reference)

    np.testing.assert_array_equal(found.valid, maps.valid & np.isfinite(reference.map_depth_m))
    assert not found.valid[:, 3].any()
    assert not found.valid.all(axis=0)[79]  # the wall as far as 0.6 m is all that the reference has
    np.testing.assert_allclose(found.depth_m[found.valid], added_m[found.valid], atol=1e-6)
    np.testing.assert_allclose(found.intensity[found.valid], added[found.valid], atol=1e-4)
    assert np.isnan(found.depth_m[~found.valid]).all()
    assert (found.intensity[~found.valid] == 0.0).all()
    assert found.depth_m.dtype == found.intensity.dtype == np.float32


@pytest.mark.parametrize(
    ("nearer_m", "celsius", "moved", "frames"),
    [
        (0.0, 41.0, False, 40),
        (0.0, 75.0, False, 40),
        (0.002, 41.0, False, 40),
        (0.01, 41.0, True, 40),
        (-1.0, 41.0, True, 300),
    ],
)
def test_bench_warns_of_drift_heat_and_of_a_moved_lidar(
    walled: CalibratedRig, nearer_m: float, celsius: float, moved: bool, frames: int
) -> None:
    walled.update_temperatures({"ldd_temperature": celsius})
    looks = [observe(walled, number + 500, nearer_m) for number in range(frames)]

    assert not looks[0].moved
    assert looks[-1].moved == moved
    assert bool(looks[-1].warnings) == (nearer_m != 0 or celsius > 70.0)


@pytest.mark.parametrize("reference", [False, True])
def test_open_bench_refuses_other_intrinsics(tmp_path: Path, reference: bool) -> None:
    wall = write_wall(tmp_path / "wall.toml", bare_wall() if reference else None)
    with pytest.raises(CalibrationError, match=r"80x64.* 40x32"):
        open_bench(wall, camera(SMALL.scaled(40, 32)))
    for name in ("fx", "fy", "ppx", "ppy"):
        value = getattr(SMALL, name)
        open_bench(wall, camera(other_intrinsics(**{name: np.float32(value * 1.000001)})))
        with pytest.raises(CalibrationError, match="intrinsics"):
            open_bench(wall, camera(other_intrinsics(**{name: value * 1.03})))
    wall = write_wall(tmp_path / "wall.toml", bare_wall(), intrinsics=other_intrinsics(fx=60.0))
    with pytest.raises(CalibrationError, match="intrinsics"):
        open_bench(wall, camera(other_intrinsics(fx=60.0)))


@pytest.mark.parametrize(("serial", "warned"), [("f9", True), ("", False), (SERIAL, False)])
def test_open_bench_warns_of_another_camera(wall: Path, serial: str, warned: bool) -> None:
    bench = open_bench(wall, camera(identity={"serial": serial} if serial else {}))
    of_occluder = occluder_assumed(wall)
    warnings = [warning for warning in observe(bench).warnings if warning != of_occluder]

    assert of_occluder in bench.warnings
    assert len(warnings) == warned
    assert all(SERIAL in warning and serial in warning for warning in warnings)


def test_open_bench_refuses_unreadable_records(tmp_path: Path, wall: Path) -> None:
    with pytest.raises(RecordFileError, match=r"none\.toml"):
        open_bench(tmp_path / "none.toml", camera())
    wall.with_suffix(".npz").unlink()
    with pytest.raises(RecordFileError, match=r"wall\.npz"):
        open_bench(wall, camera())


def test_record_that_calls_itself_doubtful_is_named(walled: CalibratedRig) -> None:
    changes = {"verdict": "doubtful", "advice": "measure again"}
    record = walled.measured.record.model_copy(update=changes)
    bench = CalibratedRig(RIG, replace(walled.measured, record=record))

    assert any("doubtful: measure again" in note for note in observe(bench).warnings)


TRUSTED = Quality(iou=(0.7, 0.8, 0.9), good=0.95, error_m=0.01, trusted=True)
UP = (0.0, 9.81, 0.0)
OVER = (0.0, -9.81, 0.0)


@pytest.mark.parametrize(
    ("recorded", "now", "word"),
    [
        ({"gravity_m_s2": UP, "way_up": "upright"}, OVER, "turned by 180"),
        ({"gravity_m_s2": UP, "way_up": "upright"}, (1.7, 9.66, 0.0), "turned by 10"),
        ({"way_up": "upright"}, OVER, "upside down"),
        ({}, OVER, "upside down"),
    ],
)
def test_lidar_that_was_turned_gets_no_good_verdict(
    tmp_path: Path, recorded: dict[str, Any], now: tuple[float, float, float], word: str
) -> None:
    bench = open_bench(write_wall(tmp_path / "wall.toml", bare_wall(), **recorded), WallCamera(1))
    pipeline = Pipeline(bench, sheet_network, uncertainty_model=FakeUncertainty())
    turned = replace(wall_frame(1), gravity_m_s2=now)
    result = pipeline.process(Arrival(turned, 0.0, ()), time.time, 0.0)

    assert result.verdict is Verdict.WALL_MOVED
    assert [each for each in result.warnings if word in each]


@pytest.mark.parametrize("now", [None, UP, (0.2, 9.8, 0.1)])
def test_lidar_as_it_was_measured_is_not_called_turned(
    tmp_path: Path, now: tuple[float, float, float] | None
) -> None:
    wall = write_wall(tmp_path / "wall.toml", bare_wall(), gravity_m_s2=UP, way_up="upright")
    frame = replace(wall_frame(1), gravity_m_s2=now)
    seen = open_bench(wall, WallCamera(1)).observe(frame, maps_from_frame(frame))

    assert not seen.moved
    assert not [each for each in seen.warnings if "turned" in each]


def test_record_of_an_upside_down_camera_is_said_in_each_run(tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "wall.toml", bare_wall(), way_up="upside down")
    frame = replace(wall_frame(1), gravity_m_s2=OVER)
    seen = open_bench(wall, WallCamera(1)).observe(frame, maps_from_frame(frame))

    assert not seen.moved
    assert any("upside down" in each for each in seen.warnings)


def judged(missing: float, *problems: MapProblem) -> Quality:
    """Return the predicted quality of a trusted frame whose maps have these findings."""
    estimate = Uncertainty(0.0, 0.0, NOTHING.depth_m, NOTHING.depth_m, TRUSTED)
    conditions = FrameConditions(findings=MapFindings(missing, 0.0, problems))
    found = with_quality_of_maps(replace(NOTHING, uncertainty=estimate), conditions).quality
    assert found is not None
    return found


def test_quality_of_whole_maps_stays_as_predicted() -> None:
    assert judged(0.0) == TRUSTED


def test_quality_falls_with_each_missing_cell() -> None:
    medians = [judged(missing).iou[1] for missing in (0.0, 0.001, 0.01, 0.1, 0.5, 1.0)]

    assert medians == sorted(set(medians), reverse=True)
    assert medians[-1] == 0.0


@pytest.mark.parametrize(
    ("missing", "trusted"), [(0.019, True), (TRUSTED_MISSING, False), (0.1, False)]
)
def test_frame_without_some_cells_is_not_trusted(missing: float, trusted: bool) -> None:
    assert judged(missing).trusted == trusted


@pytest.mark.parametrize("missing", [0.0, 0.001])
def test_frame_of_impossible_maps_is_not_trusted(missing: float) -> None:
    assert not judged(missing, MapProblem.TORN).trusted


def test_reconstruction_without_uncertainty_has_no_quality() -> None:
    assert NOTHING.with_quality(TRUSTED) is NOTHING


def test_pipeline_averages_as_it_was_told() -> None:
    pipeline = Pipeline(CalibratedRig(RIG), sheet_network)
    pipeline.average = 3
    assert pipeline.average == 3


def test_result_says_what_its_parts_hold() -> None:
    (step,) = all_steps(
        Pipeline(CalibratedRig(RIG), sheet_network, uncertainty_model=FakeUncertainty()),
        WallCamera(1),
    )
    parts = step.reconstruction

    assert step.depth_m is parts.depth_m
    assert step.uncertainty_m is parts.uncertainty_m
    np.testing.assert_array_equal(step.points_m, parts.points_m)
    np.testing.assert_array_equal(step.to_mesh().vertices_m, parts.to_mesh().vertices_m)
    assert (step.quality, step.truth_depth_m) == (parts.quality, step.frame.truth_depth_m)
    assert (step.frame_number, step.timestamp_s) == (0, step.frame.timestamp_s)
    assert repr(step).startswith(f"<FrameResult: frame 0, {step.verdict or 'no verdict'}")


@pytest.mark.parametrize("uncertainty", [None, FakeUncertainty()], ids=["plain", "uncertain"])
def test_picture_of_a_result_spans_its_box(uncertainty: FakeUncertainty | None) -> None:
    (step,) = all_steps(
        Pipeline(CalibratedRig(RIG), sheet_network, uncertainty_model=uncertainty), WallCamera(1)
    )
    box = step.reconstruction.box
    maps = [axis for axis in step.plot().axes if axis.get_xlabel() == "wall x (cm)"]

    assert len(maps) == (1 if uncertainty is None else 2)
    for axis in maps:
        assert axis.get_xlim() == pytest.approx((100 * box.x_min_m, 100 * box.x_max_m))
        assert axis.get_ylim() == pytest.approx((100 * box.y_min_m, 100 * box.y_max_m))


def test_warming_up_reconstructs_once_and_enters_no_camera() -> None:
    noting = SheetNetwork()
    camera = WallCamera(1)
    warm_up(camera, Pipeline(CalibratedRig(RIG), noting))

    assert len(noting.given) == 1
    assert camera.asked == 0
