"""Rig record: lidar pose and intrinsics, wall, occluder, object box and device constants, as
validated TOML.
"""

import hashlib
import re
import tomllib
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from importlib.resources.abc import Traversable
from math import degrees, radians
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, cast

import numpy as np
import tomli_w
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from nlos_calibration.errors import RecordFileError, UnknownRigError
from nlos_calibration.geometry import (
    Intrinsics,
    facing_angle_rad,
    normal_from_angles,
    wall_from_plane,
)
from nlos_cam.files import read_toml

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
# Bounds that no bench reaches: numbers beyond them are typing errors or damage, and would overflow
# in products of lengths far from the place that names the field.
Coordinate = Annotated[float, Field(ge=-100, le=100)]
Length = Annotated[float, Field(ge=1e-9, le=100)]
FocalLength = Annotated[float, Field(ge=1, le=1e6)]
PixelPlace = Annotated[float, Field(ge=-1e5, le=1e5)]
Pixels = Annotated[int, Field(gt=0, le=16384)]
R = TypeVar("R", bound=BaseModel)
KINDS = {
    "schema_version": "wall record",
    "bench_version": "bench",
    "task": "training recipe",
    "base": "rig",
    "lidar": "rig",
    "rig": "scene",
}
"""Kind of a TOML file by a field of it, in this order: a wall record has a rig too."""
WORDING = {
    "^Value error, ": "",
    "^Field required$": "is missing",
    "^Extra inputs are not permitted$": "is no known field",
    "^Input should be ": "must be ",
    "a valid integer.*": "a whole number",
    "a valid (dictionary|mapping).*": "a table",
    "(a )?valid (number|string|boolean|list|tuple|date).*": r"a \2",
}
"""Phrases of pydantic as patterns, and how a person says them."""


class Record(BaseModel):
    """Frozen record that rejects unknown fields."""

    # A mistyped key would otherwise leave its field at the default without a word.
    model_config = ConfigDict(frozen=True, extra="forbid")


