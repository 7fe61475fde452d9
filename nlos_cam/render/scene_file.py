"""Scene files (`scene.toml`): rig, hidden object, motion, sensor model and faults as one validated
record.
"""

import hashlib
import tomllib
from dataclasses import replace
from math import pi, radians, sin
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

import numpy as np
from nlos_calibration import (
    Record,
    Rig,
    first_problem,
    load_rig,
    record_kind,
    rig_named,
    with_base,
)
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import RecordFileError
from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from nlos_cam import objects as shapes
from nlos_cam.errors import SceneError, SceneFileError
from nlos_cam.files import read_toml
from nlos_cam.render.material import Material
from nlos_cam.render.scene import Radiometry, Scene
from nlos_cam.render.sensor.model import SensorModel


def _known(category: str) -> str:
    if category not in shapes.CATEGORIES:
        raise ValueError(f"no such category: choose one of {', '.join(shapes.CATEGORIES)}")
    return category


def _mesh(value: object) -> shapes.MeshFile:
    if isinstance(value, shapes.MeshFile):
        return value
    if not isinstance(value, str | Path):
        raise PydanticCustomError("mesh_file", "must be the path of a mesh")
    try:
        return shapes.read_mesh(Path(value))
    except SceneError as error:
        raise PydanticCustomError("mesh_file", "{problem}", {"problem": str(error)}) from error


def _within(low: float, high: float) -> AfterValidator:
    """Return a validator of a range that also rejects NaN, with both ends in its message."""

    def check(value: float) -> float:
        if not low <= value <= high:
            raise PydanticCustomError(
                "range", "must be from {low} to {high}", {"low": f"{low:g}", "high": f"{high:g}"}
            )
        return value

    return AfterValidator(check)


Mesh = Annotated[
    shapes.MeshFile, PlainValidator(_mesh), PlainSerializer(lambda mesh: str(mesh.path), str)
]
Size = Annotated[float, _within(0.001, 10)]
Length = Annotated[float, _within(-10, 10)]
Reach = Annotated[float, _within(0, 10)]
Angle = Annotated[float, _within(-360, 360)]


class HiddenObject(Record):
    """Hidden object at rest: a variation of a procedural category, or a mesh from a file, and its
    pose.
    """

    category: Annotated[str, AfterValidator(_known)] | None = None
    seed: int = Field(default=0, ge=0)
    """Index of the category's variation."""
    size_m: Size = 0.18
    """Larger of the extents along x and y after turning; the unit of a mesh's file does not
    matter.
    """
    tilt_x_deg: Angle = 0.0
    tilt_y_deg: Angle = 0.0
    turn_deg: Angle = 0.0
    x_m: Length = 0.0
    y_m: Length = 0.0
    front_m: Reach = 0.03
    """Distance from the box's near side to the object's nearest point."""
    file: Mesh | None = None
    """A .obj, .stl or .ply; in a scene file relative to its folder."""
    up: shapes.Up = "y"
    """Axis of the mesh's file that points up."""
    material: Material = Material()

    @model_validator(mode="after")
    def _one_thing(self) -> Self:
        if (self.category is None) == (self.file is None):
            raise PydanticCustomError("one_thing", "give either category or file")
        if self.file and self.seed:
            raise PydanticCustomError(
                "seed", "seed applies to a category: a file has no variations"
            )
        if self.category and self.up != "y":
            raise PydanticCustomError("up", "up applies to a file: a category has y up")
        return self

    @property
    def label(self) -> str:
        """Name for messages: the category, or the file's path."""
        return str(self.file.path) if self.file else str(self.category)

    @property
    def triangles(self) -> Float64:
        """(n, 3, 3), before placing: y up, -z towards the wall."""
        return (
            shapes.turn_upright(self.file.triangles, self.up)
            if self.file
            else shapes.category_triangles(self.label, self.seed)
        )


class Motion(Record):
    """Closed loop of poses: each quantity oscillates by its amplitude, a whole number of times per
    loop.
    """

    poses: int = Field(default=90, gt=0, le=3600)
    """Number of poses, at 30 per second: two minutes at most, all rendered ahead."""
    sway_x_m: Length = 0.0
    sway_y_m: Length = 0.0
    approach_m: Reach = 0.0
    turn_deg: Angle = 0.0
    tilt_deg: Angle = 0.0


FaultKind = Literal[
    "stall",
    "drops",
    "duplicate",
    "out_of_order",
    "all_zero",
    "saturated",
    "half_invalid",
    "wrong_size",
    "unplug",
    "clock_wrap",
]


