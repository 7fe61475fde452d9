"""Small frames, a camera that yields them, and a network with the same result for all."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from threading import Event
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
from nlos_calibration import Intrinsics, load_rig

from nlos_cam.frames import Frame, maps_from_frame
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import FrameResult, Reconstruction
from nlos_cam.render import SensedImages
from nlos_cam.view.viewer import Moment, NullViewer

RIG = load_rig("paper-rig")
SMALL = Intrinsics(80, 64, 57.0, 61.0, 39.5, 31.5)
SERIAL = "f0246262"
NOTHING = Reconstruction(np.full((64, 64), np.nan, np.float32), object_box(RIG), None, {})


def assert_exposed(frame: Frame, images: SensedImages) -> None:
    """Assert that a frame holds every bit of its exposure."""
    depth_z16 = np.nan_to_num(frame.depth_m / np.float32(frame.settings["depth_units"])).round()
    np.testing.assert_array_equal(np.isnan(frame.depth_m), images.depth_z16 == 0)
    np.testing.assert_array_equal(depth_z16, images.depth_z16)
    np.testing.assert_array_equal(frame.ir, images.ir)
    np.testing.assert_array_equal(frame.confidence, images.confidence)


def sheet_network(*_: np.ndarray) -> np.ndarray:
    """Reconstruct a flat sheet from any maps."""
    return np.full((1, 64, 64), 0.5, np.float32)


class SheetNetwork:
    """Network, trained on the paper's rig, that shows a sheet and keeps the depth maps that it is
    given.
    """

    runtime = "nothing at all"

    def __init__(self) -> None:
        self.given: list[np.ndarray] = []
        self.record = SimpleNamespace(
            rig_name=RIG.name,
            rig_checksum=RIG.checksum,
            rig=None,
            bare_wall_counts=None,
            input="raw maps",
            figures={},
        )

    def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        assert depth_m.shape == intensity.shape == (len(depth_m), 64, 80)
        self.given.extend(depth_m)
        return np.full((len(depth_m), 64, 64), 0.5, np.float32)


def small_frame(number: int, offset_s: float = 0.0) -> Frame:
    """Make frame `number` of 30 a second, at constant depth; its timestamp starts at `offset_s`."""
    depth_m = np.full((64, 80), 0.3, np.float32)
    ir = np.full((64, 80), 9, np.uint8)
    return Frame(depth_m, ir, ir, offset_s + number / 30, number, SMALL)


def result_of(frame: Frame, **fields: Any) -> FrameResult:
    """Return a frame's result without a surface; `fields` replace its own."""
    return FrameResult(
        **{
            "frame": frame,
            "maps": maps_from_frame(frame),
            "reconstruction": NOTHING,
            "published_s": 0.0,
            "stages_s": {},
            **fields,
        }
    )


class FrameCamera:
    """Camera of `count` frames (None: no end); calls `on_frame` before each, and sets `closed` when
    it is closed.
    """

    intrinsics = SMALL
    rig = None
    incomplete = 0
    dropped = 0

    def __init__(
        self,
        count: int | None,
        on_frame: Callable[[int], object] = lambda _: None,
        *,
        make: Callable[[int], Frame] = small_frame,
        uri: str = "bag:fake.bag",
    ) -> None:
        self.uri = uri
        self.identity = {"serial": SERIAL}
        self.counts = Counter[str]()
        self.closed = Event()
        self._count = count
        self._on_frame = on_frame
        self._make = make

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.closed.set()

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        del ending
        return {}

    def __iter__(self) -> Iterator[Frame]:
        number = 0
        while self._count is None or number < self._count:
            self._on_frame(number)
            yield self._make(number)
            number += 1


class ListViewer(NullViewer):
    """Viewer that keeps every moment."""

    def __init__(self) -> None:
        self.moments: list[Moment] = []

    def show(self, moment: Moment) -> None:
        self.moments.append(moment)
