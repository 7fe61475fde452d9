"""World of a simulated camera: a scene's loop of poses, pre-rendered and cached; the sensor model
runs live.
"""

from collections.abc import Iterable, Mapping
from io import BytesIO
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32, UInt8

from nlos_cam import render as renderer
from nlos_cam.camera.protocol import OnProgress
from nlos_cam.camera.streams import FRAMES_PER_S
from nlos_cam.files import cache_folder, load_cached

Loop = tuple[list[renderer.MultiBounce], list[Float32]]
"""Echoes of each frame, and hidden depth at the middle of its scan."""
WORLDS = Path(__file__).parent / "worlds"
"""Loops of the packaged scenes, written by tools/packaged/contents.py."""
CELSIUS_ABOVE = {
    "ldd_temperature": 0.0,
    "mc_temperature": -3.0,
    "ma_temperature": -1.0,
    "apd_temperature": -5.0,
    "humidity_temperature": -8.0,
}
"""Offsets from the sensor's temperature, which is the laser driver's; names from the SDK, values
assumed.
"""


class World:
    """Loop of instants that repeats with new noise, while the device keeps warming."""

    def __init__(
        self,
        scene: renderer.SceneFile,
        echoes: list[renderer.MultiBounce],
        truths: list[Float32 | None],
    ) -> None:
        self.scene = scene
        self._echoes = echoes
        self._truths = truths
        self._sensor = renderer.Sensor(scene.rig, scene.sensor, scene.radiometry)

    @property
    def rig(self) -> Rig:
        """Rig with the lidar in this world."""
        return self.scene.rig

    def without_object(self) -> "World":
        """Return the same world with its hidden object taken away."""
        bare = self.scene.model_copy(update={"hidden": None})
        echoes, _ = render_loop(bare)
        return World(bare, echoes, [None])

    def images(self, number: int) -> renderer.SensedImages:
        """Return the images of frame `number`, the same bits each time."""
        generator = np.random.default_rng([number, len(self._echoes)])
        echoes = self._echoes[number % len(self._echoes)]
        return self._sensor.expose(echoes, generator, celsius=self._celsius(number))

    def celsius(self, number: int) -> Mapping[str, float]:
        """Return the device's temperatures at frame `number`, by the names of their options.

        Not modeled: heat flow. All differ by constants from the sensor's.
        """
        return {name: self._celsius(number) + above for name, above in CELSIUS_ABOVE.items()}

    def _celsius(self, number: int) -> float:
        """Return the sensor's temperature; it was started at frame 0."""
        return self.scene.sensor.celsius_at(number / FRAMES_PER_S)

    def truth_depth_m(self, number: int) -> Float32 | None:
        """Return the hidden depth (64, 64) at frame `number`; None without a hidden object."""
        return self._truths[number % len(self._truths)]


def open_world(name: str, on_progress: OnProgress | None = None) -> World:
    """Return the world of a scene: "" for the paper's rig with a moving object, "bare-wall", or as
    `load_scene`.

    The loops of the first two come with the package; others are rendered on first use and stored in
    the cache folder. Raises SceneError for an invalid scene.
    """
    if name == "":
        scene = renderer.paper_scene()
    elif name == "bare-wall":
        scene = renderer.bare_wall_scene()
    else:
        scene = renderer.load_scene(Path(name))
    loop = read_packaged(scene)
    if loop is None:
        cached = cache_folder() / "worlds" / f"{scene.checksum}.npz"
        loop = load_cached(
            cached, _unpack_cached, lambda: pack_loop(*render_loop(scene, on_progress))
        )
    echoes, truths = loop
    return World(scene, echoes, list(truths) if scene.hidden else [None])


def read_packaged(scene: renderer.SceneFile) -> Loop | None:
    """Return the loop of a scene that comes with the package; None where it does not, or is
    damaged.
    """
    try:
        return _unpack((WORLDS / f"{scene.checksum}.npz").read_bytes())
    except (OSError, ValueError, EOFError, KeyError, BadZipFile):
        return None


