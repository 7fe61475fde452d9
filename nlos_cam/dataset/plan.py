"""Plan of a dataset: rig and its variation, sensor, surface and objects; stored as JSON in every
shard.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
from nlos_calibration import NotNegative, ObjectBox, Record, Rig
from nlos_models import SIMULATION_ONLY
from pydantic import TypeAdapter

from nlos_cam.dataset.rig_range import RigRange
from nlos_cam.errors import SceneError
from nlos_cam.objects import CATEGORIES, JUMP_M, Up, find_category, object_box
from nlos_cam.render import RENDERING_VERSION, Material, Radiometry, SceneFile, SensorModel

OBJECTS_VERSION = 2
"""Raise it when a seed makes another object of the same categories."""
FIRST_OBJECTS = {
    "version": 1,
    "categories": (
        "airplane",
        "bell",
        "birdhouse",
        "boat",
        "bowl",
        "car",
        "cup",
        "hat",
        "lamp",
        "rocket",
        "table",
        "tower",
    ),
}
"""Objects of the oldest datasets, whose plans do not name them."""
SCENE_COLUMNS = (
    "lidar_distance_m",
    "lidar_yaw_deg",
    "lidar_pitch_deg",
    "occluder_x_m",
    "occluder_gap_m",
    "bare_wall_counts",
)
"""Values that differ between objects; NaN where there is no occluder."""
RECORDED = "recorded"
"""Accuracy of a plan whose samples were not rendered."""
_RIG_STREAM = 2
"""Stream of an object's random numbers; its noise has stream 1."""


def move_lidar(rig: Rig, place_m: float, yaw_deg: float, pitch_deg: float) -> Rig:
    """Return the rig with its lidar `place_m` farther from the wall, and turned."""
    lidar = rig.lidar.model_copy(
        update={
            "distance_m": rig.lidar.distance_m + place_m,
            "yaw_deg": rig.lidar.yaw_deg + yaw_deg,
            "pitch_deg": rig.lidar.pitch_deg + pitch_deg,
        }
    )
    return rig.model_copy(update={"lidar": lidar})


class RigSpread(Record):
    """Largest deviation of each object's rig from the plan's; drawn uniformly, by the object's
    seed.
    """

    place_m: NotNegative = 0.0
    """Deviation of the lidar's distance, the occluder's x and its gap."""
    angle_deg: NotNegative = 0.0
    """Deviation of yaw and pitch."""
    gain_share: NotNegative = 0.0
    """Relative deviation of the counts of the brightest bare-wall return."""

    def check(self, *rigs: Rig) -> None:
        """Raise SceneError where a draw around one of the rigs could be an impossible rig."""
        spread_mm = self.place_m * 1e3
        limit_m = min(_nearest_m(rig) for rig in rigs)
        if self.place_m >= limit_m:
            raise SceneError(
                f"a spread of {spread_mm:g} mm reaches the wall: keep it below {limit_m * 1e3:g} mm"
            )
        free_m = min(map(_free_m, rigs))
        if self.place_m > free_m:
            raise SceneError(
                f"a spread of {spread_mm:g} mm moves the occluder into the object box: keep it"
                f" below {free_m * 1e3:g} mm"
            )
        if self.angle_deg + max(map(_turn_deg, rigs)) >= 90:
            raise SceneError(
                f"a spread of {self.angle_deg:g} degrees turns the lidar away from the wall:"
                " lower it"
            )
        if self.gain_share >= 1:
            raise SceneError(
                f"a gain spread of {self.gain_share:.0%} leaves no light: keep it below 100 %"
            )

    def within(self, rig: Rig) -> "RigSpread":
        """Return the spread with places so near the rig's that the occluder stays beside the object
        box.
        """
        return self.model_copy(update={"place_m": min(self.place_m, _free_m(rig))})

    def draw(self, rig: Rig, sensor: SensorModel, seed: int) -> tuple[Rig, SensorModel]:
        """Return the rig and the sensor of one draw; without a spread they are the given ones."""
        if self == RigSpread():
            return rig, sensor
        distance, yaw, pitch, place, gap, gain = (
            np.random.default_rng([seed, _RIG_STREAM]).uniform(-1, 1, 6).tolist()
        )
        occluder = rig.occluder
        if occluder:
            shift = {
                "x_m": occluder.x_m + self.place_m * place,
                "z_min_m": occluder.z_min_m + self.place_m * gap,
            }
            occluder = occluder.model_copy(update=shift)
        drawn = move_lidar(
            rig, self.place_m * distance, self.angle_deg * yaw, self.angle_deg * pitch
        )
        counts = {"bare_wall_counts": sensor.bare_wall_counts * (1 + self.gain_share * gain)}
        return drawn.model_copy(update={"occluder": occluder}), sensor.model_copy(update=counts)


