"""Record of a measured wall, `wall.toml`: measurement, uncertainty, device and rig, with the
reference beside it.
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
from nlos_calibration.errors import CalibrationError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.gravity import Gravity, WayUp
from nlos_calibration.occluder import OccluderFit
from nlos_calibration.range_offset import Cause
from nlos_calibration.reference import BareWall, load_reference
from nlos_calibration.rig import (
    Finite,
    LidarPose,
    NotNegative,
    ObjectBox,
    OccluderRecord,
    PinholeRecord,
    Positive,
    Record,
    Rig,
    load_rig,
    read_record,
    record_kind,
)
from nlos_calibration.rig_check import combined, footprint, judge_rig, rig_with_occluder
from nlos_calibration.wall import Verdict, WallFit, range_verdict
from nlos_cam.files import read_toml

Row = tuple[Finite, Finite, Finite, Finite]
POSE_TOLERANCE = 1e-6
VERSION = 3
"""The one version of the format that is read and written."""


def _known_version(version: Any) -> Any:
    """Return the version. Raises ValueError for any other than VERSION."""
    if isinstance(version, int) and version != VERSION:
        raise ValueError(
            f"this nlos-cam reads version {VERSION} only: measure the wall again, or use the"
            " nlos-cam that wrote it"
        )
    return version


class WallRecord(Record):
    """A measured wall. Occluder and object box of `rig` may be edited by hand, its lidar pose is
    the measurement.
    """

    schema_version: Annotated[Literal[3], BeforeValidator(_known_version)] = VERSION
    created: date
    camera: str
    """URI of the camera or recording."""
    serial: str = ""
    """Serial number; empty where unknown, like firmware and settings."""
    firmware: str = ""
    settings: dict[str, Finite] = Field(default_factory=dict)
    """Device options as read back when streaming began."""
    temperatures_c: dict[str, Finite] = Field(default_factory=dict)
    """Means during the measurement, by the SDK's name; empty where the device reports none."""
    gravity_m_s2: Gravity | None = None
    """Mean of the accelerometer in the lidar frame, pointing down; None without one."""
    way_up: WayUp = "unknown"
    """By gravity, or as the owner said."""
    frames: Annotated[int, Field(gt=0)]
    """Number of frames averaged."""
    distance_m: Positive
    distance_std_m: NotNegative
    """Standard uncertainty, like all *_std."""
    facing_deg: Annotated[float, Field(ge=0, lt=90)]
    facing_std_deg: NotNegative
    yaw_deg: Finite
    yaw_std_deg: NotNegative
    pitch_deg: Finite
    pitch_std_deg: NotNegative
    wall_from_lidar: tuple[Row, Row, Row, Row]
    range_offset_m: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Length to add to the lidar's depth; the pose includes it (`range_offset`)."""
    range_offset_std_m: NotNegative | None = None
    """None where the offset was not measured."""
    range_offset_cause: Cause | None = None
    residual_m: NotNegative | None = None
    """None, like the further results of the depth, where that was refused and the plane is the
    board's alone.
    """
    noise_scale: NotNegative | None = None
    """Noise of a depth sample over nominal."""
    inlier_fraction: Annotated[float, Field(ge=0, le=1)] | None = None
    ripple_m: NotNegative | None = None
    bend_m: NotNegative | None = None
    bend_deg: NotNegative | None = None
    board: BoardRecord | None = None
    """Measurement by a printed board; None without one."""
    footprint_share: Annotated[float, Field(ge=0, le=1)]
    """Share of the map's 64 x 80 cells that meet the wall."""
    occluder: OccluderRecord | None = None
    """None where it was neither detected nor entered: then `rig` has the paper's."""
    reference: str = ""
    """Name of the file with the bare-wall reference, beside this one; empty where there is none."""
    reference_sha256: Annotated[str, Field(pattern="^([0-9a-f]{64})?$")] = ""
    verdict: Verdict
    advice: str
    wall_verdict: Verdict | None = None
    """Of the wall alone, like `wall_advice`: without the rig's problems. None in older records."""
    wall_advice: str = ""
    warnings: tuple[str, ...] = ()
    rig: Rig

    @model_validator(mode="after")
    def _one_pose(self) -> Self:
        """Check that the pose, which is stored in three forms, is the same in all."""
        # The three numbers define the matrix (`geometry`); it is stored for readers without this
        # package. The rig may be edited by hand, but not away from the measurement.
        lidar = LidarPose(
            distance_m=self.distance_m, yaw_deg=self.yaw_deg, pitch_deg=self.pitch_deg
        )
        if lidar != self.rig.lidar:
            raise ValueError(
                "rig.lidar differs from distance_m, yaw_deg and pitch_deg: measure the wall again"
            )
        if not np.allclose(
            self.wall_from_lidar, self.rig.wall_from_lidar, rtol=0.0, atol=POSE_TOLERANCE
        ):
            raise ValueError(
                "wall_from_lidar differs from the pose of rig.lidar: measure the wall again"
            )
        return self

    @property
    def beam_rig(self) -> Rig:
        """Rig of the lidar's beams: with the lidar where they meet, and in the wall frame of that
        point's foot.

        `rig` has the lidar in its front glass, which tapes and rulers reach. A range offset whose
        cause is the origin lies between the two: some millimetres of distance and of foot.
        """
        if self.range_offset_cause != "origin":
            return self.rig
        return self.rig.seen_from(wall_from_zero(self)[:3, 3])


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
    """Return the record of `fit`; its rig is the paper's with the measured pose and the camera's
    intrinsics.

    Without `occluder` the paper's is assumed. `others` are further fields: of the device, the
    board, the reference and the range offset.
    """
    # What a bench shares with the paper's (wall, relay, object box, device) stays the paper's until
    # it is edited by hand; pose and intrinsics are measured.
    lidar = LidarPose(distance_m=fit.distance_m, yaw_deg=fit.yaw_deg, pitch_deg=fit.pitch_deg)
    pinhole = PinholeRecord.model_validate(vars(intrinsics))
    rig = load_rig("paper-rig").model_copy(
        update={"name": "measured", "lidar": lidar, "intrinsics": pinhole}
    )
    rig = rig_with_occluder(rig, occluder.x_m, occluder.gap_m) if occluder else rig
    view = footprint(fit.wall_from_lidar, intrinsics, rig.wall)
    measured = {name: value for name, value in vars(fit).items() if name in WallRecord.model_fields}
    measured |= {
        "wall_from_lidar": fit.wall_from_lidar.tolist(),
        "footprint_share": view.share,
        "occluder": occluder,
    }
    verdict, advice = combined(fit.verdict, fit.advice, judge_rig(rig, view, occluder))
    measured |= {"verdict": verdict, "advice": advice, **(others or {})}
    measured |= {"wall_verdict": fit.verdict, "wall_advice": fit.advice}
    return WallRecord.model_validate(
        measured | {"camera": camera, "frames": frames, "created": created, "rig": rig}
    )


