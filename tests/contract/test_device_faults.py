"""More than fifty faults of a device, each in front of librealsense itself: the camera goes on, or
ends in one line.

Each stream may be late, missing, doubled, out of order, of another size, frozen, or wrong in
number, time or content; the device may vanish or fail in each call of the SDK, once or for good.
"""

from collections.abc import Callable
from itertools import islice, pairwise
from typing import Any

import numpy as np
import pytest

from nlos_cam.camera import FORMATS, SimulatedCamera, SoftwareLidar, simulated
from nlos_cam.errors import CameraError
from nlos_cam.frames import Frame

FROM = 5
UNTIL = 9
WANTED = 30
"""Numbers with the fault (from, until), and frames to be read."""
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


class Proxy:
    """SDK object that fails in one method, from a number of calls on, for so many calls."""

    def __init__(self, inner: Any, method: str, calls: list[int], failing: range) -> None:
        self._inner = inner
        self._method = method
        self._calls = calls
        self._failing = failing

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._inner, name)
        if name == "query_sensors":
            self._note(name)
            return lambda: [
                Proxy(each, self._method, self._calls, self._failing) for each in value()
            ]
        if not callable(value):
            return value

        def call(*arguments: Any) -> Any:
            self._note(name)
            return value(*arguments)

        return call

    def _note(self, name: str) -> None:
        if name == self._method:
            self._calls.append(1)
            if len(self._calls) - 1 in self._failing:
                raise RuntimeError("the device was disconnected")


@pytest.fixture
def camera(noise_world: Any, hurried_clock: Any) -> Callable[[], SimulatedCamera]:
    def make() -> SimulatedCamera:
        made = SimulatedCamera("sim:faulty", noise_world(), clock=hurried_clock())
        made.silence_s = 0.5
        return made

    return make


def outcome(make: Callable[[], SimulatedCamera]) -> list[Frame] | str:
    """Return the frames that come, or the line with which the camera ends; both are checked."""
    frames = list[Frame]()
    line = ""
    try:
        with make() as source:
            frames += islice(source, WANTED)
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
    camera: Callable[[], SimulatedCamera],
    monkeypatch: pytest.MonkeyPatch,
    way: str,
    streams: tuple[str, ...],
) -> None:
    device = type("Device", (Tampered,), {"streams": streams, "tamper": staticmethod(WAYS[way])})
    monkeypatch.setattr(simulated, "SoftwareLidar", device)
    frames = outcome(camera)

    assert len(frames) == WANTED
    assert not isinstance(frames, str), frames


@pytest.mark.parametrize("lasts", ["once", "for good"])
@pytest.mark.parametrize("method", CALLS)
def test_camera_goes_on_or_ends_in_a_line_when_a_call_fails(
    camera: Callable[[], SimulatedCamera], method: str, lasts: str
) -> None:
    calls: list[int] = []
    failing = range(1, 2) if lasts == "once" else range(1, 10**9)

    def make() -> SimulatedCamera:
        made = camera()
        plug_in = made._plug_in

        def proxied(instant: int) -> None:
            plug_in(instant)
            made._lidar.device = Proxy(made._lidar.device, method, calls, failing)

        made._plug_in = proxied  # type: ignore[method-assign]
        return made

    assert outcome(make)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -9999.0, 1e30])
def test_camera_goes_on_with_a_mad_thermometer(
    camera: Callable[[], SimulatedCamera], monkeypatch: pytest.MonkeyPatch, value: float
) -> None:
    make = camera()
    monkeypatch.setattr(type(make._world), "celsius", lambda *_: {"ldd_temperature": value})

    assert len(outcome(lambda: make)) == WANTED