def _nearest_m(rig: Rig) -> float:
    """Return the distance from the wall of what is nearest to it: the lidar, or the occluder."""
    distance_m = rig.lidar.distance_m
    return min(distance_m, rig.occluder.z_min_m) if rig.occluder else distance_m


def _free_m(rig: Rig) -> float:
    """Return how far the occluder can move before it is in the object box; infinite where there is
    no occluder, or it is behind the box's edge.
    """
    if rig.occluder is None:
        return np.inf
    free_m = object_box(rig).x_min_m - rig.occluder.x_m
    return free_m if free_m >= 0 else np.inf


def _turn_deg(rig: Rig) -> float:
    """Return the lidar's larger turn of yaw and pitch."""
    return max(abs(rig.lidar.yaw_deg), abs(rig.lidar.pitch_deg))


@dataclass(frozen=True)
class Objects:
    """Hidden objects: procedural ones of some categories, or the meshes of a folder, identified by
    their content.
    """

    categories: tuple[str, ...] = tuple(CATEGORIES)
    """A seed picks by position."""
    meshes: tuple[tuple[str, str], ...] = ()
    """(path in the folder, SHA-256), in order; with meshes there are no categories."""
    backgrounds: float = 0.0
    """Share of the procedural objects with a post or a panel beside them."""
    share_generic: float = 0.0
    """Share of generic shapes (`nlos_cam.objects.generic_depth`) among the objects."""
    up: Up = "y"
    """Axis of the meshes that points up."""
    version: int = OBJECTS_VERSION
    folder: Path | None = field(default=None, compare=False)
    """Folder of the meshes on this machine."""

    @classmethod
    def without(
        cls, left_out: Sequence[str], backgrounds: float = 0.0, share_generic: float = 0.0
    ) -> Self:
        """Return all categories but these. Raises SceneError for an unknown one, or if none is
        left.
        """
        dropped = [find_category(name).name for name in left_out]
        if not (categories := tuple(name for name in CATEGORIES if name not in dropped)):
            raise SceneError("--without leaves no object category: keep at least one")
        return cls(categories, backgrounds=backgrounds, share_generic=share_generic)