class Fault(Record):
    """Fault of a simulated camera: `kind` names what it does to the frames.

    stall: delivers nothing and stops counting. drops: counts on, but delivers nothing. duplicate:
    every frame twice. out_of_order: every frame after its successor. all_zero: depth, infrared and
    confidence are black. saturated: infrared is 255 everywhere. half_invalid: no depth in the lower
    half. wrong_size: half the rows and columns. unplug: the device is gone, and counts from 0 when
    it is back. clock_wrap: timestamps of a hardware clock of 32 bits of microseconds, which
    restarts at 0.
    """

    kind: FaultKind
    at_frame: int = Field(ge=0)
    """First frame with the fault; there are 30 per second, counted from 0 when the camera is
    entered.
    """
    frames: int = Field(default=1, gt=0)
    """Number of frames: for stall and unplug their duration; for out_of_order the number that are
    late.
    """
    stream: Literal["depth", "infrared", "confidence"] | None = None
    """Only for drops: the stream that loses frames."""

    @model_validator(mode="after")
    def _check_kind(self) -> Self:
        if self.stream and self.kind != "drops":
            raise PydanticCustomError(
                "stream", "stream is for drops: {kind} affects all streams", {"kind": self.kind}
            )
        if self.kind == "clock_wrap" and "frames" in self.model_fields_set:
            raise PydanticCustomError("frames", "a clock_wrap happens at one frame: omit `frames`")
        return self

    @property
    def until_frame(self) -> int:
        """First frame after the fault."""
        # A late frame takes the place of its successor, so each one lasts for two.
        return self.at_frame + self.frames * (2 if self.kind == "out_of_order" else 1)

    def befalls(self, frame: int) -> bool:
        """Return whether the fault lasts at this frame."""
        return self.at_frame <= frame < self.until_frame


def one_wrap(faults: tuple[Fault, ...]) -> tuple[Fault, ...]:
    """Return the faults. Raises PydanticCustomError for more than one clock_wrap."""
    if sum(fault.kind == "clock_wrap" for fault in faults) > 1:
        raise PydanticCustomError(
            "clock_wrap", "a clock wraps every 71.6 minutes: give one clock_wrap"
        )
    return faults


RENDERING_VERSION = 7
"""Number to raise where rendering results or datasets' noise differ from those of the last release:
cached worlds are rendered again, and datasets of another number are not continued.
"""


class SceneFile(Record):
    """Complete description of a simulated camera and its world."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    name: str
    rig: Rig
    hidden: HiddenObject | None = Field(default=None, alias="object")
    """`object` in the file."""
    motion: Motion = Motion(poses=1)
    sensor: SensorModel = SensorModel()
    radiometry: Radiometry = "paper"
    jump_m: float = Field(default=shapes.JUMP_M, ge=0, allow_inf_nan=False)
    """Neighbors farther apart in depth than this are separate surfaces."""
    faults: Annotated[tuple[Fault, ...], AfterValidator(one_wrap)] = ()
    """Faults of the simulated camera; they do not affect the rendering."""

    @field_validator("rig", mode="before")
    @classmethod
    def _rig_by_name(cls, value: object) -> object:
        return load_rig(value) if isinstance(value, str) else value

    @property
    def checksum(self) -> str:
        """Twelve hexadecimal digits that change with anything that changes a rendering."""
        # A mesh counts by its content, and the sensor only by its pulse, which the renderer
        # applies.
        mesh = self.hidden.file if self.hidden else None
        seen = {"name": True, "sensor": True, "faults": True, "hidden": {"file"}}
        facts = self.model_dump_json(exclude=seen), mesh and mesh.sha256, self.sensor.pulse_ns
        return hashlib.sha256(f"{RENDERING_VERSION} {facts}".encode()).hexdigest()[:12]

    @property
    def poses(self) -> int:
        """Number of instants in the loop."""
        return self.motion.poses if self.hidden else 1

    @property
    def bare(self) -> Scene:
        """Scene without the object."""
        material = self.hidden.material if self.hidden else Material()
        return Scene(
            self.rig, None, material.surface, self.radiometry, self.jump_m, self.sensor.pulse_ns
        )

    def scene_at(self, number: float) -> Scene:
        """Return the scene at an instant of the loop; fractions lie between two poses."""
        if self.hidden is None:
            return self.bare
        if self.rig.object_box is None:
            raise SceneError(
                f"rig {self.rig.name!r} has no object_box for {self.hidden.label!r}: add one"
            )
        placed = shapes.place(
            self.hidden.triangles, self.pose_at(self.hidden, number), self.rig.object_box
        )
        return replace(
            self.bare, object_depth_m=shapes.orthographic_depth(placed, self.rig.object_box)
        )

    def shows_at(self, number: float) -> bool:
        """Return whether the wall sees any of the object at an instant of the loop."""
        depth_m = self.scene_at(number).object_depth_m
        return depth_m is not None and bool(np.isfinite(depth_m).any())

    def pose_at(self, rest: HiddenObject, number: float) -> shapes.Pose:
        """Return the pose, at an instant of the loop, of an object whose pose at rest is `rest`."""
        # Whole numbers of oscillations per loop: the last pose leads into the first. Twice the
        # frequency in y makes the path an eight; the approach begins at its far end.
        turn = 2 * pi * number / self.poses
        motion = self.motion
        return shapes.Pose(
            tilt_x_rad=radians(rest.tilt_x_deg),
            tilt_y_rad=radians(rest.tilt_y_deg + motion.tilt_deg * sin(2 * turn)),
            turn_z_rad=radians(rest.turn_deg + motion.turn_deg * sin(turn)),
            size_m=rest.size_m,
            x_m=rest.x_m + motion.sway_x_m * sin(turn),
            y_m=rest.y_m + motion.sway_y_m * sin(2 * turn),
            front_m=rest.front_m + motion.approach_m * (1 + sin(turn + pi / 2)) / 2,
        )


def paper_scene() -> SceneFile:
    """Return the default scene: the paper's rig with an airplane in flight."""
    return SceneFile(
        name="paper",
        rig=load_rig("paper-rig"),
        object=HiddenObject(category="airplane", seed=20_000_003, size_m=0.19),
        motion=Motion(
            poses=90, sway_x_m=0.02, sway_y_m=0.02, approach_m=0.05, turn_deg=32, tilt_deg=12
        ),
    )


