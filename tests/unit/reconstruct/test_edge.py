"""Laws of the cells at the occluder's edge: what a bench that is a little off can change, and that
its repair gives what the record's bench would have shown.
"""

from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration import Rig, load_rig
from small_frames import sheet_network

from nlos_cam.camera import World
from nlos_cam.evaluate import echoes_of, per_object, sense
from nlos_cam.frames import LidarMaps
from nlos_cam.objects import BenchmarkObject, benchmark_objects, image_from_depth, object_box
from nlos_cam.reconstruct import (
    Arrival,
    CalibratedRig,
    EdgeRepair,
    Pipeline,
    edge_cells,
    load_networks,
    reconstruct,
)
from nlos_cam.reconstruct.edge import Edge
from nlos_cam.render import Scene, SceneFile, SensorModel, render

HOME = load_rig("paper-rig")
BOX = object_box(HOME)
OFF_RECORD = {
    "2 mm nearer": {"distance_m": -0.002},
    "2 mm farther": {"distance_m": 0.002},
    "less turned": {"yaw_deg": -0.5},
    "more turned": {"yaw_deg": 0.5},
}


def off_record(*, distance_m: float = 0.0, yaw_deg: float = 0.0) -> Rig:
    """Return the home bench with its lidar elsewhere."""
    lidar = HOME.lidar
    moved = {"distance_m": lidar.distance_m + distance_m, "yaw_deg": lidar.yaw_deg + yaw_deg}
    return HOME.model_copy(update={"lidar": lidar.model_copy(update=moved)})


@pytest.fixture(scope="module")
def objects() -> list[BenchmarkObject]:
    """Six of the test objects."""
    return benchmark_objects(BOX)[::9]


def maps_of(objects: list[BenchmarkObject], rig: Rig) -> list[LidarMaps]:
    """Return the maps of each object, with the sensor's noise."""
    return sense(echoes_of(objects, rig, lambda _done, _of: None), rig)


def flipped(maps: LidarMaps) -> LidarMaps:
    """Return maps with their columns in the other order."""
    return LidarMaps(maps.depth_m[:, ::-1], maps.intensity[:, ::-1], maps.valid[:, ::-1])


def mean_iou(objects: list[BenchmarkObject], maps: list[LidarMaps]) -> float:
    """Return the silhouette IoU of the shipped network's pictures of maps."""
    network = load_networks()
    found = [image_from_depth(reconstruct(each, HOME, network).depth_m, BOX) for each in maps]
    truth = np.stack([image_from_depth(each.depth_m, BOX) for each in objects])
    return float(per_object(np.stack(found), truth, BOX)["silhouette_iou"].mean())


@pytest.mark.parametrize("name", ["2 mm nearer", "less turned", "more turned"])
def test_other_cells_see_the_same_surface_within_it(name: str) -> None:
    hidden = edge_cells(HOME, 0.002, 0.5)
    on_record, elsewhere = (
        render(Scene(rig)).depth_m for rig in (HOME, off_record(**OFF_RECORD[name]))
    )
    changed = np.abs(on_record - elsewhere) > 0.02  # from the wall to the occluder it is 0.1 m

    assert changed.any()
    assert not (changed & ~hidden).any()


def test_larger_deviations_reach_more_cells() -> None:
    sizes = [edge_cells(HOME, mm / 1e3, mm / 4).sum() for mm in (0.5, 2, 5)]

    assert sizes == sorted(sizes)
    assert 0 < sizes[0] < sizes[-1] < 64 * 80 / 4


def test_bench_without_an_occluder_has_no_edge(objects: list[BenchmarkObject]) -> None:
    bare = HOME.model_copy(update={"occluder": None})
    (maps,) = maps_of(objects[:1], bare)

    assert not edge_cells(bare, 0.01, 2.0).any()
    assert EdgeRepair(CalibratedRig(bare)).repair(maps) is maps


def test_frames_of_the_bench_as_recorded_stay(objects: list[BenchmarkObject]) -> None:
    edge = EdgeRepair(CalibratedRig(HOME))

    for maps in maps_of(objects, HOME):
        assert edge.repair(maps) is maps


