import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration.errors import CalibrationError, RecordFileError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.occluder import OccluderFit
from nlos_calibration.reference import (
    BareWall,
    BareWallStatistics,
    Moments,
    load_reference,
    save_reference,
)
from nlos_calibration.rig import ObjectBox, Occluder, Rig, dump_toml, load_rig
from nlos_calibration.wall_record import (
    UNUSABLE,
    VERSION,
    MeasuredWall,
    WallRecord,
    load_measured,
    load_wall,
    with_occluder,
)
from pydantic import ValidationError

EXAMPLE = Path(__file__).parents[3] / "calibration/records/wall.toml"
SMALL = Intrinsics(16, 12, 11.4, 11.5, 7.5, 5.5)
SHAPE = (12, 16)
CELLS = (64, 80)
FRAMES = 20


@pytest.fixture
def record(measured: Callable[..., MeasuredWall]) -> WallRecord:
    return measured(0.21).record


def written(folder: Path, record: WallRecord) -> Path:
    path = folder / "wall.toml"
    path.write_text(dump_toml(record), encoding="utf-8")
    return path


def test_paper_rig_is_that_of_the_paper() -> None:
    rig = load_rig("paper-rig")

    assert rig.wall_from_lidar[2, 3] == 0.2
    assert rig.facing_deg == pytest.approx(45.0)
    assert rig.occluder == Occluder(x_m=0.2, z_min_m=0.1)


def test_paper_rig_has_the_field_of_view_of_an_l515() -> None:
    one_pixel = load_rig("paper-rig").pinhole.scaled(1, 1)
    width_deg = 2 * np.degrees(np.arctan(0.5 / one_pixel.fx))
    height_deg = 2 * np.degrees(np.arctan(0.5 / one_pixel.fy))

    assert width_deg == pytest.approx(70.0, abs=1e-3)
    assert height_deg == pytest.approx(55.0, abs=1e-3)


def test_bare_wall_is_the_papers_without_its_bench() -> None:
    bare = load_rig("bare-wall")

    assert bare.occluder is None
    assert bare.object_box is None

    pose = load_rig("paper-rig").wall_from_lidar

    np.testing.assert_array_equal(bare.wall_from_lidar, pose)


@pytest.mark.parametrize("name", ["paper-rig", "bare-wall"])
def test_rig_and_its_checksum_survive_a_file(tmp_path: Path, name: str) -> None:
    rig = load_rig(name)
    (tmp_path / "rig.toml").write_text(dump_toml(rig), encoding="utf-8")
    again = load_rig(tmp_path / "rig.toml")

    assert again == rig
    assert again.checksum == rig.checksum


DEVICE = {
    "gravity_m_s2": (0.1, 9.8, -0.3),
    "way_up": "upright",
    "serial": "f0246262",
    "firmware": "1.5.8.1",
    "settings": {"laser_power": 80.0},
    "reference": "wall.npz",
    "reference_sha256": "0" * 64,
    "range_offset_m": -0.0045,
    "range_offset_std_m": 0.0005,
}


@pytest.mark.parametrize("changes", [{}, DEVICE], ids=["plain", "device"])
def test_wall_record_survives_a_file(
    tmp_path: Path, record: WallRecord, changes: dict[str, object]
) -> None:
    changed = record.model_copy(update=changes)
    assert load_wall(written(tmp_path, changed)) == changed


def test_wall_record_with_an_edited_rig_survives_a_file(tmp_path: Path, record: WallRecord) -> None:
    box = ObjectBox(x_min_m=0.3, x_max_m=0.5, y_min_m=-0.1, y_max_m=0.1, z_near_m=0.15, z_far_m=0.3)
    bench = {"occluder": Occluder(x_m=0.25, z_min_m=0.08), "object_box": box}
    edited = record.model_copy(update={"rig": record.rig.model_copy(update=bench)})

    assert load_wall(written(tmp_path, edited)) == edited


def test_wall_record_rig_is_the_papers_as_measured(record: WallRecord) -> None:
    paper = load_rig("paper-rig")

    assert record.rig.pinhole == paper.pinhole.scaled(64, 48)
    np.testing.assert_allclose(record.rig.wall_from_lidar, record.wall_from_lidar, atol=1e-9)
    assert record.rig.occluder == paper.occluder
    assert record.rig.object_box == paper.object_box

    moved = paper.model_copy(update={"lidar": paper.lidar.model_copy(update={"distance_m": 0.201})})

    assert len({record.rig.checksum, paper.checksum, moved.checksum}) == 3


