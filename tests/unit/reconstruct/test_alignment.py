"""Maps of a bench that is not the training rig: what its calibration explains is taken out."""

from dataclasses import replace
from itertools import repeat
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nlos_calibration import Rig, load_rig
from nlos_calibration.arrays import Float32
from nlos_models.training import MapSet
from small_frames import SheetNetwork

from nlos_cam import reconstruct
from nlos_cam.evaluate import per_object
from nlos_cam.frames import LidarMaps
from nlos_cam.objects import benchmark_objects, image_from_depth, object_box
from nlos_cam.reconstruct import Arrival, CalibratedRig, MapAlignment, OwnMaps, alignment
from nlos_cam.reconstruct.alignment import BEAMS, _cells_wholly_on_wall
from nlos_cam.render import QUIET, Scene, Sensor, SensorModel, cast, render

RIG = load_rig("paper-rig")
THINGS = benchmark_objects(object_box(RIG))[1::9]


def trained(rig: Rig = RIG, **changes: Any) -> Any:
    name = {"rig_name": rig.name, "rig_checksum": rig.checksum}
    return SimpleNamespace(
        **{**name, "rig": None, "input": "raw maps", "bare_wall_counts": None} | changes
    )


def bench(along_m: float = 0.0, up_m: float = 0.0, **lidar: float) -> Rig:
    """Return the paper's rig with its lidar elsewhere: positions on the wall are relative to the
    lidar's foot.
    """
    moved = {
        part: extent.model_copy(
            update={"x_min_m": extent.x_min_m - along_m, "x_max_m": extent.x_max_m - along_m}
            | {"y_min_m": extent.y_min_m - up_m, "y_max_m": extent.y_max_m - up_m}
        )
        for part in ("wall", "relay", "object_box")
        for extent in [getattr(RIG, part)]
    }
    assert RIG.occluder
    edge = RIG.occluder.model_copy(update={"x_m": RIG.occluder.x_m - along_m})
    return RIG.model_copy(
        update={**moved, "occluder": edge, "lidar": RIG.lidar.model_copy(update=lidar)}
    )


BENCHES = {
    "as trained": bench(),
    "2 mm farther": bench(distance_m=0.202),
    "half a degree": bench(yaw_deg=45.5),
    "lidar 5 mm aside and up": bench(0.005, 0.005),
    "all of it": bench(0.004, -0.003, distance_m=0.206, yaw_deg=46.8, pitch_deg=1.1),
}


def maps_of(
    rig: Rig, depth_m: Float32 | None, model: SensorModel = QUIET, seed: int | None = None
) -> LidarMaps:
    generator = (
        None if seed is None and not model.wall_texture else np.random.default_rng(seed or 0)
    )
    return Sensor(rig, model).maps(render(Scene(rig, depth_m), "draft").multi, generator)


@pytest.mark.parametrize("rig", BENCHES.values(), ids=BENCHES)
def test_cell_is_wholly_on_the_wall_where_all_its_beams_are(rig: Rig) -> None:
    """The rule looks at the beams at a cell's corners alone."""
    fine = rig.pinhole.scaled(BEAMS * 80, BEAMS * 64)
    beams = cast(rig, fine).on_wall.reshape(64, BEAMS, 80, BEAMS)

    found = _cells_wholly_on_wall(rig)

    assert 0 < found.sum() < found.size
    np.testing.assert_array_equal(found, beams.all(axis=(1, 3)))


@pytest.mark.parametrize("rig", list(BENCHES.values())[1:], ids=list(BENCHES)[1:])
def test_bare_bench_looks_like_the_bare_training_rig(rig: Rig) -> None:
    aligned = MapAlignment(rig, RIG)
    found = aligned.align(maps_of(rig, None))
    wanted = maps_of(RIG, None)

    np.testing.assert_array_equal(found.valid, wanted.valid)
    # Cells are compared but for the column at the occluder's edge, which sees both it and the wall.
    off_m = np.abs(found.depth_m - wanted.depth_m)
    ratio = found.intensity / wanted.intensity

    assert np.quantile(off_m, 0.98) < 1e-3
    assert np.quantile(np.abs(np.log(ratio)), 0.95) < 0.04


