"""More than fifty faults of a device, each in front of librealsense itself: the camera goes on, or
ends in one line.

Each stream may be late, missing, doubled, out of order, of another size, frozen, or wrong in
number, time or content; the device may fail in each call of the SDK, at its start or after it was
unplugged, twice or for good.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import Any

import numpy as np
import pytest

from nlos_cam.camera import FORMATS, SimulatedCamera, SoftwareLidar, simulated
from nlos_cam.errors import CameraError
from nlos_cam.frames import Frame
from nlos_cam.render import Fault

FROM = 5
UNTIL = 9
WANTED = 30
"""Numbers with the fault (from, until), and frames to be read."""
FOREVER = 10**9
UNPLUGGED = Fault(kind="unplug", at_frame=FROM, frames=30)
Push = tuple[int, float, np.ndarray]
"""Number, timestamp in s, and pixels of one frame of a stream."""


class Tampered(SoftwareLidar):
    """Device whose `streams` pass through `tamper`, which returns what is pushed instead of each
    frame.
    """

    streams: tuple[str, ...] = ()
    tamper: Callable[[int, float, np.ndarray, list[Push]], list[Push]]

    def _push(
        self, profile: Any, stream: str, number: int, timestamp_s: float, pixels: np.ndarray
    ) -> None:
        held = self.__dict__.setdefault("held", {}).setdefault(stream, [])
        is_bad = stream in self.streams and FROM <= number < UNTIL
        frames = (
            type(self).tamper(number, timestamp_s, pixels, held)
            if is_bad
            else [(number, timestamp_s, pixels)]
        )
        if not is_bad and held:
            frames = [*frames, *held]
            held.clear()
        for each in frames:
            super()._push(profile, stream, *each)


WAYS: dict[str, Callable[[int, float, np.ndarray, list[Push]], list[Push]]] = {
    "late": lambda n, t, p, held: held.append((n, t, p)) or [],
    "missing": lambda *_: [],
    "doubled": lambda n, t, p, _: [(n, t, p)] * 2,
    "five times": lambda n, t, p, _: [(n, t, p)] * 5,
    "one number for all": lambda _n, t, p, _: [(FROM, t, p)],
    "number back to 0": lambda n, t, p, _: [(n - FROM, t, p)],
    "number far ahead": lambda n, t, p, _: [(n + 10**6, t, p)],
    "clock back": lambda n, t, p, _: [(n, t - 1000.0, p)],
    "clock ahead": lambda n, t, p, _: [(n, t + 1e6, p)],
    "clock still": lambda n, _t, p, _: [(n, 1.0, p)],
    "time not a number": lambda n, _t, p, _: [(n, float("nan"), p)],
    "time infinite": lambda n, _t, p, _: [(n, float("inf"), p)],
    "frozen": lambda n, t, p, _: [(n, t, np.full_like(p, 7))],
    "black": lambda n, t, p, _: [(n, t, np.zeros_like(p))],
    "saturated": lambda n, t, p, _: [(n, t, np.full_like(p, np.iinfo(p.dtype).max))],
}
CALLS = (
    "open",
    "start",
    "get_supported_options",
    "get_option",
    "get_stream_profiles",
    "query_sensors",
)


@dataclass
class Failures:
    """Number of calls of one method of the SDK that are still to fail, and of those that failed."""

    method: str
    left: int = 0
    failed: int = 0

    def note(self, name: str) -> None:
        """Fail, if this call is to fail."""
        if name == self.method and self.left:
            self.left -= 1
            self.failed += 1
            raise RuntimeError("the device was disconnected")


class Proxy:
    """SDK object whose calls fail as `failures` say, and those of its sensors."""

    def __init__(self, inner: Any, failures: Failures) -> None:
        self._inner = inner
        self._failures = failures

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._inner, name)
        if not callable(value):
            return value

        def call(*arguments: Any) -> Any:
            self._failures.note(name)
            found = value(*arguments)
            if name == "query_sensors":
                return [Proxy(each, self._failures) for each in found]
            return found

        return call


@pytest.fixture
def camera(noise_world: Any, hurried_clock: Any) -> Callable[..., SimulatedCamera]:
    def make(*faults: Fault) -> SimulatedCamera:
        made = SimulatedCamera("sim:faulty", noise_world(), clock=hurried_clock(), faults=faults)
        made.silence_s = 0.5
        return made

    return make


def outcome(
    source: SimulatedCamera, at_frame: Callable[[], None] | None = None
) -> list[Frame] | str:
    """Return the frames that come, or the line with which the camera ends; both are checked.
    `at_frame` is called once FROM frames came.
    """
    frames = list[Frame]()
    line = ""
    try:
        with source:
            frames += islice(source, FROM)
            if at_frame:
                at_frame()
            frames += islice(source, WANTED - FROM)
    except CameraError as error:
        line = str(error)
    if line:
        assert "\n" not in line
        assert "sim:faulty" in line
        return line
    shape = frames[0].intrinsics.height, frames[0].intrinsics.width
    assert all(image.shape == shape for f in frames for image in (f.depth_m, f.ir, f.confidence))
    assert all(one.frame_number < two.frame_number for one, two in pairwise(frames))
    return frames


@pytest.mark.parametrize(
    "streams", [*((stream,) for stream in FORMATS), tuple(FORMATS)], ids="+".join
)
@pytest.mark.parametrize("way", WAYS)
def test_camera_goes_on_after_a_fault_of_its_streams(
    camera: Callable[..., SimulatedCamera],
    monkeypatch: pytest.MonkeyPatch,
    way: str,
    streams: tuple[str, ...],
) -> None:
    device = type("Device", (Tampered,), {"streams": streams, "tamper": staticmethod(WAYS[way])})
    monkeypatch.setattr(simulated, "SoftwareLidar", device)
    frames = outcome(camera())

    assert not isinstance(frames, str), frames
    assert len(frames) == WANTED


def with_failures(camera: SimulatedCamera, failures: Failures) -> SimulatedCamera:
    """Put the failures in front of each device that is plugged in from now on."""
    plug_in = camera._plug_in

    def proxied(instant: int) -> None:
        plug_in(instant)
        camera._lidar.device = Proxy(camera._lidar.device, failures)

    camera._plug_in = proxied  # type: ignore[method-assign]
    return camera


@pytest.mark.parametrize("method", CALLS)
def test_camera_whose_calls_fail_at_its_start_ends_in_a_line(
    camera: Callable[..., SimulatedCamera], method: str
) -> None:
    failures = Failures(method, left=FOREVER)
    found = outcome(with_failures(camera(), failures))

    assert isinstance(found, str)
    assert failures.failed > 0


@pytest.mark.slow
@pytest.mark.parametrize("method", CALLS)
def test_camera_goes_on_though_calls_fail_after_a_replug(
    camera: Callable[..., SimulatedCamera], method: str
) -> None:
    """Two calls: the first may be the accelerometer's, without which a camera goes on."""
    failures = Failures(method)
    frames = outcome(
        with_failures(camera(UNPLUGGED), failures), lambda: setattr(failures, "left", 2)
    )

    assert not isinstance(frames, str), frames
    assert len(frames) == WANTED
    assert failures.failed == 2


@pytest.mark.slow
@pytest.mark.parametrize("method", CALLS)
def test_camera_whose_calls_fail_for_good_ends_in_a_line(
    camera: Callable[..., SimulatedCamera], method: str
) -> None:
    failures = Failures(method)
    found = outcome(
        with_failures(camera(UNPLUGGED), failures), lambda: setattr(failures, "left", FOREVER)
    )

    assert isinstance(found, str)
    assert "unplugged" in found
    assert failures.failed > 2


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -9999.0, 1e30])
def test_camera_goes_on_with_a_mad_thermometer(
    camera: Callable[..., SimulatedCamera], monkeypatch: pytest.MonkeyPatch, value: float
) -> None:
    made = camera()
    monkeypatch.setattr(type(made._world), "celsius", lambda *_: {"ldd_temperature": value})
    frames = outcome(made)

    assert not isinstance(frames, str), frames
    assert len(frames) == WANTED