NEAR = OccluderFit(
    x_m=0.2,
    x_std_m=1e-4,
    gap_m=0.03,
    gap_std_m=1e-3,
    tilt_deg=0.0,
    tilt_std_deg=0.1,
    twist_deg=0.0,
    edge_deg=0.0,
    residual_m=1e-4,
    pixels=np.zeros((2, 2), np.bool_),
    warnings=("a stray",),
)
"""A sheet that stands too near to the wall."""
GOOD = replace(NEAR, gap_m=0.1)


@pytest.fixture
def doubtful(record: WallRecord) -> WallRecord:
    doubt = {"verdict": "doubtful", "advice": "average more frames"}
    of_wall = {f"wall_{name}": value for name, value in doubt.items()}
    return record.model_copy(update=doubt | of_wall)


def test_sheet_too_near_is_added_to_the_walls_advice(doubtful: WallRecord) -> None:
    near = with_occluder(doubtful, NEAR)

    assert near.verdict == "doubtful"
    assert near.advice.startswith("average more frames; ")
    assert "0.030 m" in near.advice


def test_occluder_measured_again_replaces_the_first_advice(doubtful: WallRecord) -> None:
    again = with_occluder(with_occluder(doubtful, NEAR), GOOD)

    assert again.advice == "average more frames"
    assert again.warnings == ("a stray",)


def test_doubt_of_an_older_record_is_found_in_its_advice(doubtful: WallRecord) -> None:
    older = with_occluder(doubtful, NEAR).model_copy(
        update={"wall_verdict": None, "wall_advice": ""}
    )
    again = with_occluder(older, GOOD)

    assert (again.verdict, again.advice) == ("doubtful", "average more frames")


def test_sign_of_an_object_refuses_the_occluder(record: WallRecord) -> None:
    hidden = replace(GOOD, why_unusable="an object seems to be hidden")

    with pytest.raises(CalibrationError, match="hidden; remove the object"):
        with_occluder(record, hidden)


def test_older_unusable_record_is_good_once_measured_again(record: WallRecord) -> None:
    older = {"verdict": "doubtful", "advice": f"{UNUSABLE}: an object seems to be hidden"}
    unusable = record.model_copy(update={**older, "wall_verdict": None})

    assert with_occluder(unusable, GOOD).verdict == "good"


def test_remarks_on_an_occluder_go_when_another_is_found(doubtful: WallRecord) -> None:
    remarked = with_occluder(doubtful, replace(GOOD, warnings=("an unlike cell",)))
    again = with_occluder(remarked, GOOD)

    assert remarked.warnings == ("an unlike cell",)
    assert again.warnings == ("a stray",)


def test_problems_of_another_box_are_not_kept(record: WallRecord) -> None:
    box = record.rig.object_box
    assert box is not None
    seen = box.model_copy(update={"x_min_m": 0.02, "x_max_m": 0.27})
    edited = record.model_copy(update={"rig": record.rig.model_copy(update={"object_box": seen})})
    problems = with_occluder(edited, GOOD)
    back = problems.model_copy(update={"rig": record.rig})

    assert problems.verdict != "good"
    assert with_occluder(back, GOOD).verdict == "good"


@pytest.mark.parametrize("version", [VERSION - 1, VERSION + 1])
def test_wall_record_of_another_version_is_refused_in_one_line(
    tmp_path: Path, record: WallRecord, version: int
) -> None:
    path = written(tmp_path, record)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(f"schema_version = {VERSION}", f"schema_version = {version}"))
    with pytest.raises(RecordFileError, match=f"version {VERSION} only.*got {version}") as caught:
        load_wall(path)

    assert "\n" not in str(caught.value)


MATRIX_END = "0.0,\n        0.0,\n        0.0,\n        "