class Extent(Record):
    """A rectangle on the wall, in the wall frame."""

    x_min_m: Coordinate
    x_max_m: Coordinate
    y_min_m: Coordinate
    y_max_m: Coordinate

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.x_min_m >= self.x_max_m or self.y_min_m >= self.y_max_m:
            raise ValueError("an extent needs x_min_m < x_max_m and y_min_m < y_max_m")
        return self

    def contains(self, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return the mask (...) of the points (..., 2 or 3) whose wall x and y lie within it."""
        x_m = points_m[..., 0]
        y_m = points_m[..., 1]
        return (
            (x_m >= self.x_min_m)
            & (x_m <= self.x_max_m)
            & (y_m >= self.y_min_m)
            & (y_m <= self.y_max_m)
        )


OBJECT_SIDE = (
    "the hidden object must be at positive x, to the lidar's right: mirror the bench, or turn the"
    " lidar upside down"
)
"""Maps end with the column farthest from the lidar's foot, as the networks learn them."""


class ObjectBox(Extent):
    """Box that holds the hidden object: an extent at positive x, and the depths of v = 1 (near) and
    v = 0.1 (far).
    """

    z_near_m: Length
    z_far_m: Length

    @model_validator(mode="after")
    def _deep(self) -> Self:
        if self.z_near_m >= self.z_far_m:
            raise ValueError("an object box needs z_near_m < z_far_m")
        if self.x_max_m <= 0:
            raise ValueError(f"an object box needs x_max_m > 0: {OBJECT_SIDE}")
        return self


class Occluder(Record):
    """Half plane x = x_m, z >= z_min_m, endless in y, that hides the object from the lidar."""

    x_m: Coordinate
    z_min_m: Length


class OccluderRecord(Record):
    """The occluder as detected or as entered by hand; `rig.occluder` is its half plane."""

    source: Literal["detected", "entered"]
    x_m: Coordinate
    """Wall x of the edge."""
    gap_m: Length
    """Distance from the edge to the wall: the aperture."""
    x_std_m: NotNegative | None = None
    """None, like gap_std_m and tilt_deg, if entered by hand."""
    gap_std_m: NotNegative | None = None
    tilt_deg: Finite | None = None
    """Tilt of the sheet against the plane x = x_m, about wall y; positive leans away from the
    lidar.
    """
    warnings: tuple[str, ...] = ()
    """Remarks of its measurement, which are among the wall record's too."""


class LidarPose(Record):
    """The lidar's pose in the wall frame: the three numbers that the frame's definition leaves
    free.
    """

    # A pose has six. The frame's origin is the foot of the lidar's perpendicular, which fixes two
    # of the position, and its x axis is the lidar's, which fixes the roll (`geometry`).
    distance_m: Length
    yaw_deg: Annotated[float, Field(gt=-90, lt=90)]
    """Positive turns the axis towards wall +x."""
    pitch_deg: Annotated[float, Field(gt=-90, lt=90)] = 0.0
    """Positive turns the axis towards wall +y (up)."""


class PinholeRecord(Record):
    """Pinhole intrinsics in pixels; the default is a field of view of 70 x 55 degrees at 640 x
    480.
    """

    # fx = (640 / 2) / tan(70 deg / 2) and fy = (480 / 2) / tan(55 deg / 2), the L515's field of
    # view; the centre of an even number of pixels lies between two of them.
    width: Pixels = 640
    height: Pixels = 480
    fx: FocalLength = 457.0073622
    fy: FocalLength = 461.0357105
    ppx: PixelPlace = 319.5
    ppy: PixelPlace = 239.5


class DeviceConstants(Record):
    """Constants of the device beside its geometry."""

    # A bin of 10 mm of path is 33 ps of flight; 100 ns of gate are 30 m of path.
    receiver_cell_m2: Annotated[float, Field(ge=1e-12, le=1)] = 1e-4
    """S_unit_wall of S1, a constant of the device, independent of any grid."""
    bin_m: Annotated[float, Field(ge=1e-5, le=10)] = 0.01
    """Width of a path-length bin (S4)."""
    gate_s: Annotated[float, Field(ge=1e-12, le=1e-3)] = 100e-9
    """Latest echo that is received (S5)."""


class Rig(Record):
    """The whole set-up except the hidden object."""

    name: str
    lidar: LidarPose
    intrinsics: PinholeRecord = PinholeRecord()
    # Two extents, since the wall is metres wide, while S2's sum needs a fine grid over the part
    # that light comes back from.
    wall: Extent
    """The physical wall: beams that miss it give no return."""
    relay: Extent
    """Part of the wall that third bounces are collected from: the sum of S2 runs over it."""
    occluder: Occluder | None = None
    object_box: ObjectBox | None = None
    device: DeviceConstants = DeviceConstants()

    @property
    def wall_from_lidar(self) -> NDArray[np.float64]:
        """Pose (4, 4) of the lidar in the wall frame."""
        normal = normal_from_angles(radians(self.lidar.yaw_deg), radians(self.lidar.pitch_deg))
        return wall_from_plane(normal, self.lidar.distance_m)

    @property
    def facing_deg(self) -> float:
        """Angle between the optical axis and the wall's normal."""
        return degrees(facing_angle_rad(self.wall_from_lidar))

    @property
    def pinhole(self) -> Intrinsics:
        """Intrinsics of the depth stream."""
        return Intrinsics(**self.intrinsics.model_dump())

    @property
    def checksum(self) -> str:
        """Twelve hexadecimal digits that change with any field; datasets and weights store them."""
        # Pydantic writes fields in the order of their declaration, and floats in their shortest
        # exact form: equal rigs give equal bytes on every machine.
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:12]

    def seen_from(self, eye_m: NDArray[np.float64]) -> "Rig":
        """Return the same bench with the lidar at another point (3,) of the wall frame, in that
        point's own wall frame, whose origin is its foot.
        """
        # The frame's axes are the wall's and the lidar's, which a shift of the lidar does not turn:
        # what stands on the bench moves along the wall by as much as the foot does, the other way.
        along_m, up_m, distance_m = (float(value) for value in eye_m)
        shifts_m = {"x": along_m, "y": up_m}

        def moved(part: R) -> R:
            places_m = {
                name: place_m - shifts_m[name[0]]
                for name, place_m in part
                if name.startswith(("x_", "y_"))
            }
            # Not validated: an endless wall's numbers may lie on the bounds of a file's.
            return part.model_copy(update=places_m)

        changed: dict[str, object] = {
            "lidar": self.lidar.model_copy(update={"distance_m": distance_m}),
            "wall": moved(self.wall),
            "relay": moved(self.relay),
        }
        if self.occluder:
            changed["occluder"] = moved(self.occluder)
        if self.object_box:
            changed["object_box"] = moved(self.object_box)
        return self.model_copy(update=changed)


def first_problem(error: ValidationError) -> str:
    """Return the first problem of a validation as one line: field, problem, value."""
    problem = error.errors()[0]
    field = ".".join(str(part) for part in problem["loc"])
    text = problem["msg"]
    value = problem["input"]
    for library, plain in WORDING.items():
        text = re.sub(library, plain, text)
    if isinstance(value, dict):
        # A rule among several fields: show the values of those that its message names.
        got = ", ".join(
            f"{name} = {given!r:.40}"
            for name, given in value.items()
            if re.search(rf"\b{re.escape(str(name))}\b", text) and str(given) not in text
        )
    elif isinstance(value, list):
        got = ""
    else:
        got = f"{value!r:.80}"
    ending = f" (got {got})" if got else ""
    return f"{field or 'record'}: {text}{ending}"


