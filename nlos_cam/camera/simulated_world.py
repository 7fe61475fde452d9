"""The world that a simulated camera sees: a scene's loop of poses, rendered ahead and cached; the sensor is live."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32

from nlos_cam.camera.streams import FRAMES_PER_S
from nlos_cam.files import cache_folder
from nlos_cam.render import (
    MultiBounce,
    SceneFile,
    SensedImages,
    Sensor,
    bare_wall_scene,
    load_scene,
    paper_scene,
    render_scan,
)

Loop = tuple[list[MultiBounce], list[Float32]]
"""Echoes of each frame, and hidden depth in the middle of its scan."""
OnProgress = Callable[[int, int], None]
"""Called with poses done and poses in all."""
CELSIUS_ABOVE = {
    "ldd_temperature": 0.0,
    "mc_temperature": -3.0,
    "ma_temperature": -1.0,
    "apd_temperature": -5.0,
    "humidity_temperature": -8.0,
}
"""Against the laser driver's, whose temperature is the sensor's. The names are the SDK's; the figures are chosen."""


class World:
    """A loop of instants. Frame numbers beyond the loop start it again, with other noise; the device warms on."""

    def __init__(self, scene: SceneFile, echoes: list[MultiBounce], truths: list[Float32 | None]) -> None:
        self.scene = scene
        self._echoes, self._truths = echoes, truths
        self._sensor = Sensor(scene.rig, scene.sensor, scene.radiometry)

    @property
    def rig(self) -> Rig:
        """The rig whose lidar sees this world."""
        return self.scene.rig

    def images(self, number: int) -> SensedImages:
        """What the device delivers as frame `number`; the same number gives the same bits."""
        generator = np.random.default_rng([number, len(self._echoes)])
        echoes = self._echoes[number % len(self._echoes)]
        return self._sensor.expose(echoes, generator, celsius=self._celsius(number))

    def celsius(self, number: int) -> Mapping[str, float]:
        """The device's temperatures at frame `number`, by the names of the options that tell them.

        All warm as one body: they differ by what is always the same, and none comes later than the others.
        """
        return {name: self._celsius(number) + above for name, above in CELSIUS_ABOVE.items()}

    def _celsius(self, number: int) -> float:
        """The sensor's own; it was started at frame 0."""
        return self.scene.sensor.celsius_at(number / FRAMES_PER_S)

    def truth_depth_m(self, number: int) -> Float32 | None:
        """The hidden depth (64, 64) at frame `number`; None where nothing is hidden."""
        return self._truths[number % len(self._truths)]


def open_world(name: str, on_progress: OnProgress | None = None) -> World:
    """The world of a scene: "" the paper's rig with a moving object, "bare-wall", or a scene.toml's path.

    Renders the loop ahead on first use and keeps it in the cache folder. Raises SceneError for a scene that cannot be.
    """
    scene = {"": paper_scene, "bare-wall": bare_wall_scene}.get(name, lambda: load_scene(Path(name)))()
    cached = cache_folder() / "worlds" / f"{scene.checksum}.npz"
    if (loop := _load(cached)) is None:
        loop = _render_loop(scene, on_progress)
        _store(cached, *loop)
    echoes, truths = loop
    return World(scene, echoes, list(truths) if scene.hidden else [None])


def _load(path: Path) -> Loop | None:
    """A cached loop; None where there is none, or it is damaged and must be rendered anew."""
    try:
        with np.load(path) as file:
            maps, mixed = (
                zip(file["peak"], file["runner_up"], file["path_m"], strict=True),
                bool(file["direct_included"]),
            )
            return [MultiBounce(*of_pose, mixed) for of_pose in maps], list(file["truth_m"])
    except (OSError, ValueError, EOFError, KeyError, BadZipFile):
        return None


def _render_loop(scene: SceneFile, on_progress: OnProgress | None) -> Loop:
    echoes: list[MultiBounce] = []
    truths: list[Float32] = []
    for number in range(scene.poses):
        echoes.append(render_scan(lambda share, start=number: scene.scene_at(start + share)).multi)
        truth = scene.scene_at(number + 0.5).object_depth_m
        truths.append(np.zeros((0, 0), np.float32) if truth is None else truth)
        if on_progress:
            on_progress(number + 1, scene.poses)
    return echoes, truths


def _store(path: Path, echoes: list[MultiBounce], truths: list[Float32]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.stem}.{os.getpid()}.part.npz")
    np.savez_compressed(
        part,
        peak=np.stack([echo.peak for echo in echoes]),
        runner_up=np.stack([echo.runner_up for echo in echoes]),
        path_m=np.stack([echo.path_m for echo in echoes]),
        direct_included=echoes[0].direct_included,
        truth_m=np.stack(truths),
    )
    part.replace(path)