UNUSABLE = "do not use this record"
"""How the advice of an older record begins that was taken with something hidden."""


def with_occluder(record: WallRecord, fit: OccluderFit) -> WallRecord:
    """Return the record with an occluder that was detected since.

    Doubts about the wall itself stay; remarks on the previous occluder, the paper's or an earlier
    one, go. Raises CalibrationError where something seems to be hidden.
    """
    if fit.why_unusable:
        raise CalibrationError(f"{fit.why_unusable}; remove the object and measure again")
    measured = {
        name: value for name, value in vars(fit).items() if name in OccluderRecord.model_fields
    }
    occluder = OccluderRecord(source="detected", **measured)
    rig = rig_with_occluder(record.rig, occluder.x_m, occluder.gap_m)
    pose = np.array(record.wall_from_lidar)
    verdict, advice = _of_wall_alone(record)
    problems = judge_rig(rig, footprint(pose, rig.pinhole, rig.wall), occluder)
    verdict, advice = combined(verdict, advice, problems)
    changed = {"occluder": occluder, "rig": rig, "verdict": verdict, "advice": advice}
    # The record has the remarks on wall and occluder in one list, the occluder its own as well.
    former = record.occluder.warnings if record.occluder else ()
    of_wall = [one for one in record.warnings if one not in former]
    changed |= {"warnings": tuple(dict.fromkeys((*of_wall, *fit.warnings)))}
    return WallRecord.model_validate(record.model_dump() | changed)


