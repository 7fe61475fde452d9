"""A measured wall, small and made up: frames of it, a reference from some of them, and its record
on disk.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.reference import BareWall, BareWallStatistics, save_reference
from nlos_calibration.rig import dump_toml
from nlos_calibration.wall import WallFit, wall_depth
from nlos_calibration.wall_record import MeasuredWall, load_measured, new_wall_record
from small_frames import RIG, SERIAL, SMALL, FrameCamera

from nlos_cam.frames import Frame, maps_from_frame
from nlos_cam.recording.sidecar import Sidecar, Temperatures, sidecar_path

NOISE_M = 5e-4
WALL_M = wall_depth(RIG.wall_from_lidar, SMALL)
WALL_M[~(WALL_M < 0.6)] = np.nan
"""(64, 80); as the paper's lidar sees a bare wall, as far as 0.6 m."""
FIT = WallFit(
    distance_m=0.2,
    yaw_deg=45.0,
    pitch_deg=0.0,
    facing_deg=RIG.facing_deg,
    distance_std_m=0.0,
    yaw_std_deg=0.0,
    pitch_std_deg=0.0,
    facing_std_deg=0.0,
    wall_from_lidar=RIG.wall_from_lidar,
    covariance=np.zeros((3, 3)),
    residual_m=1e-4,
    noise_scale=1.0,
    inlier_fraction=0.99,
    inliers=np.isfinite(WALL_M),
    ripple_m=0.0,
    bend_m=0.0,
    bend_deg=0.0,
    bend_std_deg=0.001,
    verdict="good",
    advice="fine",
    warnings=(),
)


def wall_frame(number: int, nearer_m: float = 0.0) -> Frame:
    """A frame of the bare wall, noisy; its depth all nearer by so much."""
    generator = np.random.default_rng(number)
    depth_m = (WALL_M - nearer_m + generator.normal(0.0, NOISE_M, WALL_M.shape)).astype(np.float32)
    ir = generator.integers(20, 40, WALL_M.shape, np.uint8)
    return Frame(depth_m, ir, ir, number / 30, number, SMALL, {"laser_power": 40.0})


def bare_wall() -> BareWall:
    statistics = BareWallStatistics(SMALL)
    for frame in map(wall_frame, range(20)):
        maps = maps_from_frame(frame)
        statistics.add(frame.depth_m, frame.ir, maps.depth_m, maps.intensity)
    statistics.add_temperatures({"ldd_temperature": 40.0})
    return statistics.reference(FIT.inliers, serial=SERIAL, settings={"laser_power": 40.0})


def write_wall(
    path: Path, reference: BareWall | None = None, intrinsics: Intrinsics = SMALL, **others: Any
) -> Path:
    """A record, and the reference beside it if there is one."""
    if reference:
        npz = path.with_suffix(".npz")
        others |= {"reference": npz.name, "reference_sha256": save_reference(npz, reference)}
    about: dict[str, Any] = {"camera": "sim:bare-wall", "frames": 20, "created": date(2026, 1, 2)}
    record = new_wall_record(FIT, intrinsics, **about, others={"serial": SERIAL, **others})
    path.write_text(dump_toml(record), encoding="utf-8")
    return path


def write_sidecar(bag: Path, temperatures: Sequence[Temperatures]) -> None:
    """A sidecar of the wall's recording, with temperatures."""
    sidecar = Sidecar(
        label=None,
        camera="l515",
        state="complete",
        intrinsics=vars(SMALL),
        device={},
        versions={},
        settings={},
        started=datetime(2026, 1, 2, tzinfo=UTC),
        temperatures=list(temperatures),
    )
    sidecar_path(bag).write_text(sidecar.model_dump_json())


def measured_wall(folder: Path) -> MeasuredWall:
    return load_measured(write_wall(folder / "wall.toml", bare_wall()))


class WallCamera(FrameCamera):
    """Frames of the bare wall; those of the numbers in `moved` are of a lidar 10 mm nearer."""

    def __init__(
        self, frames: int, moved: range = range(0), celsius: float = 40.0, period_s: float = 1 / 30
    ) -> None:
        def make(number: int) -> Frame:
            return replace(
                wall_frame(number, 0.01 * (number in moved)), timestamp_s=number * period_s
            )

        super().__init__(frames, make=make)
        self._celsius = celsius
        self.asked = 0

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        self.asked += 1
        return {f"ldd{ending}": self._celsius}


def other_intrinsics(**changes: float) -> Intrinsics:
    return replace(SMALL, **changes)
