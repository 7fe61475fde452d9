"""The record of a measured wall, `wall.toml`: what was measured, from what, how surely, and the rig it yields.

A measured wall as it lies on disk: its record, and the reference of the bare wall beside it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from nlos_calibration.arrays import Float64
from nlos_calibration.board_wall import BoardRecord, WallByBoard
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.occluder import OccluderFit, rig_with_occluder
from nlos_calibration.range_offset import Cause
from nlos_calibration.reference import BareWall, load_reference
from nlos_calibration.rig import (
    Finite,
    LidarPose,
    NotNegative,
    OccluderRecord,
    PinholeRecord,
    Positive,
    Record,
    Rig,
    load_rig,
    read_record,
)
from nlos_calibration.rig_check import combined, footprint, judge_rig
from nlos_calibration.wall import Verdict, WallFit, range_verdict

Row = tuple[Finite, Finite, Finite, Finite]
POSE_TOLERANCE = 1e-6
VERSION = 3
"""2 adds to 1 what is None, empty or 0 by default: uncertainties, flatness, device, board, reference, offset; and 3
temperatures, footprint and occluder."""


def _upgraded(version: Any) -> Any:
    """The version once read; those that this program does not know are refused."""
    if isinstance(version, int) and version > VERSION:
        raise ValueError(f"written by a newer nlos-cam, this one reads up to {VERSION}: update it, or measure again")
    return VERSION if version in (1, 2) else version


class WallRecord(Record):
    """A measured wall. Occluder and object box of `rig` may be edited by hand; its lidar is what was measured."""

    schema_version: Annotated[Literal[3], BeforeValidator(_upgraded)] = VERSION
    created: date
    camera: str
    """The URI of the camera or recording."""
    serial: str = ""
    """Of the device; empty where it is not known, like the firmware and the settings."""
    firmware: str = ""
    settings: dict[str, Finite] = Field(default_factory=dict)
    """The device's options as read back when streaming began."""
    temperatures_c: dict[str, Finite] = Field(default_factory=dict)
    """Means while the wall was looked at, by the SDK's name; empty where the device tells none."""
    frames: Annotated[int, Field(gt=0)]
    """How many were averaged."""
    distance_m: Positive
    distance_std_m: NotNegative | None = None
    """Standard uncertainty, as are all *_std; None in records of version 1."""
    facing_deg: Annotated[float, Field(ge=0, lt=90)]
    facing_std_deg: NotNegative | None = None
    yaw_deg: Finite
    yaw_std_deg: NotNegative | None = None
    pitch_deg: Finite
    pitch_std_deg: NotNegative | None = None
    wall_from_lidar: tuple[Row, Row, Row, Row]
    range_offset_m: Finite = 0.0
    """What is to be added to the lidar's depth; the pose has it in it (`range_offset`)."""
    range_offset_std_m: NotNegative | None = None
    """None where the offset was not measured."""
    range_offset_cause: Cause | None = None
    residual_m: NotNegative | None = None
    """None, like what else is the depth's, where the depth was refused and the plane is the board's alone."""
    noise_scale: NotNegative | None = None
    """The noise of a depth sample over the lidar's nominal."""
    inlier_fraction: Annotated[float, Field(ge=0, le=1)] | None = None
    ripple_m: NotNegative | None = None
    bend_m: NotNegative | None = None
    bend_deg: NotNegative | None = None
    board: BoardRecord | None = None
    """What a printed board said; None where none was asked for."""
    footprint_share: Annotated[float, Field(ge=0, le=1)] | None = None
    """Of the map's 64 x 80 cells, those that meet the wall."""
    occluder: OccluderRecord | None = None
    """None where it was neither found nor entered: then `rig` has the paper's."""
    reference: str = ""
    """The file of the bare wall's reference maps, beside this one; empty where there is none."""
    reference_sha256: Annotated[str, Field(pattern="^([0-9a-f]{64})?$")] = ""
    verdict: Verdict
    advice: str
    warnings: tuple[str, ...] = ()
    rig: Rig

    @model_validator(mode="after")
    def _one_pose(self) -> Self:
        """The pose is written three ways for its readers; all must say the same."""
        lidar = LidarPose(distance_m=self.distance_m, yaw_deg=self.yaw_deg, pitch_deg=self.pitch_deg)
        if lidar != self.rig.lidar:
            raise ValueError("rig.lidar differs from distance_m, yaw_deg and pitch_deg: measure the wall again")
        if not np.allclose(self.wall_from_lidar, self.rig.wall_from_lidar, rtol=0.0, atol=POSE_TOLERANCE):
            raise ValueError("wall_from_lidar differs from the pose of rig.lidar: measure the wall again")
        return self


