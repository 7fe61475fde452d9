"""A rig: lidar pose and intrinsics, wall, occluder, object box, device constants. One validated TOML record."""

import hashlib
import tomllib
from importlib import resources
from importlib.resources.abc import Traversable
from math import degrees, radians
from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

import numpy as np
import tomli_w
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from nlos_calibration.errors import RecordFileError
from nlos_calibration.geometry import Intrinsics, facing_angle_rad, normal_from_angles, wall_from_plane

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
R = TypeVar("R", bound=BaseModel)


class Record(BaseModel):
    """A frozen record that refuses fields it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Extent(Record):
    """A rectangle on the wall, in the wall frame."""

    x_min_m: Finite
    x_max_m: Finite
    y_min_m: Finite
    y_max_m: Finite

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.x_min_m >= self.x_max_m or self.y_min_m >= self.y_max_m:
            raise ValueError("an extent needs x_min_m < x_max_m and y_min_m < y_max_m")
        return self


class ObjectBox(Extent):
    """The box that hidden objects live in: an extent, and the depths that v = 1 (near) and v = 0.1 (far) mean."""

    z_near_m: Positive
    z_far_m: Positive

    @model_validator(mode="after")
    def _deep(self) -> Self:
        if self.z_near_m >= self.z_far_m:
            raise ValueError("an object box needs z_near_m < z_far_m")
        return self


class Occluder(Record):
    """The half plane x = x_m, z >= z_min_m, endless in y, that hides the object from the lidar."""

    x_m: Finite
    z_min_m: Positive


class OccluderRecord(Record):
    """The occluder as it was found, or as somebody says it stands; `rig.occluder` is its half plane."""

    source: Literal["detected", "entered"]
    x_m: Finite
    """Wall x of its edge."""
    gap_m: Positive
    """Between its edge and the wall: the aperture."""
    x_std_m: NotNegative | None = None
    """None, as gap_std_m and tilt_deg, where it was entered."""
    gap_std_m: NotNegative | None = None
    tilt_deg: Finite | None = None
    """Of its sheet against the plane x = x_m, about wall y; positive leans away from the lidar's foot."""


class LidarPose(Record):
    """The lidar's pose in the wall frame. Its three numbers are all that the frame's definition leaves free."""

    distance_m: Positive
    yaw_deg: Annotated[float, Field(gt=-90, lt=90)]
    """Positive turns the axis towards wall +x."""
    pitch_deg: Annotated[float, Field(gt=-90, lt=90)] = 0.0
    """Positive turns the axis towards wall +y (up)."""


class PinholeRecord(Record):
    """Pinhole intrinsics in pixels; the default is a field of view of 70 x 55 degrees at 640 x 480."""

    width: Annotated[int, Field(gt=0)] = 640
    height: Annotated[int, Field(gt=0)] = 480
    fx: Positive = 457.0073622
    fy: Positive = 461.0357105
    ppx: Finite = 319.5
    ppy: Finite = 239.5


class DeviceConstants(Record):
    """What the device adds to the geometry."""

    receiver_cell_m2: Positive = 1e-4
    """S_unit_wall of S1, a constant of the device and not of any grid."""
    bin_m: Positive = 0.01
    """Width of a path-length bin (S4)."""
    gate_s: Positive = 100e-9
    """Echoes later than this are not received (S5)."""


class Rig(Record):
    """Everything about the bench but the hidden object."""

    name: str
    lidar: LidarPose
    intrinsics: PinholeRecord = PinholeRecord()
    wall: Extent
    """The physical wall: beams that miss it give no return."""
    relay: Extent
    """The part of the wall that third bounces are collected from: the sum of S2 runs over it."""
    occluder: Occluder | None = None
    object_box: ObjectBox | None = None
    device: DeviceConstants = DeviceConstants()

    @property
    def wall_from_lidar(self) -> NDArray[np.float64]:
        """The pose (4, 4)."""
        normal = normal_from_angles(radians(self.lidar.yaw_deg), radians(self.lidar.pitch_deg))
        return wall_from_plane(normal, self.lidar.distance_m)

    @property
    def facing_deg(self) -> float:
        """The angle between the optical axis and the wall's normal."""
        return degrees(facing_angle_rad(self.wall_from_lidar))

    @property
    def pinhole(self) -> Intrinsics:
        """The intrinsics of the depth stream."""
        return Intrinsics(**self.intrinsics.model_dump())

    @property
    def checksum(self) -> str:
        """Twelve hexadecimal digits that change with any field: what datasets and weights are tied to."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:12]


def first_problem(error: ValidationError) -> str:
    """The first problem of a validation as one line: the field, what is wrong, the value."""
    problem = error.errors()[0]
    field = ".".join(str(part) for part in problem["loc"]) or "record"
    return f"{field}: {problem['msg']} (got {problem['input']!r:.80})"


def load_rig(name_or_path: str | Path) -> Rig:
    """A packaged rig by name (`paper-rig`, `bare-wall`), or a rig from a TOML file.

    Raises RecordFileError where it cannot be read.
    """
    packaged = resources.files("nlos_calibration") / "rigs" / f"{name_or_path}.toml"
    source = packaged if packaged.is_file() else Path(name_or_path)
    return read_record(source, Rig, "rig", "give a packaged name (paper-rig) or a file")


def read_record(source: Traversable, model: type[R], what: str, advice: str) -> R:
    """A validated record from a TOML file. Raises RecordFileError, with `advice` where there is no such file."""
    try:
        return model.model_validate(tomllib.loads(source.read_text(encoding="utf-8")))
    except FileNotFoundError as error:
        raise RecordFileError(f"no {what} {source}: {advice}") from error
    except ValidationError as error:
        raise RecordFileError(f"{source} is not a {what}: {first_problem(error)}") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise RecordFileError(f"{source} cannot be read as TOML: {error}") from error


def dump_toml(record: BaseModel) -> str:
    """Any record as TOML text; fields that are None are left out, since TOML has no null."""
    return tomli_w.dumps(record.model_dump(mode="json", exclude_none=True))