def test_networks_keep_their_silhouettes_on_aligned_benches() -> None:
    truth = np.stack([image_from_depth(one.depth_m, object_box(RIG)) for one in THINGS])
    box = object_box(RIG)
    network = reconstruct.load_networks()
    iou = dict[str, float]()
    for name, rig in BENCHES.items():
        seen = [maps_of(rig, one.depth_m, SensorModel(), 1) for one in THINGS]
        maps = MapSet(
            np.stack([one.depth_m for one in seen]),
            np.stack([one.intensity for one in seen]),
            truth,
        )
        for aligned, given in (
            (True, reconstruct.align_all(maps, repeat(rig), network.record)),
            (False, maps),
        ):
            image = network(given.depth_m, given.intensity)
            iou[f"{name} {aligned}"] = float(per_object(image, truth, box)["silhouette_iou"].mean())
    for name in list(BENCHES)[1:]:
        assert iou[f"{name} True"] > max(
            iou["as trained False"] - 0.08, iou[f"{name} False"] + 0.2
        ), iou


@pytest.mark.parametrize("counts", [30.0, 90.0])
def test_aligned_light_is_that_of_the_training_sensor(counts: float) -> None:
    rig = BENCHES["all of it"]
    sensed = maps_of(rig, None)
    wanted = maps_of(RIG, None, QUIET.model_copy(update={"bare_wall_counts": counts}))
    aligned = alignment(rig, trained(bare_wall_counts=counts))
    assert aligned

    ratio = aligned.align(sensed).intensity / wanted.intensity

    assert np.median(np.abs(np.log(ratio))) < 0.02


@pytest.mark.parametrize(("gain", "offset_m"), [(0.8, 0.0), (1.0, 0.004), (1.3, -0.003)])
def test_bare_wall_takes_reflectance_gain_and_offset_out(gain: float, offset_m: float) -> None:
    rig = BENCHES["all of it"]
    depth_m = THINGS[0].depth_m
    painted = QUIET.model_copy(update={"wall_texture": 0.1, "range_offset_m": offset_m})
    empty = maps_of(rig, None, painted)
    reference: Any = SimpleNamespace(map_depth_m=empty.depth_m, map_intensity=empty.intensity)
    aligned = alignment(rig, trained(), reference)
    plain = alignment(rig, trained())

    assert aligned
    assert plain

    seen = maps_of(rig, depth_m, painted)
    seen = replace(seen, intensity=gain * seen.intensity)
    wanted = plain.align(maps_of(rig, depth_m))
    of_wall = np.abs(wanted.depth_m - maps_of(RIG, None).depth_m) < 1e-3
    found = aligned.align(seen)

    assert np.quantile(np.abs(found.depth_m - wanted.depth_m)[of_wall], 0.98) < 1e-3
    assert np.quantile(np.abs(np.log(found.intensity / wanted.intensity))[of_wall], 0.98) < 0.04

    offset = alignment(rig, trained(), reference, range_offset_m=0.5)
    assert offset
    known = offset.align(replace(seen, depth_m=seen.depth_m + 0.5))

    np.testing.assert_allclose(known.depth_m, found.depth_m, rtol=0, atol=1e-6)


def test_cells_that_the_reference_lacks_are_of_the_geometry() -> None:
    rig = BENCHES["all of it"]
    empty = maps_of(rig, None)
    hole = np.zeros((64, 80), bool)
    hole[20:30, 40:50] = True
    lacking: Any = SimpleNamespace(
        map_depth_m=np.where(hole, np.nan, empty.depth_m),
        map_intensity=np.where(hole, np.nan, empty.intensity),
    )
    whole: Any = SimpleNamespace(map_depth_m=empty.depth_m, map_intensity=empty.intensity)
    seen = maps_of(rig, THINGS[0].depth_m)
    found, wanted = (MapAlignment(rig, RIG, bare).align(seen) for bare in (lacking, whole))

    np.testing.assert_array_equal(found.valid, wanted.valid)
    np.testing.assert_allclose(found.depth_m, wanted.depth_m, rtol=0, atol=0.002)
    np.testing.assert_allclose(found.intensity, wanted.intensity, rtol=0.05)


