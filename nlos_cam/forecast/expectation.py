"""Forecast of a rig: expected silhouette IoU and depth error, and how many numbers the maps
determine.
"""

import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from itertools import product
from typing import Any, Self, get_args

import numpy as np
from nlos_calibration import Rig, lidar_visible_share
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.files import cache_folder, load_cached
from nlos_cam.forecast.curve import network_iou
from nlos_cam.forecast.linear import (
    Basis,
    Echoes,
    MaterialName,
    Posterior,
    echoes_of,
    posterior,
)
from nlos_cam.forecast.prior import Shape, shipped_prior
from nlos_cam.objects import benchmark_objects, object_box
from nlos_cam.render import RENDERING_VERSION, Radiometry, Scene, SensorModel, render

FRAMES = 1, 4, 30, 100
QUICK_FRAMES = 1, 100
VERSION = 3
"""Raise it when the same rig gives another forecast."""
STRIDE = 11
"""Every eleventh of the 54 test objects is a typical one: 5, the same on every rig, so that the
curve to the networks' figures takes in how hard they are."""
SHOWN_STRIDE = 3
"""Every third test object, one of each category, is rendered for whether it shows at all."""
MATERIAL_OBJECTS = 3
"""Objects whose materials are compared, each with its matt self."""
SEED = 0
MATERIAL_NAMES: tuple[MaterialName, ...] = get_args(MaterialName)


@dataclass(frozen=True)
class Conditions:
    """What a figure holds for."""

    frames: int = 1
    """Frames averaged."""
    material: MaterialName = "matt"
    radiometry: Radiometry = "paper"


@dataclass(frozen=True)
class Expectation:
    """What to expect under some conditions: means over typical objects."""

    conditions: Conditions
    linear_iou: float
    """Silhouette IoU of the linear estimate."""
    depth_rmse_m: float
    """Depth error of the linear estimate, over the cells inside both outlines."""
    outline_numbers: float
    depth_numbers: float
    """Numbers of the outline and of the depth that the maps determine beyond the prior."""
    cells: float
    """Cells of the map whose strongest echo is a three-bounce one."""
    margin: float
    """1 less the wall's return over the echo, median of these cells; 0 if there are none."""
    signal_to_noise: float
    """Of the intensity in these cells, median; after averaging."""

    @property
    def network_iou(self) -> float:
        """Silhouette IoU to expect of a network trained for the rig, by the fitted curve."""
        return network_iou(self.linear_iou)


@dataclass(frozen=True)
class Forecast:
    """What a rig's maps can say of an object behind the occluder, before anything is trained."""

    rig: str
    rig_checksum: str
    objects: int
    """Number of objects that the figures are means of."""
    guess_iou: float
    """IoU of the prior's mean outline: what no light at all gives."""
    guess_rmse_m: float
    """Depth error of the prior's mean depth."""
    visible_share: float
    """Share of the object box that the lidar sees directly."""
    hidden_share: float
    """Share of objects that change no cell of the maps: whatever the weights, `live` cannot tell
    them from an empty bench."""
    expectations: tuple[Expectation, ...]
    outline_std: dict[int, Float64] = field(compare=False, repr=False)
    """By frames averaged, (GRID, GRID): standard deviation of the outline over the box, matt."""
    depth_std_m: dict[int, Float64] = field(compare=False, repr=False)
    """By frames averaged, (GRID, GRID): standard deviation of the depth."""

    @property
    def expected_iou(self) -> float:
        """Silhouette IoU to expect of a trained network: one frame, matt, the paper's
        radiometry. It is of the network's pictures, also of those that `live` does not show.
        """
        return self.at().network_iou

    @property
    def sees_nothing(self) -> bool:
        """True if three bounces win no cell."""
        return self.at().cells == 0

    def at(
        self, frames: int = 1, material: MaterialName = "matt", radiometry: Radiometry = "paper"
    ) -> Expectation:
        """Return the expectation under some conditions. Raises KeyError for others than those
        forecast.
        """
        wanted = Conditions(frames, material, radiometry)
        for row in self.expectations:
            if row.conditions == wanted:
                return row
        raise KeyError(f"no forecast for {wanted}")

    def as_json(self) -> dict[str, Any]:
        """Return all figures without the maps."""
        facts = {
            name: value
            for name, value in vars(self).items()
            if name not in {"expectations", "outline_std", "depth_std_m"}
        }
        rows = [
            asdict(row.conditions)
            | {name: value for name, value in vars(row).items() if name != "conditions"}
            | {"network_iou": row.network_iou}
            for row in self.expectations
        ]
        return facts | {"expected_iou": self.expected_iou, "expectations": rows}

    def dump(self) -> bytes:
        """Return the forecast as a cache entry."""
        maps = {f"outline {n}": image for n, image in self.outline_std.items()}
        maps |= {f"depth {n}": image for n, image in self.depth_std_m.items()}
        small = {name: image.astype(np.float32) for name, image in maps.items()}
        target = io.BytesIO()
        text = json.dumps(self.as_json())
        np.savez_compressed(target, allow_pickle=False, facts=np.array(text), **small)
        return target.getvalue()

    @classmethod
    def load(cls, content: bytes) -> Self:
        """Return the forecast that `dump` wrote."""
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            facts = json.loads(str(file["facts"]))
            maps = {name: file[name].astype(np.float64) for name in file.files if name != "facts"}
        del facts["expected_iou"]
        rows: list[Expectation] = []
        for row in facts.pop("expectations"):
            del row["network_iou"]
            conditions = Conditions(*(row.pop(n) for n in ("frames", "material", "radiometry")))
            rows.append(Expectation(conditions, **row))
        stds = [
            {int(n.split()[1]): image for n, image in maps.items() if n.startswith(kind)}
            for kind in ("outline", "depth")
        ]
        return cls(**facts, expectations=tuple(rows), outline_std=stds[0], depth_std_m=stds[1])