@dataclass(frozen=True)
class DatasetPlan:
    """Everything that decides the samples of a dataset, except their number."""

    rig: Rig
    first_seed: int
    sensor: SensorModel = field(default_factory=SensorModel)
    accuracy: str = "standard"
    objects: Objects = field(default_factory=Objects)
    spread: RigSpread = field(default_factory=RigSpread)
    radiometry: Radiometry = "paper"
    jump_m: float = JUMP_M
    material: Material = field(default_factory=Material)
    rendering_version: int = RENDERING_VERSION
    textures: tuple[str, ...] = ()
    """Textures of the objects; with any of them the dataset is in color, which is simulation
    only.
    """
    expected: bool = False
    """Hold expected maps, without the sensor's noise, which training a direct network draws anew at
    each step.
    """
    objects_per_rig: int = 1
    """Consecutive seeds that share a draw of the spread, so that the renderer keeps what depends on
    the rig alone.
    """
    off_record: bool = False
    """True where `spread` is the error of a bench's record: maps are aligned by the rig of the
    record, so that the error stays in them. False where each object's deviation is known.
    """
    rigs: RigRange | None = None
    """Range from which the rig of each object's record is drawn, in place of `rig`; `spread` is
    then the error of that record."""

    @classmethod
    def of_scene(cls, scene: SceneFile, first_seed: int, **others: Any) -> Self:
        """Return a plan with the rig, sensor, radiometry and material of a scene, but not its
        object.
        """
        material = scene.hidden.material if scene.hidden else Material()
        return cls(
            scene.rig,
            first_seed,
            scene.sensor,
            radiometry=scene.radiometry,
            jump_m=scene.jump_m,
            material=material,
            **others,
        )

    @property
    def box(self) -> ObjectBox:
        """The rig's object box. Raises SceneError where it has none."""
        return object_box(self.rig)

    @property
    def provenance(self) -> str:
        """Everything that decides the bits, as JSON."""
        facts: dict[str, Any] = _PLAN.dump_python(
            self, mode="json", exclude={"objects": {"folder"}}
        )
        if self.textures:
            facts["note"] = SIMULATION_ONLY
        else:
            del facts["textures"]  # older readers refuse unknown fields
        if not self.expected:
            del facts["expected"]  # likewise
        if self.objects_per_rig == 1:
            del facts["objects_per_rig"]
        if not self.off_record:
            del facts["off_record"]
        if self.rigs is None:
            del facts["rigs"]
        if not self.objects.share_generic:
            del facts["objects"]["share_generic"]  # and checksums of older plans stay
        if self.objects.up == "y":
            del facts["objects"]["up"]  # likewise
        return json.dumps({**facts, "rig_checksum": self.rig.checksum})

    @classmethod
    def from_provenance(cls, text: str) -> "DatasetPlan":
        """Return a stored plan, with defaults for fields that are missing in older datasets.

        Raises ValueError for anything that is not a plan, or a plan of a newer nlos-cam.
        """
        facts: dict[str, Any] = json.loads(text)
        known = {"rig_checksum", "note", *(one.name for one in fields(cls))}
        if newer := sorted(set(facts) - known):
            raise ValueError(f"the plan has an unknown field {newer[0]!r}: update nlos-cam")
        facts.setdefault("objects", FIRST_OBJECTS)
        return _PLAN.validate_python(facts)

    def bench_of(self, seed: int) -> tuple[Rig, SensorModel]:
        """Return the rig and the sensor of one object."""
        return self.spread.draw(self.nominal_rig(seed), self.sensor, seed // self.objects_per_rig)

    def nominal_rig(self, seed: int) -> Rig:
        """Return the rig of one object without the spread."""
        return self.rigs.draw(self.rig, seed // self.objects_per_rig) if self.rigs else self.rig

    def known_rig(self, seed: int) -> Rig:
        """Return the rig that maps of one object are aligned by: that of its bench's record.

        It is the bench's own rig, less the spread where that is the record's error: with
        `off_record`, and in a plan of many rigs.
        """
        is_off = self.off_record or self.rigs is not None
        return self.nominal_rig(seed) if is_off else self.bench_of(seed)[0]

    @property
    def stays_in_maps(self) -> bool:
        """True where no map has to be aligned: all objects have the plan's rig on their record."""
        varies = bool(self.spread.place_m or self.spread.angle_deg)
        return self.rigs is None and (self.off_record or not varies)

    def differences(self, other: "DatasetPlan") -> list[str]:
        """Return the names of fields that differ; empty where both plans make the same bits."""
        names = [one.name for one in fields(self)]
        return [
            name.replace("_", " ") for name in names if getattr(self, name) != getattr(other, name)
        ]

    def check(self) -> None:
        """Raise SceneError where no sample can be made by this plan."""
        _ = self.box
        self.spread.check(*(self.rigs.extremes(self.rig) if self.rigs else [self.rig]))
        if self.textures and self.material.albedo != 1:
            raise SceneError(
                "the scene's object has an albedo, but in color its albedo comes from textures:"
                " remove it"
            )
        if self.objects_per_rig > 1 and self.spread == RigSpread() and not self.rigs:
            raise SceneError(
                "without a spread all objects share one rig: drop --objects-per-rig, or give a"
                " spread"
            )
        if self.off_record and self.spread == RigSpread():
            raise SceneError(
                "without a spread no record is off: drop --off-record, or give a spread"
            )
        if self.expected and self.sensor.wall_texture:
            raise SceneError("expected maps are not of a wall_texture: drop --expected-maps")
        if np.ndim(self.material.albedo):
            raise SceneError(
                "the scene's object has three albedos, but datasets hold one intensity: give one"
                " albedo"
            )


_PLAN = TypeAdapter(DatasetPlan)


def scene_row(rig: Rig, sensor: SensorModel) -> list[float]:
    """Return SCENE_COLUMNS of one object."""
    nowhere = float("nan")
    occluder = (rig.occluder.x_m, rig.occluder.z_min_m) if rig.occluder else (nowhere, nowhere)
    return [
        rig.lidar.distance_m,
        rig.lidar.yaw_deg,
        rig.lidar.pitch_deg,
        *occluder,
        sensor.bare_wall_counts,
    ]
