"""The records of a hidden object in scene files: what it is, what it is made of, how it stands and how it moves."""

from pathlib import Path
from typing import Annotated, Self

from nlos_calibration.rig import Record
from pydantic import AfterValidator, Field, PlainSerializer, PlainValidator, model_validator
from pydantic_core import PydanticCustomError

from nlos_cam.errors import SceneError
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.meshes import MeshFile, Up, read_mesh, upright
from nlos_cam.objects.placement import Triangles, category_triangles
from nlos_cam.render.surface import Material


def _known(category: str) -> str:
    if category not in CATEGORIES:
        raise ValueError(f"no such category: choose one of {', '.join(CATEGORIES)}")
    return category


def _mesh(value: object) -> MeshFile:
    if isinstance(value, MeshFile):
        return value
    if not isinstance(value, str | Path):
        raise PydanticCustomError("mesh_file", "must be the path of a mesh")
    try:
        return read_mesh(Path(value))
    except SceneError as error:
        raise PydanticCustomError("mesh_file", "{problem}", {"problem": str(error)}) from error


def _within(low: float, high: float) -> AfterValidator:
    """A range that NaN is outside of, told as a whole."""

    def check(value: float) -> float:
        if not low <= value <= high:
            raise PydanticCustomError("range", "must be from {low} to {high}", {"low": f"{low:g}", "high": f"{high:g}"})
        return value

    return AfterValidator(check)


Mesh = Annotated[MeshFile, PlainValidator(_mesh), PlainSerializer(lambda mesh: str(mesh.path), str)]
Size = Annotated[float, _within(0.001, 10)]
Length = Annotated[float, _within(-10, 10)]
Reach = Annotated[float, _within(0, 10)]
Angle = Annotated[float, _within(-360, 360)]


class HiddenObject(Record):
    """One variation of a procedural category, or a mesh from a file, and how it stands at rest."""

    category: Annotated[str, AfterValidator(_known)] | None = None
    seed: int = Field(default=0, ge=0)
    """Which variation of the category."""
    size_m: Size = 0.18
    """The larger of its extents along x and y, once turned: the unit of a mesh's file does not matter."""
    tilt_x_deg: Angle = 0.0
    tilt_y_deg: Angle = 0.0
    turn_deg: Angle = 0.0
    x_m: Length = 0.0
    y_m: Length = 0.0
    front_m: Reach = 0.03
    """From the box's near side to the object's nearest point."""
    file: Mesh | None = None
    """A .obj, .stl or .ply; a path in a scene file starts from its folder."""
    up: Up = "y"
    """Which axis of the mesh's file points up."""
    material: Material = Material()

    @model_validator(mode="after")
    def _one_thing(self) -> Self:
        if (self.category is None) == (self.file is None):
            raise PydanticCustomError("one_thing", "give one of category and file")
        if self.file and self.seed:
            raise PydanticCustomError("seed", "seed is for a category: a file has no variations")
        if self.category and self.up != "y":
            raise PydanticCustomError("up", "up is for a file: a category stands with y up")
        return self

    @property
    def label(self) -> str:
        """What a message calls it: the category, or the file's path."""
        return str(self.file.path) if self.file else str(self.category)

    @property
    def triangles(self) -> Triangles:
        """(n, 3, 3), before it is placed: y up, -z towards the wall."""
        return upright(self.file.triangles, self.up) if self.file else category_triangles(self.label, self.seed)


class Motion(Record):
    """A loop of poses: each quantity swings to and fro by its amplitude, at its own whole number of swings a loop."""

    poses: int = Field(default=90, gt=0)
    """At 30 poses a second."""
    sway_x_m: Length = 0.0
    sway_y_m: Length = 0.0
    approach_m: Reach = 0.0
    turn_deg: Angle = 0.0
    tilt_deg: Angle = 0.0