@pytest.mark.parametrize(
    ("load", "old", "new", "problem"),
    [
        (load_rig, "distance_m = 0.2", "distance_m = -0.2", r"lidar.distance_m: .*\(got "),
        (load_rig, "yaw_deg = 45.0", "yaw_degrees = 45.0", "lidar.yaw_deg: is missing"),
        (
            load_rig,
            "x_max_m = 0.575",
            "x_max_m = 0.1",
            r"object_box: .*x_min_m < x_max_m .*\(got .*x_max_m = 0.1",
        ),
        (
            load_rig,
            "z_far_m = 0.4",
            "z_far_m = 0.1",
            r"box: .*z_near_m < z_far_m \(got .*, z_far_m = 0.1\)",
        ),
        (
            load_rig,
            "x_min_m = 0.325\nx_max_m = 0.575",
            "x_min_m = -0.575\nx_max_m = -0.325",
            r"object_box: .*mirror the bench.* \(got x_max_m = -0.325\)",
        ),
        (load_rig, 'name = "paper-rig"', 'name = "paper-rig"\nroof = 1', r"roof: .*\(got "),
        (
            load_wall,
            'reference_sha256 = ""',
            'reference_sha256 = "abc"',
            "reference_sha256: .*got 'abc'",
        ),
        (load_wall, "frames = 60", "frames = 60\nmood = 1", "mood: .*got 1"),
        (load_wall, "pitch_deg = ", "pitch_deg = 1", r"rig\.lidar"),
        (load_wall, "\ndistance_m = 0.2", "\ndistance_m = 0.3", r"rig\.lidar"),
        (load_wall, f"{MATRIX_END}1.0", f"{MATRIX_END}2.0", "pose"),
    ],
)
def test_file_error_names_field_and_value_in_one_line(
    tmp_path: Path,
    record: WallRecord,
    load: Callable[[Path], object],
    old: str,
    new: str,
    problem: str,
) -> None:
    text = dump_toml(record if load is load_wall else load_rig("paper-rig"))
    path = tmp_path / "file.toml"

    assert old in text

    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(RecordFileError, match=problem) as caught:
        load(path)

    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 4


@pytest.mark.parametrize("content", [b"", b"frames = ", b"\x00\xff", b"distance_m = 0.2"])
def test_file_of_another_kind_or_none_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "wall.toml"
    path.write_bytes(content)
    for read, word in (
        (path, r"wall\.toml"),
        (tmp_path / "none.toml", "calibrate --wall"),
        (tmp_path, tmp_path.name),
    ):
        with pytest.raises(RecordFileError, match=word):
            load_wall(read)
    (tmp_path / "bench.toml").write_text("bench_version = 1\n")
    with pytest.raises(RecordFileError, match=f"is a bench.*{tmp_path.name}, as a bench"):
        load_wall(tmp_path / "bench.toml")
    for name in ("no-such-rig", "."):
        with pytest.raises(RecordFileError):
            load_rig(name)


def test_load_wall_reads_the_worked_example() -> None:
    example = load_wall(EXAMPLE)

    assert example.verdict == "good"
    assert example.distance_m == pytest.approx(0.2, abs=1e-3)
    assert example.facing_deg == pytest.approx(45.0, abs=0.2)


