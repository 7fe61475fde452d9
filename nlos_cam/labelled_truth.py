"""What was hidden while a labelled recording was made: a test object by its name, or a file beside the recording."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import ObjectBox, Rig, first_problem
from pydantic import ValidationError

from nlos_cam.errors import RecordingError
from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects.benchmark import test_set
from nlos_cam.objects.depth_map import object_box
from nlos_cam.objects.meshes import DEPTH_MAP_SUFFIX, MESH_SUFFIXES, read_depth_map
from nlos_cam.objects.placement import nothing_to_see
from nlos_cam.render.scene_file import HiddenObject, SceneFile

TRUTH_SUFFIX = ".truth.toml"
"""Of a file with the fields of a scene file's [object]: what it is, and how it stands in the rig's object box."""


def fixed_objects(box: ObjectBox) -> Mapping[str, Float32]:
    """The test objects, whose label alone tells them: their depths (64, 64) over a box, by name."""
    return {thing.name: thing.depth_m for thing in test_set(box)}


def truth_depth_m(recording: Path, label: str, rig: Rig, known: Mapping[str, Float32]) -> Float32:
    """The hidden depth (64, 64) over the rig's object box of one labelled recording, NaN for background.

    Files beside it are asked first, by the recording's name and then by its label: NAME.truth.toml, NAME.npy; then
    `known` objects, by their names. Raises RecordingError where none tells, or two do; SceneError for an odd file.
    """
    for name in dict.fromkeys((recording.stem, Path(label).name)):
        if (file := _truth_file(recording.parent, name)) is not None:
            return _depth_map(file) if file.suffix == DEPTH_MAP_SUFFIX else _placed(file, name, rig)
    if label in known:
        return known[label]
    raise RecordingError(
        f"{recording} is labelled {label!r}, which is no test object (such as {next(iter(known), 'cup-1')}), and "
        f"nothing beside it tells its shape: add {label}{TRUTH_SUFFIX} (what it is, and its pose) or a depth map "
        f"{label}{DEPTH_MAP_SUFFIX}"
    )


def _truth_file(folder: Path, name: str) -> Path | None:
    """The one truth of that name. Raises RecordingError for two, or for a mesh that nothing places."""
    found = [path for end in (TRUTH_SUFFIX, DEPTH_MAP_SUFFIX) if (path := folder / f"{name}{end}").is_file()]
    if len(found) > 1:
        raise RecordingError(f"{found[0]} and {found[1].name} both tell what {name!r} is: leave one of them")
    if not found and (meshes := _meshes(folder, name)):
        raise RecordingError(
            f"nothing tells how {meshes[0]} stands in the object box: write {name}{TRUTH_SUFFIX} beside it, with "
            "size_m, x_m, y_m, front_m and its angles"
        )
    return found[0] if found else None


def _meshes(folder: Path, name: str) -> list[Path]:
    return [path for end in MESH_SUFFIXES if (path := folder / f"{name}{end}").is_file()]


def _depth_map(path: Path) -> Float32:
    depth_m = read_depth_map(path)
    if depth_m.shape != (OBJECT_PIXELS, OBJECT_PIXELS):
        raise RecordingError(
            f"{path} has shape {depth_m.shape}: what networks learn from has {OBJECT_PIXELS} cells along each side"
        )
    return depth_m


def _placed(path: Path, name: str, rig: Rig) -> Float32:
    """What a truth file says, in the rig's object box; without `category` or `file` it is of the mesh beside it."""
    thing = _hidden(path, name)
    depth_m = SceneFile(name=thing.label, rig=rig, object=thing).scene_at(0).object_depth_m
    if depth_m is None or np.isnan(depth_m).all():
        raise nothing_to_see(thing.label, object_box(rig))
    return depth_m


def _hidden(path: Path, name: str) -> HiddenObject:
    try:
        fields: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
        meshes = _meshes(path.parent, name)
        if not fields.keys() & {"category", "file"} and meshes:
            fields["file"] = meshes[0].name
        if isinstance(file := fields.get("file"), str):
            fields["file"] = str((path.parent / file).resolve())
        return HiddenObject.model_validate(fields)
    except ValidationError as error:
        raise RecordingError(f"{path} does not tell a hidden object: {first_problem(error)}") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise RecordingError(f"{path} cannot be read as TOML: {error}") from error