def forecast(
    rig: Rig,
    *,
    quick: bool = False,
    shape: Shape | None = None,
    sensor: SensorModel | None = None,
    cached: bool = True,
) -> Forecast:
    """Return the forecast of a rig with an object box; `quick` leaves out materials, radiometries
    and some numbers of frames, and takes a few seconds.

    A `shape` takes the place of the typical objects. Forecasts of a rig alone are kept in the
    cache by the rig's checksum. Raises SceneError for a rig without an object box.
    """
    own = sensor or SensorModel()
    if shape is not None:
        alone_m = np.where(shape.outline, shape.depth_m(object_box(rig)), np.nan)
        return _forecast(rig, own, [shape], hidden_share(rig, [alone_m]), quick=quick)
    if not cached or own != SensorModel():
        return _of_typical(rig, own, quick=quick)
    version = f"{VERSION}.{RENDERING_VERSION}"
    name = f"{rig.checksum}-{version}-{'quick' if quick else 'full'}.npz"

    def make() -> bytes:
        return _of_typical(rig, own, quick=quick).dump()

    return load_cached(cache_folder() / "forecast" / name, Forecast.load, make)


def hidden_share(rig: Rig, depths_m: Sequence[Float32]) -> float:
    """Return the share of objects, given as depth maps (n, n), that change no cell of the maps.

    Each cell returns its strongest echo (S5): where the wall's own is stronger everywhere, nothing
    of the object is left to read.
    """
    empty = render(Scene(rig), "draft")
    hidden = [
        np.array_equal(render(Scene(rig, depth_m), "draft").intensity, empty.intensity)
        for depth_m in depths_m
    ]
    return _mean(hidden)


def typical_shapes(rig: Rig) -> list[Shape]:
    """Return shapes of the test objects in a rig's box."""
    box = object_box(rig)
    return [Shape.of(one.depth_m, box) for one in benchmark_objects(box)[::STRIDE]]


@cache
def shipped_basis() -> Basis:
    """Return the basis of the shipped prior."""
    return Basis.of(shipped_prior())


def _of_typical(rig: Rig, sensor: SensorModel, *, quick: bool) -> Forecast:
    tested = benchmark_objects(object_box(rig))[::SHOWN_STRIDE]
    hidden = hidden_share(rig, [one.depth_m for one in tested])
    return _forecast(rig, sensor, typical_shapes(rig), hidden, quick=quick)