def new_wall_record(
    fit: WallFit | WallByBoard,
    intrinsics: Intrinsics,
    *,
    camera: str,
    frames: int,
    created: date,
    occluder: OccluderRecord | None = None,
    others: Mapping[str, object] | None = None,
) -> WallRecord:
    """The record of `fit`; its rig is the paper's with the measured pose and the camera's intrinsics.

    An `occluder` stands where it says, else where the paper's does. `others` are further fields: the device's, the
    board's, the reference's, the range offset's.
    """
    rig = _rig(fit, intrinsics)
    rig = rig_with_occluder(rig, occluder.x_m, occluder.gap_m) if occluder else rig
    seen = footprint(fit.wall_from_lidar, intrinsics, rig.wall)
    measured = {name: value for name, value in vars(fit).items() if name in WallRecord.model_fields}
    measured |= {"wall_from_lidar": fit.wall_from_lidar.tolist(), "footprint_share": seen.share, "occluder": occluder}
    verdict, advice = combined(fit.verdict, fit.advice, judge_rig(rig, seen, occluder))
    measured |= {"verdict": verdict, "advice": advice, **(others or {})}
    return WallRecord.model_validate(measured | {"camera": camera, "frames": frames, "created": created, "rig": rig})


def _rig(fit: WallFit | WallByBoard, intrinsics: Intrinsics) -> Rig:
    lidar = LidarPose(distance_m=fit.distance_m, yaw_deg=fit.yaw_deg, pitch_deg=fit.pitch_deg)
    pinhole = PinholeRecord.model_validate(vars(intrinsics))
    return load_rig("paper-rig").model_copy(update={"name": "measured", "lidar": lidar, "intrinsics": pinhole})


def with_occluder(record: WallRecord, fit: OccluderFit) -> WallRecord:
    """The record with an occluder that was found since; what the wall itself leaves in doubt stays.

    What was said of the occluder before, the paper's or an earlier one, goes.
    """
    found = {name: value for name, value in vars(fit).items() if name in OccluderRecord.model_fields}
    occluder = OccluderRecord(source="detected", **found)
    rig = rig_with_occluder(record.rig, occluder.x_m, occluder.gap_m)
    pose = np.array(record.wall_from_lidar)
    if record.verdict == "doubtful":
        assumed = judge_rig(record.rig, footprint(pose, record.rig.pinhole, record.rig.wall), record.occluder)
        wall = record.verdict, record.advice.removesuffix("".join(f"; {problem}" for problem in assumed))
    else:
        wall = range_verdict(record.distance_m, record.facing_deg)
    verdict, advice = combined(*wall, judge_rig(rig, footprint(pose, rig.pinhole, rig.wall), occluder))
    changed = {"occluder": occluder, "rig": rig, "verdict": verdict, "advice": advice}
    told = {"warnings": tuple(dict.fromkeys((*record.warnings, *fit.warnings)))}
    return WallRecord.model_validate(record.model_dump() | changed | told)


def load_wall(path: Path) -> WallRecord:
    """Read a `wall.toml`, of this version or an older one.

    Raises RecordFileError, with the first problem, where it is not one.
    """
    return read_record(path, WallRecord, "wall record", "write one with `nlos-cam calibrate --wall`")


def rig_named(name: str) -> Rig:
    """A packaged rig by name, or the rig of a file: a rig.toml, or the wall.toml that `calibrate` writes."""
    path = Path(name)
    if path.is_file() and "schema_version" in path.read_text(encoding="utf-8", errors="replace"):
        return load_wall(path).rig
    return load_rig(name)


@dataclass(frozen=True)
class MeasuredWall:
    """What `calibrate --wall` left behind."""

    record: WallRecord
    reference: BareWall | None
    """None for a record that names none."""


def load_measured(path: Path) -> MeasuredWall:
    """Read a `wall.toml` and the reference beside it.

    Raises RecordFileError where one of them cannot be read, or where they do not belong together.
    """
    record = load_wall(path)
    named = record.reference
    return MeasuredWall(record, load_reference(path.parent / named, record.reference_sha256) if named else None)


def wall_points_m(record: WallRecord, reference: BareWall) -> Float64:
    """The reference's pixels (height, width, 3) in the wall frame, NaN where no return: z is how far off the plane."""
    return points_m(record, reference.depth_m.astype(np.float64), reference.intrinsics)


def points_m(record: WallRecord, depth_m: Float64, intrinsics: Intrinsics) -> Float64:
    """Depths (height, width) of the lidar as points (height, width, 3) in the wall frame.

    The lidar's range offset is allowed for as it is in the record's pose.
    """
    pose = wall_from_zero(record)
    return ((depth_m[..., np.newaxis] + depth_offset_m(record)) * intrinsics.rays()) @ pose[:3, :3].T + pose[:3, 3]


def depth_offset_m(record: WallRecord) -> float:
    """What is to be added to each depth before it is a point: the range offset, where depth is its cause."""
    return record.range_offset_m if record.range_offset_cause == "depth" else 0.0


def wall_from_zero(record: WallRecord) -> Float64:
    """The pose (4, 4) of where the beams meet: the lidar's, but that an offset of the origin is before the glass."""
    pose = np.array(record.wall_from_lidar)
    pose[:3, 3] += (record.range_offset_m - depth_offset_m(record)) * pose[:3, 2]
    return pose
