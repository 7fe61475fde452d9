"""Milliseconds of a 640 x 480 frame up to its difference maps: `pytest tests/bench -m bench
--benchmark-enable`.
"""

import numpy as np
import pytest
from fake_wall import RIG, write_wall
from nlos_calibration import BareWallStatistics, load_measured, wall_depth
from pytest_benchmark.fixture import BenchmarkFixture

from nlos_cam.frames import Frame, LidarMaps, MapMean, maps_from_frame
from nlos_cam.reconstruct import CalibratedRig

FRAMES = 30


def frames() -> list[Frame]:
    """Of the bare wall of the paper's rig, with 0.5 mm of noise in quarters of a millimetre, as an
    L515 has them.
    """
    true_m = wall_depth(RIG.wall_from_lidar, RIG.pinhole)
    true_m[~(true_m < 2.0)] = np.nan
    made: list[Frame] = []
    for number in range(FRAMES):
        generator = np.random.default_rng(number)
        depth_m = 0.00025 * np.round((true_m + generator.normal(0.0, 5e-4, true_m.shape)) / 0.00025)
        ir = generator.integers(20, 40, true_m.shape, np.uint8)
        made.append(
            Frame(
                depth_m.astype(np.float32),
                ir,
                ir,
                number / 30,
                number,
                RIG.pinhole,
                {"laser_power": 40.0},
            )
        )
    return made


@pytest.fixture(scope="module")
def seen() -> list[Frame]:
    return frames()


@pytest.fixture(scope="module")
def bench(seen: list[Frame], tmp_path_factory: pytest.TempPathFactory) -> CalibratedRig:
    statistics = BareWallStatistics(RIG.pinhole)
    for frame in seen:
        maps = maps_from_frame(frame)
        statistics.add(frame.depth_m, frame.ir, maps.depth_m, maps.intensity)
    inliers = np.isfinite(statistics.depth.mean_m())
    reference = statistics.reference(inliers, serial="", settings={"laser_power": 40.0})
    path = write_wall(tmp_path_factory.mktemp("wall") / "wall.toml", reference, RIG.pinhole)
    return CalibratedRig(RIG, load_measured(path))


@pytest.mark.bench
@pytest.mark.parametrize("part", ["maps", "bench", "both", "both, 100 averaged"])
def test_frame_up_to_its_difference_maps(
    benchmark: BenchmarkFixture, seen: list[Frame], bench: CalibratedRig, part: str
) -> None:
    turn = iter(range(10**9))
    mean = MapMean(100 if "averaged" in part else 1)
    maps = [maps_from_frame(frame) for frame in seen]

    def go() -> LidarMaps | None:
        k = next(turn) % FRAMES
        if part == "maps":
            return maps_from_frame(seen[k])
        return bench.observe(
            seen[k], maps[k] if part == "bench" else mean.add(maps_from_frame(seen[k]))
        ).difference

    assert benchmark(go) is not None
