"""The record of a measured wall, `wall.toml`: what was measured, from what, and the rig it yields."""

from datetime import date
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import Finite, LidarPose, PinholeRecord, Positive, Record, Rig, load_rig, read_record
from nlos_calibration.wall import Verdict, WallFit

Row = tuple[Finite, Finite, Finite, Finite]
POSE_TOLERANCE = 1e-6


class WallRecord(Record):
    """A measured wall. Occluder and object box of `rig` may be edited by hand; its lidar is what was measured."""

    schema_version: Literal[1] = 1
    created: date
    camera: str
    """The URI of the camera or recording."""
    frames: Annotated[int, Field(gt=0)]
    """How many were averaged."""
    distance_m: Positive
    facing_deg: Annotated[float, Field(ge=0, lt=90)]
    yaw_deg: Finite
    pitch_deg: Finite
    wall_from_lidar: tuple[Row, Row, Row, Row]
    residual_m: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    inlier_fraction: Annotated[float, Field(ge=0, le=1)]
    verdict: Verdict
    advice: str
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


def wall_record(fit: WallFit, intrinsics: Intrinsics, *, camera: str, frames: int, created: date) -> WallRecord:
    """The record of `fit`; its rig is the paper's with the measured pose and the camera's intrinsics."""
    lidar = LidarPose(distance_m=fit.distance_m, yaw_deg=fit.yaw_deg, pitch_deg=fit.pitch_deg)
    pinhole = PinholeRecord.model_validate(vars(intrinsics))
    rig = load_rig("paper-rig").model_copy(update={"name": "measured", "lidar": lidar, "intrinsics": pinhole})
    measured = vars(fit) | {"wall_from_lidar": fit.wall_from_lidar.tolist()}
    return WallRecord.model_validate(measured | {"camera": camera, "frames": frames, "created": created, "rig": rig})


def load_wall(path: Path) -> WallRecord:
    """Read a `wall.toml`. Raises RecordFileError, with the first problem, where it is not one."""
    return read_record(path, WallRecord, "wall record", "write one with `nlos-cam calibrate --wall`")


def rig_named(name: str) -> Rig:
    """A packaged rig by name, or the rig of a file: a rig.toml, or the wall.toml that `calibrate` writes."""
    path = Path(name)
    if path.is_file() and "schema_version" in path.read_text(encoding="utf-8", errors="replace"):
        return load_wall(path).rig
    return load_rig(name)