def render_loop(
    scene: renderer.SceneFile,
    on_progress: OnProgress | None = None,
    poses: Iterable[int] | None = None,
) -> Loop:
    """Render the poses of a scene's loop, by default all."""
    echoes: list[renderer.MultiBounce] = []
    truths: list[Float32] = []
    for number in range(scene.poses) if poses is None else poses:
        echoes.append(
            renderer.render_scan(lambda share, start=number: scene.scene_at(start + share)).multi
        )
        truth = scene.scene_at(number + 0.5).object_depth_m
        truths.append(np.zeros((0, 0), np.float32) if truth is None else truth)
        if on_progress:
            on_progress(len(echoes), scene.poses)
    return echoes, truths


def pack_loop(echoes: list[renderer.MultiBounce], truths: list[Float32]) -> bytes:
    """Return a loop as the content of an .npz file."""
    packed = BytesIO()
    np.savez_compressed(
        packed,
        peak_by_byte=_by_byte(echo.peak for echo in echoes),
        runner_up_by_byte=_by_byte(echo.runner_up for echo in echoes),
        path_m_by_byte=_by_byte(echo.path_m for echo in echoes),
        direct_included=echoes[0].direct_included,
        truth_m_by_byte=_by_byte(truths),
        stopped_by_byte=_by_byte(_stops(echoes)),
    )
    return packed.getvalue()


def _stops(echoes: list[renderer.MultiBounce]) -> list[Float32]:
    """Return light and length (2, rows, columns) of the beams that the object stops in each pose;
    (2, 0, 0) where it stops none in any.
    """
    if all(echo.stopped is None for echo in echoes):
        return [np.zeros((2, 0, 0), np.float32)] * len(echoes)
    nothing = np.full((2, *echoes[0].peak.shape), np.nan, np.float32)
    return [nothing if echo.stopped is None else np.stack(echo.stopped) for echo in echoes]


def _unpack(content: bytes) -> Loop:
    with np.load(BytesIO(content)) as file:
        peak = _joined(file["peak_by_byte"])
        runner_up = _joined(file["runner_up_by_byte"])
        path_m = _joined(file["path_m_by_byte"])
        truth_m = _joined(file["truth_m_by_byte"])
        mixed = bool(file["direct_included"])
        # In the packaged scenes, which were stored without this, the object stops no beam.
        stops = [None] * len(peak)
        if "stopped_by_byte" in file:
            pairs = _joined(file["stopped_by_byte"])
            stops = [renderer.StoppedBeams(*pair) if pair.size else None for pair in pairs]
        echoes = [
            renderer.MultiBounce(one_peak, second, length_m, mixed, stopped)
            for one_peak, second, length_m, stopped in zip(
                peak, runner_up, path_m, stops, strict=True
            )
        ]
        return echoes, list(truth_m)


def _unpack_cached(content: bytes) -> Loop:
    """Return the loop of a cache entry. Raises ValueError for one by a version that took the wall
    to be seen through an object that stands before it.
    """
    with np.load(BytesIO(content)) as file:
        if "stopped_by_byte" not in file:
            raise ValueError("an earlier version stored it")
    return _unpack(content)


def _by_byte(poses: Iterable[Float32]) -> UInt8:
    """Return the bytes of values (n, rows, columns) as (4, n, rows, columns): the first bytes of
    all, then the second ones.
    """
    # Neighbors share their high bytes, which a packer finds only where they stand together: a
    # fifth less to store.
    values = np.stack(list(poses))
    return np.moveaxis(values[..., None].view(np.uint8), -1, 0)


def _joined(by_byte: UInt8) -> Float32:
    """Return the values of `_by_byte`."""
    return np.ascontiguousarray(np.moveaxis(by_byte, 0, -1)).view(np.float32)[..., 0]