def _forecast(
    rig: Rig, sensor: SensorModel, shapes: Sequence[Shape], hidden: float, *, quick: bool
) -> Forecast:
    box = object_box(rig)
    span_m = box.z_far_m - box.z_near_m
    few = 0 if quick else MATERIAL_OBJECTS
    echoes = [
        echoes_of(rig, shape, sensor, "paper", MATERIAL_NAMES if i < few else ("matt",))
        for i, shape in enumerate(shapes)
    ]
    nothing = [Echoes.none()] * len(shapes)
    guess = expectation(Conditions(), posteriors(shapes, nothing, 1), nothing, span_m)
    rows: list[Expectation] = []
    outline_std: dict[int, Float64] = {}
    depth_std_m: dict[int, Float64] = {}
    matt_echoes = [found["matt"] for found in echoes]
    for frames in QUICK_FRAMES if quick else FRAMES:
        found = posteriors(shapes, matt_echoes, frames)
        row = expectation(Conditions(frames), found, matt_echoes, span_m)
        rows.append(at_least(row, rows[-1]) if rows else row)
        outline_std[frames] = np.mean([one.outline_std for one in found], 0)
        depth_std_m[frames] = span_m * np.mean([one.depth_std for one in found], 0)
    if not quick:
        rows += _by_material(rig, sensor, shapes[:few], echoes[:few], rows, guess)
    return Forecast(
        rig.name,
        rig.checksum,
        len(shapes),
        guess.linear_iou,
        guess.depth_rmse_m,
        float(lidar_visible_share(rig, box)),
        hidden,
        tuple(rows),
        outline_std,
        depth_std_m,
    )


def _by_material(
    rig: Rig,
    sensor: SensorModel,
    shapes: Sequence[Shape],
    echoes: Sequence[dict[MaterialName, Echoes]],
    matt: Sequence[Expectation],
    guess: Expectation,
) -> list[Expectation]:
    """Return the expectations of all other materials and radiometries.

    They are the matt figures plus each object's difference from its matt self: far fewer objects
    are enough for a difference.
    """
    box = object_box(rig)
    span_m = box.z_far_m - box.z_near_m
    in_room = [echoes_of(rig, shape, sensor, "lambertian", MATERIAL_NAMES) for shape in shapes]
    matt_echoes = [one["matt"] for one in echoes]
    references = [
        expectation(
            base.conditions,
            posteriors(shapes, matt_echoes, base.conditions.frames),
            matt_echoes,
            span_m,
        )
        for base in matt
    ]
    rows: list[Expectation] = []
    for light, name in product(get_args(Radiometry), MATERIAL_NAMES):
        if (light, name) == ("paper", "matt"):
            continue
        now = [one[name] for one in (echoes if light == "paper" else in_room)]
        is_lit = any(one.light.size for one in now)
        for i, (base, reference) in enumerate(zip(matt, references, strict=True)):
            frames = base.conditions.frames
            conditions = Conditions(frames, name, light)
            if not is_lit:
                rows.append(replace(guess, conditions=conditions))
                continue
            row = expectation(conditions, posteriors(shapes, now, frames), now, span_m)
            row = _as_far_from(base, reference, row)
            rows.append(at_least(row, rows[-1]) if i else row)
    return rows


def _as_far_from(base: Expectation, reference: Expectation, row: Expectation) -> Expectation:
    """Return a row's conditions with every figure as far from the base's as the row's is from the
    reference's.
    """
    moved: dict[str, float] = {}
    for each in fields(Expectation):
        if each.name != "conditions":
            values = [getattr(one, each.name) for one in (row, base, reference)]
            moved[each.name] = max(values[0] + values[1] - values[2], 0.0)
    moved["linear_iou"] = min(moved["linear_iou"], 1.0)
    return replace(row, **moved)


def posteriors(shapes: Sequence[Shape], echoes: Sequence[Echoes], frames: int) -> list[Posterior]:
    """Return the posterior of each shape, from the shipped prior."""
    basis = shipped_basis()
    return [
        posterior(basis, shape, found, frames, SEED + i)
        for i, (shape, found) in enumerate(zip(shapes, echoes, strict=True))
    ]


def expectation(
    conditions: Conditions,
    found: Sequence[Posterior],
    echoes: Sequence[Echoes],
    span_m: float,
) -> Expectation:
    """Return the means over objects."""
    signals = [_median(one.light / one.scaled_noise(conditions.frames)[0]) for one in echoes]
    return Expectation(
        conditions,
        _mean(one.iou for one in found),
        span_m * _mean(one.depth_rmse for one in found),
        _mean(one.outline_numbers for one in found),
        _mean(one.depth_numbers for one in found),
        _mean(float(one.light.size) for one in echoes),
        _mean(_median(one.margin) for one in echoes),
        _mean(signals),
    )


def at_least(row: Expectation, fewer: Expectation) -> Expectation:
    """Return a row no worse than that of fewer frames.

    Who has more frames can always use fewer; only the few noise draws behind a figure could say
    otherwise.
    """
    return replace(
        row,
        linear_iou=max(row.linear_iou, fewer.linear_iou),
        depth_rmse_m=min(row.depth_rmse_m, fewer.depth_rmse_m),
    )


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def _median(values: Float64) -> float:
    return float(np.median(values)) if values.size else 0.0
