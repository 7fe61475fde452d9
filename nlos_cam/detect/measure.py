"""Measurement: a camera's frames to turns, under each setting of the plan."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np

from nlos_cam.camera import QUEUED_SETS, Camera
from nlos_cam.detect.hands import Hands
from nlos_cam.detect.plan import BASELINE, Setting
from nlos_cam.detect.session import Session, how_to_go_on
from nlos_cam.detect.turns import Turn, TurnSums
from nlos_cam.errors import CameraError, CameraLostError
from nlos_cam.frames import Frame

SETTLING_FRAMES = 15 + QUEUED_SETS
"""Frames that are left out after a change: those that wait in the camera's queue, and half a second
to come to rest."""
SWEPT = {
    "laser_power": (0.1, 0.5, 1.0),
    "digital_gain": (0.0, 1.0),
    "receiver_gain": (0.0, 0.5, 1.0),
    "min_distance": (0.0, 1.0),
    "noise_filtering": (0.0, 1.0),
    "confidence_threshold": (0.0, 1.0),
    "pre_processing_sharpening": (1.0,),
    "post_processing_sharpening": (1.0,),
    "invalidation_bypass": (0.0, 1.0),
}
"""Options of a sweep, one at a time, at these shares of the range that the firmware reports."""


@runtime_checkable
class AdjustableCamera(Protocol):
    """Camera with options that can be set while it runs."""

    def adjustable(self) -> list[dict[str, Any]]:
        """Return name, value, min, max and step of each option."""
        ...

    def set_option(self, name: str, value: float) -> str:
        """Set an option to the nearest allowed value; raises CameraError."""
        ...


def setting_as_started(camera: Camera) -> Setting:
    """Return the options that an entered camera started with, so that a session which goes on later
    is measured under them too: a lidar may choose its laser power at every start.
    """
    return _as_started(_swept_options(camera))


def _as_started(swept: Mapping[str, Mapping[str, Any]]) -> Setting:
    options = {name: float(each["value"]) for name, each in swept.items()}
    return Setting(name=BASELINE.name, options=options)


def _swept_options(camera: Camera) -> dict[str, dict[str, Any]]:
    """Return the options of an entered camera that a sweep changes; none of one without options.

    Only those that it takes again at their present values: each turn sets them, and a firmware may
    refuse some.
    """
    if not isinstance(camera, AdjustableCamera):
        return {}
    return {
        each["name"]: each
        for each in camera.adjustable()
        if each["name"] in SWEPT and _accepts(camera, each["name"], float(each["value"]))
    }


def swept_settings(camera: Camera) -> tuple[Setting, ...]:
    """Return the settings of a sweep that an entered camera accepts: as it started, then one option
    changed at a time.

    Raises CameraError for a camera without options.
    """
    swept = _swept_options(camera)
    if not isinstance(camera, AdjustableCamera) or not swept:
        raise CameraError(f"{camera.uri} offers no options to sweep: leave out --settings sweep")
    as_started = _as_started(swept)
    start = as_started.options
    settings = [as_started]
    for name, each in swept.items():
        for share in SWEPT[name]:
            steps = round(share * (each["max"] - each["min"]) / each["step"])
            value = min(each["min"] + steps * each["step"], each["max"])
            setting = Setting(name=f"{name} {value:g}", options=start | {name: value})
            if value != start[name] and setting not in settings and _accepts(camera, name, value):
                settings.append(setting)
        camera.set_option(name, start[name])
    return tuple(settings)


def _accepts(camera: AdjustableCamera, name: str, value: float) -> bool:
    try:
        camera.set_option(name, value)
    except CameraError:
        return False
    return True


def measure_turns(
    session: Session,
    camera: Camera,
    hands: Hands,
    on_frame: Callable[[], None] = lambda: None,
) -> None:
    """Measure the session's missing turns with an entered camera; each is stored once it is whole.

    Raises CameraLostError where frames end.
    """
    frames = iter(camera)
    order = session.plan.order()
    missing = session.missing()
    for number in missing:  # of a block that is measured again, no earlier turn may remain
        session.path(number).unlink(missing_ok=True)
    for number in missing:
        object_in = bool(order[number])
        hands.place(number, object_in=object_in)
        turn = measure_turn(frames, camera, session, object_in=object_in, on_frame=on_frame)
        turn.save(session.path(number))


def measure_turn(
    frames: Iterator[Frame],
    camera: Camera,
    session: Session,
    *,
    object_in: bool,
    on_frame: Callable[[], None] = lambda: None,
) -> Turn:
    """Return one turn, measured under each setting of the plan."""
    plan = session.plan
    times_s: list[float] = []
    means: list[Any] = []
    stds: list[Any] = []
    for setting in plan.settings:
        _set_options(camera, setting.options)
        sums = TurnSums()
        for number in range(SETTLING_FRAMES + plan.frames):
            frame = next(frames, None)
            if frame is None:
                raise CameraLostError(
                    f"{camera.uri} ended within a turn: the turns before it are in"
                    f" {session.folder}; {how_to_go_on(session.folder)}"
                )
            if number >= SETTLING_FRAMES:
                sums.add(frame)
            on_frame()
        time_s, mean, std = sums.statistics()
        times_s.append(time_s)
        means.append(mean)
        stds.append(std)
    celsius = dict(camera.telemetry("_temperature"))
    return Turn(object_in, np.array(times_s), np.stack(means), np.stack(stds), plan.frames, celsius)


def _set_options(camera: Camera, options: Mapping[str, float]) -> None:
    if options and isinstance(camera, AdjustableCamera):
        for name, value in options.items():
            camera.set_option(name, value)