def record_kind(content: Mapping[str, object]) -> str:
    """Return the kind of file that a TOML document is, by a field that only this kind has; empty if
    unknown.
    """
    return next((kind for field, kind in KINDS.items() if field in content), "")


def packaged_rigs() -> list[Path]:
    """Return the files of the rigs that come with the package."""
    return sorted((Path(__file__).parent / "rigs").glob("*.toml"))


def load_rig(name_or_path: str | Path) -> Rig:
    """Load a packaged rig by name (`paper-rig`, `bare-wall`), or a rig from a TOML file; a file of
    that name goes first.

    Raises RecordFileError where it cannot be read, UnknownRigError for a name that no rig has.
    """
    packaged = {path.stem: path for path in packaged_rigs()}
    source = Path(name_or_path)
    if str(name_or_path) in packaged and not source.is_file():
        source = packaged[str(name_or_path)]
    elif not source.exists() and str(name_or_path) == source.stem:
        near = get_close_matches(source.stem, packaged, 1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise UnknownRigError(
            f"no rig {source.stem!r}.{hint} Give {' or '.join(packaged)}, or a rig's TOML file"
        )
    return read_record(
        source,
        Rig,
        "rig",
        "give a packaged name (paper-rig) or a file",
        lambda content: with_base(content, source.parent, source.stem),
    )


def with_base(content: dict[str, Any], folder: Path, name: str) -> dict[str, Any]:
    """Return a rig's fields with those of the rig that its `base` names, where it has none of its
    own; without a `base` as they are.

    The base is a packaged rig, or a whole rig's file in `folder`; `name` is the name of a rig that
    gives none. Raises RecordFileError for a base that cannot be used.
    """
    if "base" not in content:
        return content
    base = content["base"]
    if not isinstance(base, str) or not base:
        raise RecordFileError(f"base must be the name or file of a rig (got {base!r:.40})")
    beside = folder / base
    if beside.is_file():
        try:
            nested = "base" in read_toml(beside)
        except (OSError, ValueError):
            nested = False  # load_rig says what is wrong with it
        if nested:
            raise RecordFileError(f"base {beside} has a base of its own: name a whole rig")
    whole = load_rig(beside if beside.is_file() else base).model_dump()
    changes = {key: value for key, value in content.items() if key != "base"}
    return _merged(whole, {"name": name} | changes)


def _merged(whole: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return nested tables with the values that `changes` has; others stay."""
    merged = dict(whole)
    for key, value in changes.items():
        before: Any = merged.get(key)
        both = isinstance(before, dict) and isinstance(value, dict)
        merged[key] = _merged(cast("dict[str, Any]", before), value) if both else value
    return merged


def read_record(
    source: Traversable,
    model: type[R],
    kind: str,
    advice: str,
    complete: Callable[[dict[str, Any]], dict[str, Any]] = lambda content: content,
) -> R:
    """Read a validated record from a TOML file, whose content `complete` may add to. Raises
    RecordFileError, with `advice` if there is no such file.
    """
    content: dict[str, Any] = {}
    if source.is_dir():
        raise RecordFileError(f"{source} is a folder, not a {kind}: give a bench folder as --bench")
    try:
        content = read_toml(Path(str(source)))
        return model.model_validate(complete(content))
    except FileNotFoundError as error:
        raise RecordFileError(f"no {kind} {source}: {advice}") from error
    except ValidationError as error:
        # A scene given for a wall lacks a dozen fields: its kind says more than the first of them.
        if (other := record_kind(content)) not in {"", kind}:
            if other == "bench":
                advice = f"name its folder, {Path(str(source)).parent}, as a bench"
            raise RecordFileError(f"{source} is a {other}, not a {kind}: {advice}") from error
        raise RecordFileError(f"{source} is not a {kind}: {first_problem(error)}") from error
    except UnicodeDecodeError as error:
        raise RecordFileError(f"{source} is a binary file, not a TOML {kind}: {advice}") from error
    except (OSError, tomllib.TOMLDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordFileError(f"{source} cannot be read as TOML ({reason}): {advice}") from error


def dump_toml(record: BaseModel) -> str:
    """Return a record as TOML text; fields that are None are omitted, since TOML has no null."""
    return tomli_w.dumps(record.model_dump(mode="json", exclude_none=True))
