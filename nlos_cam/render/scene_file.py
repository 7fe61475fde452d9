"""`scene.toml`: a rig, a hidden object, its motion and the sensor model, as one validated record."""

import hashlib
import tomllib
from math import pi, radians, sin
from pathlib import Path
from typing import Annotated

from nlos_calibration.errors import RecordFileError
from nlos_calibration.rig import Record, Rig, first_problem, load_rig
from nlos_calibration.wall_record import rig_named
from pydantic import AfterValidator, ConfigDict, Field, ValidationError, field_validator

from nlos_cam.errors import SceneError
from nlos_cam.objects.categories import CATEGORIES
from nlos_cam.objects.hidden import Pose, category_triangles, place
from nlos_cam.objects.raster import orthographic_depth
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor import SensorModel

RENDERING_VERSION = 1
"""Raised with any change of what a scene renders to, so that cached worlds are rendered anew."""


def _known(category: str) -> str:
    if category not in CATEGORIES:
        raise ValueError(f"no such category: choose one of {', '.join(CATEGORIES)}")
    return category


class HiddenObject(Record):
    """One variation of a procedural category, and how it stands at rest."""

    category: Annotated[str, AfterValidator(_known)]
    seed: int = Field(default=0, ge=0)
    size_m: float = Field(default=0.18, gt=0)
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0
    turn_deg: float = 0.0
    x_m: float = 0.0
    y_m: float = 0.0
    front_m: float = Field(default=0.03, ge=0)
    """From the box's near side to the object's nearest point."""


class Motion(Record):
    """A loop of poses: each quantity swings to and fro by its amplitude, at its own whole number of swings a loop."""

    poses: int = Field(default=90, gt=0)
    """At 30 poses a second."""
    sway_x_m: float = 0.0
    sway_y_m: float = 0.0
    approach_m: float = Field(default=0.0, ge=0)
    turn_deg: float = 0.0
    tilt_deg: float = 0.0


class SceneFile(Record):
    """Everything that a simulated camera simulates."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    name: str
    rig: Rig
    hidden: HiddenObject | None = Field(default=None, alias="object")
    """`object` in the file."""
    motion: Motion = Motion(poses=1)
    sensor: SensorModel = SensorModel()

    @field_validator("rig", mode="before")
    @classmethod
    def _rig_by_name(cls, value: object) -> object:
        return load_rig(value) if isinstance(value, str) else value

    @property
    def checksum(self) -> str:
        """Twelve hexadecimal digits that change with anything that changes a rendering."""
        geometry = self.model_dump_json(exclude={"name", "sensor"})
        return hashlib.sha256(f"{RENDERING_VERSION} {geometry}".encode()).hexdigest()[:12]

    @property
    def poses(self) -> int:
        """How many instants the loop has."""
        return self.motion.poses if self.hidden else 1

    def scene_at(self, number: int) -> Scene:
        """The scene at one instant of the loop."""
        if self.hidden is None:
            return Scene(self.rig)
        if self.rig.object_box is None:
            raise SceneError(f"rig {self.rig.name!r} has no object_box to hide {self.hidden.category!r} in: add one")
        triangles = category_triangles(self.hidden.category, self.hidden.seed)
        placed = place(triangles, self._pose(self.hidden, number), self.rig.object_box)
        return Scene(self.rig, orthographic_depth(placed, self.rig.object_box))

    def _pose(self, rest: HiddenObject, number: int) -> Pose:
        turn, motion = 2 * pi * number / self.poses, self.motion
        return Pose(
            tilt_x_rad=radians(rest.tilt_x_deg),
            tilt_y_rad=radians(rest.tilt_y_deg + motion.tilt_deg * sin(2 * turn)),
            turn_z_rad=radians(rest.turn_deg + motion.turn_deg * sin(turn)),
            size_m=rest.size_m,
            x_m=rest.x_m + motion.sway_x_m * sin(turn),
            y_m=rest.y_m + motion.sway_y_m * sin(2 * turn),
            front_m=rest.front_m + motion.approach_m * (1 + sin(turn + pi / 2)) / 2,
        )


def paper_scene() -> SceneFile:
    """The default scene: the paper's rig with an airplane in flight."""
    return SceneFile(
        name="paper",
        rig=load_rig("paper-rig"),
        object=HiddenObject(category="airplane", seed=20_000_003, size_m=0.19),
        motion=Motion(poses=90, sway_x_m=0.02, sway_y_m=0.02, approach_m=0.05, turn_deg=32, tilt_deg=12),
    )


def bare_wall_scene() -> SceneFile:
    """The wall alone."""
    return SceneFile(name="bare-wall", rig=load_rig("bare-wall"))


def load_scene(path: Path) -> SceneFile:
    """A scene from TOML; a rig's path in it starts from its own folder. Raises SceneError with the first problem."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
        if isinstance(rig := content.get("rig"), str):
            beside = path.parent / rig
            content["rig"] = rig_named(str(beside if beside.is_file() else rig)).model_dump()
        return SceneFile.model_validate(content)
    except RecordFileError as error:
        raise SceneError(f"{path} is not a scene: rig: {error}") from error
    except ValidationError as error:
        raise SceneError(f"{path} is not a scene: {first_problem(error)}") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SceneError(f"{path} cannot be read as a scene: {error}") from error
