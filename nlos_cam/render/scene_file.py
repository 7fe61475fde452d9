"""`scene.toml`: a rig, a hidden object, its motion and the sensor model, as one validated record."""

import hashlib
import tomllib
from dataclasses import replace
from math import pi, radians, sin
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from nlos_calibration.errors import RecordFileError
from nlos_calibration.rig import Record, Rig, first_problem, load_rig
from nlos_calibration.wall_record import rig_named
from pydantic import AfterValidator, ConfigDict, Field, ValidationError, field_validator

from nlos_cam.errors import SceneError
from nlos_cam.objects.depth_map import object_box, orthographic_depth
from nlos_cam.objects.placement import Pose, nothing_to_see, place
from nlos_cam.render.fault_record import Fault, one_wrap
from nlos_cam.render.hidden_record import HiddenObject, Motion
from nlos_cam.render.patches import JUMP_M
from nlos_cam.render.scene import Radiometry, Scene
from nlos_cam.render.sensor_model import SensorModel
from nlos_cam.render.surface import Material

RENDERING_VERSION = 3
"""Raised with any change of what a scene renders to, so that cached worlds are rendered anew."""


class SceneFile(Record):
    """Everything that a simulated camera simulates."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    name: str
    rig: Rig
    hidden: HiddenObject | None = Field(default=None, alias="object")
    """`object` in the file."""
    motion: Motion = Motion(poses=1)
    sensor: SensorModel = SensorModel()
    radiometry: Radiometry = "paper"
    jump_m: float = Field(default=JUMP_M, ge=0, allow_inf_nan=False)
    """Neighbours further apart in depth than this are not one surface."""
    faults: Annotated[tuple[Fault, ...], AfterValidator(one_wrap)] = ()
    """What befalls the simulated camera; nothing of it is rendered."""

    @field_validator("rig", mode="before")
    @classmethod
    def _rig_by_name(cls, value: object) -> object:
        return load_rig(value) if isinstance(value, str) else value

    @property
    def checksum(self) -> str:
        """Twelve hexadecimal digits that change with anything that changes a rendering."""
        mesh = self.hidden.file if self.hidden else None
        seen = {"name": True, "sensor": True, "faults": True, "hidden": {"file"}}
        facts = self.model_dump_json(exclude=seen), mesh and mesh.sha256, self.sensor.pulse_ns
        return hashlib.sha256(f"{RENDERING_VERSION} {facts}".encode()).hexdigest()[:12]

    @property
    def poses(self) -> int:
        """How many instants the loop has."""
        return self.motion.poses if self.hidden else 1

    @property
    def bare(self) -> Scene:
        """The scene with nothing hidden."""
        material = self.hidden.material if self.hidden else Material()
        return Scene(self.rig, None, material.surface, self.radiometry, self.jump_m, self.sensor.pulse_ns)

    def scene_at(self, number: float) -> Scene:
        """The scene at one instant of the loop; fractions lie between two frames."""
        if self.hidden is None:
            return self.bare
        if self.rig.object_box is None:
            raise SceneError(f"rig {self.rig.name!r} has no object_box to hide {self.hidden.label!r} in: add one")
        placed = place(self.hidden.triangles, self.pose_at(self.hidden, number), self.rig.object_box)
        return replace(self.bare, object_depth_m=orthographic_depth(placed, self.rig.object_box))

    def shows_at(self, number: float) -> bool:
        """Whether the wall sees any of the object at one instant of the loop."""
        depth_m = self.scene_at(number).object_depth_m
        return depth_m is not None and bool(np.isfinite(depth_m).any())

    def pose_at(self, rest: HiddenObject, number: float) -> Pose:
        """The pose at one instant of the loop of what stands at rest as `rest` says."""
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
    """A scene from TOML; the paths of a rig and a mesh in it start from its own folder.

    Raises SceneError with the first problem.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
        scene = SceneFile.model_validate(_from_folder(content, path.parent))
    except RecordFileError as error:
        raise SceneError(f"{path} is not a scene: rig: {error}") from error
    except ValidationError as error:
        raise SceneError(f"{path} is not a scene: {first_problem(error)}") from error
    except OSError as error:
        raise SceneError(f"{path} cannot be read ({error.strerror}): give the path of a scene.toml") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SceneError(f"{path} cannot be read as a scene: {error}") from error
    if scene.hidden and not any(scene.shows_at(number) for number in range(scene.poses)):
        raise nothing_to_see(scene.hidden.label, object_box(scene.rig))
    return scene


def _from_folder(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The content of a scene file with its rig read and its mesh's path made whole, both from its own folder."""
    if isinstance(rig := content.get("rig"), str):
        beside = folder / rig
        content["rig"] = rig_named(str(beside if beside.is_file() else rig)).model_dump()
    hidden = content.get("object", content.get("hidden"))
    if isinstance(hidden, dict) and isinstance(file := hidden.get("file"), str):
        hidden["file"] = str((folder / file).resolve())
    return content