@pytest.fixture
def wall() -> BareWall:
    generator = np.random.default_rng(0)
    statistics = BareWallStatistics(SMALL)
    for _ in range(FRAMES):
        depth_m = (0.2 + 0.001 * generator.standard_normal(SHAPE)).astype(np.float32)
        ir = generator.integers(40, 50, SHAPE).astype(np.uint8)
        ir[0, 0] = 255
        depth_m[0, 1] = np.nan
        statistics.add(depth_m, ir, np.full(CELLS, 0.2, np.float32), np.full(CELLS, 45, np.float32))
    for celsius in (30.0, 32.0):
        statistics.add_temperatures({"ldd_temperature": celsius})
    statistics.add_temperatures({})
    return statistics.reference(
        np.ones(SHAPE, np.bool_), serial="f1", settings={"laser_power": 40.0}
    )


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e3), st.integers(2, 40))
def test_moments_are_those_of_all_samples_together(offset: float, scale: float, count: int) -> None:
    samples = offset + scale * np.random.default_rng(count).standard_normal((count, 3, 2))
    moments = Moments((3, 2))
    for values in samples:
        moments.add(values)

    np.testing.assert_allclose(moments.mean(), samples.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(moments.spread(), samples.std(axis=0, ddof=1), rtol=1e-6)


def test_moments_leave_out_nan() -> None:
    moments = Moments((1, 2))
    for values in ([1.0, np.nan], [3.0, np.nan], [np.nan, 5.0]):
        moments.add(np.array([values]))

    np.testing.assert_array_equal(moments.mean(), [[2.0, 5.0]])
    np.testing.assert_array_equal(moments.spread(), [[np.sqrt(2.0), np.nan]])


def test_reference_holds_means_and_saturation(wall: BareWall) -> None:
    assert wall.frames == FRAMES
    assert wall.saturated[0, 0] == 1.0
    assert wall.saturated.sum() == 1.0
    assert np.isnan(wall.depth_m[0, 1])

    tolerance_m = 3 * 0.001 / np.sqrt(FRAMES * wall.depth_m.size)

    assert np.nanmean(wall.depth_m) == pytest.approx(0.2, abs=tolerance_m)


def test_reference_holds_temperatures_and_their_span(wall: BareWall) -> None:
    assert wall.celsius == {"ldd_temperature": 31.0}
    assert wall.celsius_span == {"ldd_temperature": 2.0}


def test_reference_survives_a_file(tmp_path: Path, wall: BareWall) -> None:
    path = tmp_path / "wall.npz"
    read = load_reference(path, save_reference(path, wall))
    for name, value in vars(wall).items():
        np.testing.assert_equal(getattr(read, name), value)


def test_record_without_a_reference_loads_none(tmp_path: Path, record: WallRecord) -> None:
    assert load_measured(written(tmp_path, record)).reference is None


@pytest.fixture
def with_reference(tmp_path: Path, record: WallRecord, wall: BareWall) -> Path:
    """Path of a record beside its reference wall.npz."""
    sha256 = save_reference(tmp_path / "wall.npz", wall)
    named = {"reference": "wall.npz", "reference_sha256": sha256}
    return written(tmp_path, record.model_copy(update=named))


def test_record_loads_its_reference(with_reference: Path) -> None:
    assert load_measured(with_reference).reference.frames == FRAMES


def test_reference_with_another_checksum_is_refused(with_reference: Path) -> None:
    beside = with_reference.with_suffix(".npz")
    beside.write_bytes(beside.read_bytes() + b"!")
    with pytest.raises(RecordFileError, match=r"wall\.npz"):
        load_measured(with_reference)


def test_missing_reference_is_refused(with_reference: Path) -> None:
    with_reference.with_suffix(".npz").unlink()
    with pytest.raises(RecordFileError, match=r"wall\.npz"):
        load_measured(with_reference)


def test_reference_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "wall.npz"
    np.savez(path, depth_m=np.zeros(3))
    with pytest.raises(RecordFileError, match=r"wall\.npz"):
        load_reference(path, hashlib.sha256(path.read_bytes()).hexdigest())


@pytest.mark.parametrize(
    ("changed", "field"),
    [
        ({"object_box": {"x_max_m": 1e308}}, "x_max_m"),
        ({"device": {"bin_m": 1e-300}}, "bin_m"),
        ({"lidar": {"distance_m": 1e-300}}, "distance_m"),
        ({"intrinsics": {"fx": 1e300}}, "fx"),
        ({"wall": {"x_min_m": -1e6}}, "x_min_m"),
    ],
)
def test_absurd_numbers_of_a_rig_are_refused(changed: dict[str, Any], field: str) -> None:
    rig = load_rig("paper-rig").model_dump()
    for part, values in changed.items():
        rig[part] |= values

    with pytest.raises(ValidationError, match=field):
        Rig.model_validate(rig)


def test_record_of_before_gravity_knows_no_way_up() -> None:
    record = load_wall(EXAMPLE)

    assert record.gravity_m_s2 is None
    assert record.way_up == "unknown"


@pytest.mark.parametrize(
    "gravity", [(0.0, 0.0, 0.0), (0.0, 2.0, 0.0), (9.8, 9.8, 9.8), (0, 1e9, 0)]
)
def test_record_refuses_a_gravity_that_is_none(
    tmp_path: Path, record: WallRecord, gravity: tuple[float, float, float]
) -> None:
    absurd = record.model_copy(update={"gravity_m_s2": gravity})
    with pytest.raises(RecordFileError, match="gravity_m_s2"):
        load_wall(written(tmp_path, absurd))
