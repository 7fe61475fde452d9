"""OBJECT and the options that place it: what `render` hides, as the depth map that the wall sees."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import Rig, first_problem
from pydantic import ValidationError

from nlos_cam.cli.common import say
from nlos_cam.errors import SceneError
from nlos_cam.objects.depth_map import object_box
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.meshes import DEPTH_MAP_SUFFIX, MESH_SUFFIXES, Up, read_depth_map, read_mesh
from nlos_cam.objects.placement import fit, nothing_to_see
from nlos_cam.render.scene_file import HiddenObject, SceneFile

_KINDS = f"a mesh ({', '.join(MESH_SUFFIXES)}), a {DEPTH_MAP_SUFFIX} depth map (n, n) in metres"


def _option(field: str, told: str) -> Any:
    """An option of the same name as a field of HiddenObject: None where it is not given."""
    default = HiddenObject.model_fields[field].default
    return typer.Option(f"--{field.replace('_', '-')}", help=told, show_default=str(default))


Object = Annotated[str, typer.Argument(metavar="OBJECT", help=f"A category's name, {_KINDS}.")]
Seed = Annotated[int | None, _option("seed", "Which variation of a category.")]
UpAxis = Annotated[Up | None, _option("up", "What points up in a mesh's file; -z (z up: its +y) faces the wall.")]
Size = Annotated[float | None, _option("size_m", "Larger of its extents along x and y, once turned. It scales a mesh.")]
TiltX = Annotated[float | None, _option("tilt_x_deg", "Its angle about wall x, turned first.")]
TiltY = Annotated[float | None, _option("tilt_y_deg", "Then about wall y (up): 180 turns its back to the wall.")]
Turn = Annotated[float | None, _option("turn_deg", "Then about wall z.")]
OffsetX = Annotated[float | None, _option("x_m", "Its middle from the box's middle, away from the lidar.")]
OffsetY = Annotated[float | None, _option("y_m", "Its middle from the box's middle, up.")]
Front = Annotated[float | None, _option("front_m", "From the box to its nearest point; too deep a thing is flattened.")]


def hidden_depth(hidden: str, rig: Rig, options: dict[str, Any]) -> Float32:
    """The depth map (n, n) over the rig's object box of what OBJECT names; `options` are fields of HiddenObject.

    Says on stderr what the box cuts off or flattens. Raises SceneError for an object that cannot be, and
    typer.BadParameter for options (those that are not None) that do not go with it or are out of their range.
    """
    given = {name: value for name, value in options.items() if value is not None}
    if hidden in CATEGORIES:
        _refuse(given, {"up"}, f"{hidden} is a category, which stands with y up")
        return _placed({"category": hidden, **given}, rig)
    suffix = Path(hidden).suffix.lower()
    if suffix == DEPTH_MAP_SUFFIX:
        _refuse(given, set(given), f"{hidden} is a depth map, which is placed already")
        return _depth_map(Path(hidden))
    if suffix in MESH_SUFFIXES:
        _refuse(given, {"seed"}, f"{hidden} is a mesh, which has no variations")
        return _placed({"file": read_mesh(Path(hidden)), **given}, rig)
    raise SceneError(f"no object {hidden!r}: give {_KINDS}, or one of {', '.join(CATEGORIES)}")


def _refuse(given: dict[str, Any], pointless: set[str], why: str) -> None:
    if extra := [f"--{name.replace('_', '-')}" for name in given if name in pointless]:
        raise typer.BadParameter(f"{why}: leave out {', '.join(extra)}")


def _depth_map(path: Path) -> Float32:
    depth_m = read_depth_map(path)
    if np.isnan(depth_m).all():
        say(f"{path} is an empty object (all of it is NaN): it hides nothing")
    return depth_m


def _placed(fields: dict[str, Any], rig: Rig) -> Float32:
    try:
        thing = HiddenObject(**fields)
    except ValidationError as error:
        raise typer.BadParameter(first_problem(error)) from error
    box, scene = object_box(rig), SceneFile(name=thing.label, rig=rig, object=thing)
    depth_m = scene.scene_at(0).object_depth_m
    if depth_m is None or np.isnan(depth_m).all():
        raise nothing_to_see(thing.label, box)
    taken = fit(thing.triangles, scene.pose_at(thing, 0), box)
    if taken.outside:
        say(f"{thing.label}: {taken.outside:.0%} of its silhouette is outside the object box, and cut off")
    if taken.depth_m > taken.room_m:
        depths = f"{taken.depth_m:.3g} m deep, flattened to the {taken.room_m:.3g} m that the object box has for it"
        say(f"{thing.label}: {depths}")
    return depth_m