def bare_wall_scene() -> SceneFile:
    """Return the wall alone."""
    return SceneFile(name="bare-wall", rig=load_rig("bare-wall"))


def packaged_scenes() -> dict[str, Path]:
    """Return the example scenes that come with the package (in a clone: examples) by name."""
    # A wheel holds the scenes beside this module; a clone has them in examples.
    here = Path(__file__).parent
    folder = next(
        (folder for folder in (here / "scenes", here.parents[1] / "examples") if folder.is_dir()),
        here,
    )
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_scene(path: Path) -> SceneFile:
    """Return a scene from TOML, or a packaged one by name; paths in it are relative to its own
    folder.

    Raises SceneFileError with the first problem, SceneError for an object that cannot be seen.
    """
    content: dict[str, Any] = {}
    # A bare name that is no file here is one of the packaged scenes; folders of results have such.
    if str(path) == path.stem and not path.is_file():
        path = packaged_scenes().get(path.stem, path)
    try:
        content = read_toml(path)
        scene = SceneFile.model_validate(_from_folder(content, path.parent))
    except RecordFileError as error:
        raise SceneFileError(f"{path} is not a valid scene: rig: {error}") from error
    except ValidationError as error:
        if (kind := record_kind(content)) not in {"", "scene"}:
            raise SceneFileError(
                f"{path} is a {kind}, not a scene: give the path of a scene.toml"
            ) from error
        raise SceneFileError(f"{path} is not a valid scene: {first_problem(error)}") from error
    except OSError as error:
        raise SceneFileError(
            f"{path} cannot be read ({error.strerror}): give the path of a scene.toml"
        ) from error
    except UnicodeDecodeError as error:
        raise SceneFileError(
            f"{path} is a binary file, not a scene: give the path of a scene.toml"
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise SceneFileError(f"{path} cannot be read as a scene: {error}") from error
    if scene.hidden and not any(scene.shows_at(number) for number in range(scene.poses)):
        raise shapes.invisible_object_error(scene.hidden.label, shapes.object_box(scene.rig))
    return scene


def _from_folder(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return a scene file's content with rig loaded and mesh path resolved, both relative to its
    folder.
    """
    if isinstance(rig := content.get("rig"), str):
        beside = folder / rig
        content["rig"] = rig_named(str(beside if beside.is_file() else rig)).model_dump()
    elif isinstance(rig, dict):
        fields = cast("dict[str, Any]", rig)
        content["rig"] = with_base(fields, folder, str(content.get("name", "scene")))
    hidden = content.get("object", content.get("hidden"))
    if isinstance(hidden, dict) and isinstance(file := hidden.get("file"), str):
        hidden["file"] = str((folder / file).resolve())
    return content