@pytest.mark.parametrize("off", OFF_RECORD.values(), ids=OFF_RECORD.keys())
def test_bench_off_its_record_keeps_its_pictures(
    off: dict[str, float], objects: list[BenchmarkObject]
) -> None:
    edge = EdgeRepair(CalibratedRig(HOME))
    maps = maps_of(objects, off_record(**off))
    repaired = [edge.repair(each) for each in maps]
    elsewhere = ~edge_cells(HOME, 0.005, 1.0)

    assert mean_iou(objects, maps) < 0.5
    assert mean_iou(objects, repaired) > 0.65
    for before, after in zip(maps, repaired, strict=True):
        np.testing.assert_array_equal(after.depth_m[elsewhere], before.depth_m[elsewhere])


def test_bench_without_its_occluder_is_not_repaired(objects: list[BenchmarkObject]) -> None:
    edge = EdgeRepair(CalibratedRig(HOME))
    (maps,) = maps_of(objects[:1], HOME.model_copy(update={"occluder": None}))

    assert edge.repair(maps) is maps


def test_black_occluder_is_repaired_as_black(objects: list[BenchmarkObject]) -> None:
    """No record says how dark an occluder is: a frame does."""
    edge = EdgeRepair(CalibratedRig(HOME))
    (maps,) = maps_of(objects[:1], off_record(yaw_deg=-0.5))
    occluder = maps.depth_m < 0.25
    black = replace(maps, intensity=np.where(occluder, maps.intensity / 10, maps.intensity))

    filled = edge.repair(black).depth_m != maps.depth_m

    assert filled.any()
    assert edge.repair(black).intensity[filled].max() == pytest.approx(
        edge.repair(maps).intensity[filled].max() / 10, rel=0.05
    )


def test_faults_run_from_the_wall_to_the_occluder(objects: list[BenchmarkObject]) -> None:
    edge = Edge.of(CalibratedRig(HOME))
    assert edge is not None
    (maps,) = maps_of(objects[:1], off_record(yaw_deg=-0.5))

    faults = edge.faults(maps, None, None)

    columns = [fault.column for fault in faults]
    assert columns == sorted(columns, key=edge.columns.index)
    assert {fault.reason for fault in faults} == {"other surface"}  # no gain, no light to judge
    assert not edge.is_elsewhere(faults)


@pytest.mark.parametrize("off", OFF_RECORD.values(), ids=OFF_RECORD.keys())
def test_mirrored_maps_are_repaired_as_their_mirror_image(
    off: dict[str, float], objects: list[BenchmarkObject]
) -> None:
    lens = HOME.intrinsics
    turned = lens.model_copy(update={"fx": -lens.fx, "ppx": lens.width - 1 - lens.ppx})
    mirrored = HOME.model_copy(update={"intrinsics": turned})
    (maps,) = maps_of(objects[:1], off_record(**off))

    repaired = EdgeRepair(CalibratedRig(HOME)).repair(maps)
    other = EdgeRepair(CalibratedRig(mirrored)).repair(flipped(maps))

    assert repaired is not maps
    np.testing.assert_allclose(flipped(other).depth_m, repaired.depth_m, atol=1e-6)
    np.testing.assert_allclose(flipped(other).intensity, repaired.intensity, rtol=1e-3)


@pytest.mark.parametrize(("yaw_deg", "says"), [(0.0, False), (0.5, True)])
def test_result_says_that_its_edge_was_repaired(
    yaw_deg: float, says: bool, objects: list[BenchmarkObject]
) -> None:
    elsewhere = off_record(yaw_deg=yaw_deg)
    scene = SceneFile(name="elsewhere", rig=elsewhere, sensor=SensorModel())
    world = World(scene, echoes_of(objects[:1], elsewhere, lambda _done, _of: None), [None])
    frame = world.images(0).frame(HOME.pinhole)
    pipeline = Pipeline(CalibratedRig(HOME), sheet_network)

    result = pipeline.process(Arrival(frame, 0.0, ()), lambda: 0.0, 0.0)

    assert [("edge" in warning) for warning in result.warnings] == [True] * says