def with_object_box(record: WallRecord, box: ObjectBox | None) -> WallRecord:
    """Return the record of a bench whose object box is another, and the verdict on that bench."""
    if box == record.rig.object_box:
        return record
    rig = record.rig.model_copy(update={"object_box": box})
    view = footprint(np.array(record.wall_from_lidar), rig.pinhole, rig.wall)
    problems = judge_rig(rig, view, record.occluder)
    verdict, advice = combined(*_of_wall_alone(record), problems)
    return record.model_copy(update={"rig": rig, "verdict": verdict, "advice": advice})


def _of_wall_alone(record: WallRecord) -> tuple[Verdict, str]:
    """Return a record's verdict and advice without the problems of its rig and occluder."""
    if record.wall_verdict is not None:
        return record.wall_verdict, record.wall_advice
    # An older record joins the wall's doubts with the rig's problems in one sentence, from which
    # these are taken out again; a wall without doubts is judged anew by its range.
    if record.verdict == "doubtful" and not record.advice.startswith(UNUSABLE):
        view = footprint(np.array(record.wall_from_lidar), record.rig.pinhole, record.rig.wall)
        earlier = "".join(f"; {one}" for one in judge_rig(record.rig, view, record.occluder))
        return record.verdict, record.advice.removesuffix(earlier)
    return range_verdict(record.distance_m, record.facing_deg)


def load_wall(path: Path) -> WallRecord:
    """Read a `wall.toml`. Raises RecordFileError with the first problem."""
    return read_record(
        path, WallRecord, "wall record", "write one with `nlos-cam calibrate --wall`"
    )


def rig_named(name: str) -> Rig:
    """Return a packaged rig by name, or the rig of a file: a rig.toml, or the wall.toml that
    `calibrate` writes, as its beams see it.
    """
    return load_wall(Path(name)).beam_rig if is_wall_record(name) else load_rig(name)


def is_wall_record(name: str) -> bool:
    """Return whether a name is that of a wall record's file; False for one that is no TOML."""
    path = Path(name)
    if not path.is_file():
        return False
    try:
        return record_kind(read_toml(path)) == "wall record"
    except (OSError, ValueError):
        return False  # whoever reads it as a rig says what is wrong with it


@dataclass(frozen=True)
class MeasuredWall:
    """Result of `calibrate --wall`."""

    record: WallRecord
    reference: BareWall | None
    """None for a record without one."""


def load_measured(path: Path) -> MeasuredWall:
    """Read a `wall.toml` and its reference. Raises RecordFileError if one cannot be read, or they
    do not match.
    """
    record = load_wall(path)
    if not record.reference:
        return MeasuredWall(record, None)
    reference = load_reference(path.parent / record.reference, record.reference_sha256)
    return MeasuredWall(record, reference)


def wall_points_m(record: WallRecord, reference: BareWall) -> Float64:
    """Return the reference's pixels (height, width, 3) in the wall frame, where z is the distance
    off the plane.
    """
    return points_m(record, reference.depth_m.astype(np.float64), reference.intrinsics)


def points_m(record: WallRecord, depth_m: Float64, intrinsics: Intrinsics) -> Float64:
    """Return depths (height, width) as points (height, width, 3) in the wall frame, range offset
    included.
    """
    # p = R (depth x ray) + t, with the offset added to the depth or, through the pose, to the
    # origin
    pose = wall_from_zero(record)
    true_m = depth_m[..., np.newaxis] + depth_offset_m(record)
    return (true_m * intrinsics.rays()) @ pose[:3, :3].T + pose[:3, 3]


def depth_offset_m(record: WallRecord) -> float:
    """Return the length to add to each depth: the range offset if its cause is the depth, else
    0.
    """
    return record.range_offset_m if record.range_offset_cause == "depth" else 0.0


def wall_from_zero(record: WallRecord) -> Float64:
    """Return the pose (4, 4) of the point where the beams meet, which an offset of the origin puts
    before the glass.
    """
    # The record's pose is that of the glass. An offset of the origin puts the zero of depth that
    # far along the optical axis, the third column; an offset of the depth leaves it in the glass.
    pose = np.array(record.wall_from_lidar)
    pose[:3, 3] += (record.range_offset_m - depth_offset_m(record)) * pose[:3, 2]
    return pose