@pytest.mark.parametrize("measured", [False, True])
def test_light_of_a_frame_without_the_wall_is_in_counts(measured: bool) -> None:
    rig = BENCHES["all of it"]
    empty = maps_of(rig, None)
    reference: Any = SimpleNamespace(map_depth_m=empty.depth_m, map_intensity=empty.intensity)
    aligned = MapAlignment(rig, RIG, reference if measured else None)
    beyond = aligned.align(replace(empty, depth_m=empty.depth_m + np.float32(0.05)))
    of_wall = aligned.align(empty)
    lit = of_wall.intensity > 1

    ratio = beyond.intensity[lit] / of_wall.intensity[lit]

    assert 0.5 < np.median(ratio) < 2


def test_what_cannot_be_aligned_is_left_alone() -> None:
    rig = BENCHES["all of it"]
    box = RIG.object_box

    assert box

    larger = rig.model_copy(
        update={"object_box": box.model_copy(update={"z_far_m": box.z_far_m + 0.05})}
    )

    assert reconstruct.rig_to_align_with(rig, trained()) == RIG

    for other, record in (
        (RIG, trained()),
        (larger, trained()),
        (rig.model_copy(update={"object_box": None}), trained()),
        (rig, trained(input="difference maps")),
        (rig, trained(rig_name="somebody else's")),
        (rig, trained(rig_checksum="0" * 12)),
        *(
            (bench(**lidar), trained()) for lidar in ({"distance_m": 0.25}, {"yaw_deg": 15.0})
        ),  # see less of the wall
    ):
        assert reconstruct.rig_to_align_with(other, record) is None
        assert alignment(other, record) is None
    maps = maps_of(rig, None)
    dark = LidarMaps(
        np.full_like(maps.depth_m, np.nan), np.zeros_like(maps.intensity), np.zeros_like(maps.valid)
    )

    assert not MapAlignment(rig, RIG).align(dark).valid[:, :50].any()


def arrival(rig: Rig) -> Arrival:
    echoes = render(Scene(rig, None), "draft").multi
    images = Sensor(rig, QUIET).expose(echoes, np.random.default_rng(0))
    return Arrival(images.frame(rig.pinhole), 0.0, ())


def test_unmeasured_occluder_stands_as_in_training() -> None:
    rig = BENCHES["lidar 5 mm aside and up"]
    seen = maps_of(rig, THINGS[0].depth_m)
    records = (rig, rig.model_copy(update={"occluder": None}))
    found, wanted = (alignment(one, trained()).align(seen) for one in records)  # type: ignore[union-attr]

    np.testing.assert_allclose(found.depth_m, wanted.depth_m)
    np.testing.assert_allclose(found.intensity, wanted.intensity)


def test_pipeline_aligns_with_the_bench_that_it_has() -> None:
    rig = BENCHES["all of it"]
    for record, changed in ((trained(), True), (None, False)):
        pipeline = reconstruct.Pipeline(CalibratedRig(rig), SheetNetwork(), trained=record)
        prepared = pipeline.prepare(arrival(rig), lambda: 0.0, 0.0)
        assert (
            np.array_equal(prepared.network_input.depth_m, prepared.checked.depth_m, equal_nan=True)
            != changed
        )
        pipeline.bench = CalibratedRig(RIG)
        prepared = pipeline.prepare(arrival(RIG), lambda: 0.0, 0.0)
        np.testing.assert_array_equal(prepared.network_input.depth_m, prepared.checked.depth_m)


def test_corrected_maps_are_aligned_as_live_aligns_them() -> None:
    """Labelled recordings are corrected by the bare wall first, and aligned without it."""
    rig = BENCHES["all of it"]
    model = SensorModel(wall_texture=0.1, ripple_m=0.001)
    bare = maps_of(rig, None, model, seed=1)
    seen = maps_of(rig, THINGS[0].depth_m, model, seed=2)
    walled: Any = CalibratedRig(rig)
    walled.reference = SimpleNamespace(map_depth_m=bare.depth_m, map_intensity=bare.intensity)
    live = MapAlignment(rig, RIG, walled.reference).align(seen)

    found = MapAlignment(rig, RIG).align(OwnMaps(walled).correct(seen))

    np.testing.assert_array_equal(found.valid, live.valid)
    np.testing.assert_allclose(found.depth_m, live.depth_m, rtol=0, atol=0.001)
    np.testing.assert_allclose(found.intensity, live.intensity, rtol=0.01)
