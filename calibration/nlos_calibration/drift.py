"""Whether pose, range, settings or temperature have left the bare wall's reference, told while frames come."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot, isclose, sqrt

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.bare_wall import BareWall
from nlos_calibration.errors import CalibrationError
from nlos_calibration.projection import Intrinsics
from nlos_calibration.verdict import TOLERANCE_DEG, TOLERANCE_M
from nlos_calibration.wall_track import MIN_SHARE, Sight, WallTrack

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]

WINDOW_FRAMES, LEAST_FRAMES = 30, 15
"""A second: what is told is the median over it, of at least so many frames that showed the wall."""
SURE_SIGMAS = 4.0
"""A drift is told that is beyond a tolerance by so many standard uncertainties."""
ENDS_AT = 0.7
"""What is told stays told until it is below this share of what it took, so that it does not flicker."""
UNIFORM_MISFIT = 4.0
"""In one frame. Two parameters more take up a sum of squares of 2 that is noise."""
SHARP_TOLERANCES = 0.5
"""Where the window's uncertainty is above this many tolerances, the wall is not seen well enough."""
BLIND_FRAMES, BLIND_ENDS = 300, 10
"""So many frames without a pose are told (10 s; objects pass by); each with one counts for so many."""
MIN_PIXELS = 30
"""To watch; with fewer the pose is not looked after."""
TOLERANCE_C = 5.0
"""Nobody has published how the range of an L515 moves with its temperatures, so this is a guess: warming up shows (by
some 10 or 20 degrees), a room's ups and downs do not. What the range then does is told from the depth itself."""
ABSOLUTE_ZERO_C = -273.15
"""What is below is no temperature: an L515 says -9999 until it has measured the photodiode's."""
NO_SETTINGS = frozenset({"error_polling_enabled", "frames_queue_size", "global_time_enabled", "host_performance"})
"""Options of how the host is served."""
MEASURED = "_temperature", "noise_estimation"
"""Endings of the options that are measurements."""
ALIKE = 1e-5
"""Relative: settings are single floats on the device."""
PIXEL_TOLERANCE = 0.1
"""Of intrinsics: 0.01 degrees."""


@dataclass(frozen=True)
class Drift:
    """By how much the wall has left the reference over the last second; *_std are standard uncertainties."""

    distance_m: float
    """Positive is farther."""
    yaw_deg: float
    pitch_deg: float
    range_m: float
    """The change of every depth that explains it instead; positive is longer."""
    distance_std_m: float
    yaw_std_deg: float
    pitch_std_deg: float
    range_std_m: float
    uniform: bool
    """Whether `range_m` explains the depths as well as a lidar that moved does."""

    def tolerances(self, sigmas: float = 0.0) -> float:
        """How many tolerances it is off, at the least so many standard uncertainties from what was measured."""
        if self.uniform:
            return (abs(self.range_m) - sigmas * self.range_std_m) / TOLERANCE_M
        return max(
            (abs(self.distance_m) - sigmas * self.distance_std_m) / TOLERANCE_M,
            (abs(self.yaw_deg) - sigmas * self.yaw_std_deg) / TOLERANCE_DEG,
            (abs(self.pitch_deg) - sigmas * self.pitch_std_deg) / TOLERANCE_DEG,
        )

    @property
    def sharp(self) -> bool:
        """Whether the wall was seen well enough to tell a move of a few tolerances."""
        turn_std_deg = max(self.yaw_std_deg, self.pitch_std_deg)
        return max(self.distance_std_m / TOLERANCE_M, turn_std_deg / TOLERANCE_DEG) <= SHARP_TOLERANCES

    def __str__(self) -> str:
        """One line: what drifted, by how much, what to do."""
        if self.uniform:
            longer = _amount(self.range_m, self.range_std_m, "longer", "shorter")
            return (
                f"the range has drifted (or the lidar has moved straight back or forth): the wall's depths are {longer} "
                "than in the calibration: let the lidar warm up, then calibrate the wall again"
            )
        turn_deg, turn_std_deg = hypot(self.yaw_deg, self.pitch_deg), max(self.yaw_std_deg, self.pitch_std_deg)
        farther = _amount(self.distance_m, self.distance_std_m, "farther", "nearer")
        return (
            f"the lidar has moved: the wall is {farther} and turned by {turn_deg:.2f} +- {turn_std_deg:.2f} degrees "
            "from the calibration: calibrate the wall again"
        )


def _amount(change_m: float, std_m: float, more: str, less: str) -> str:
    return f"{abs(change_m) * 1e3:.2f} +- {std_m * 1e3:.2f} mm {more if change_m > 0 else less}"


def settings_changed(reference: BareWall, settings: Mapping[str, float]) -> tuple[str, ...]:
    """The options that are not as they were at the bare wall, with both values; what one of them lacks is no change."""
    names = sorted(name for name in reference.settings.keys() & settings.keys() if not name.endswith(MEASURED))
    pairs = [(name, reference.settings[name], settings[name]) for name in names if name not in NO_SETTINGS]
    return tuple(
        f"{name} was {before:g} and is {now:g}"
        for name, before, now in pairs
        if not isclose(before, now, rel_tol=ALIKE)
    )


def check_camera(reference: BareWall, intrinsics: Intrinsics) -> None:
    """Raise CalibrationError where a camera's frames cannot be held against the reference."""
    then = reference.intrinsics
    _check_size((intrinsics.height, intrinsics.width), then)
    names = [name for name in ("fx", "fy", "ppx", "ppy") if _differs(getattr(intrinsics, name), getattr(then, name))]
    if names:
        told = ", ".join(f"{name} {getattr(then, name):.2f}, now {getattr(intrinsics, name):.2f}" for name in names)
        raise CalibrationError(
            f"the bare wall was measured with other intrinsics ({told}): take the lidar that it was measured with, or "
            "calibrate the wall again",
        )


def _differs(pixels: float, others: float) -> bool:
    return not abs(pixels - others) <= PIXEL_TOLERANCE


def _check_size(shape: tuple[int, ...], then: Intrinsics) -> None:
    if shape != (then.height, then.width):
        size = " x ".join(str(pixels) for pixels in reversed(shape))
        raise CalibrationError(
            f"a frame of {size} pixels cannot be held against a bare wall of {then.width} x {then.height}: open the "
            "camera at that size, or calibrate the wall again",
        )


class DriftCheck:
    """Holds the frames of a stream against the bare wall's reference. Time is counted in frames, 30 in a second."""

    def __init__(self, reference: BareWall, wall_from_lidar: Array) -> None:
        self.drift: Drift | None = None
        """Over the last second; None while too few frames show the wall."""
        self._reference, self._track = reference, WallTrack(reference, wall_from_lidar)
        self._window, self._shares = np.full((WINDOW_FRAMES, 5), np.nan), np.zeros(WINDOW_FRAMES)
        self._frames, self._blind = 0, 0
        self._told: Drift | None = None
        self._blindness = ""
        self._settings: Mapping[str, float] = {}
        self._about_settings: tuple[str, ...] = ()
        self._about_celsius: dict[str, str] = {}

    @property
    def wall_share(self) -> float:
        """Of the pixels that are watched, those that showed the wall over the last second."""
        return float(self._shares[: max(min(self._frames, WINDOW_FRAMES), 1)].mean())

    def look(self, depth_m: Float32, settings: Mapping[str, float]) -> None:
        """Take a frame (height, width) in, NaN where there is no return, and the settings it was taken with.

        Raises CalibrationError for a frame of another size.
        """
        _check_size(depth_m.shape, self._reference.intrinsics)
        if settings != self._settings:
            self._settings = dict(settings)
            self._about_settings = settings_changed(self._reference, settings)
        if len(self._track.pixels) >= MIN_PIXELS:
            self._take(self._track.follow(depth_m))

    def look_at(self, celsius: Mapping[str, float]) -> None:
        """Take a reading of the device's temperatures in, by the SDK's name; what is not named stays as it was."""
        for name, now_c in celsius.items():
            if name in self._reference.celsius and now_c > ABSOLUTE_ZERO_C:
                self._about_celsius[name] = self._about_temperature(name, now_c)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to tell now: a line each, which stays as it is while nothing changes; empty while all is well."""
        told = [str(self._told)] if self._told else []
        if self._about_settings:
            changes = ", ".join(self._about_settings)
            told.append(f"settings have changed since the wall was measured: {changes}: calibrate the wall again")
        if len(self._track.pixels) < MIN_PIXELS:
            told.append(
                f"the bare wall's reference has {len(self._track.pixels)} good pixels to watch, {MIN_PIXELS} needed: a "
                "lidar that moves is not noticed: calibrate the wall again"
            )
        return (*told, *filter(None, (self._blindness, *self._about_celsius.values())))

    def _take(self, sight: Sight | None) -> None:
        place = self._frames % WINDOW_FRAMES
        self._window[place] = np.nan if sight is None else tuple(vars(sight).values())
        self._shares[place] = self._track.share
        self._frames += 1
        self.drift = _drift_of(self._window, self._reference.frames)
        self._tell()
        self._tell_blindness()

    def _tell(self) -> None:
        """Begin, renew or end what is told of the pose; where the wall is hidden, what was told stays."""
        if self.drift is None:
            return
        if self._told is None:
            self._told = self.drift if self.drift.tolerances(SURE_SIGMAS) > 1.0 else None
        elif self.drift.tolerances() < ENDS_AT:
            self._told = None
        elif _apart(self._told, self.drift):
            self._told = self.drift

    def _tell_blindness(self) -> None:
        sees = self.drift is not None and self.drift.sharp
        self._blind = max(self._blind - BLIND_ENDS, 0) if sees else min(self._blind + 1, BLIND_FRAMES)
        if self._blind == 0:
            self._blindness = ""
        elif self._blind == BLIND_FRAMES and not self._blindness:
            self._blindness = (
                f"{self.wall_share:.0%} of the wall is seen where it was calibrated, too little to notice a lidar that "
                "moves: look once with nothing hidden and nothing before the wall, and if this stays, calibrate it again"
            )

    def _about_temperature(self, name: str, now_c: float) -> str:
        then_c, span_c = self._reference.celsius[name], self._reference.celsius_span.get(name, 0.0)
        least_c = max(TOLERANCE_C, span_c) * (ENDS_AT if self._about_celsius.get(name) else 1.0)
        if abs(now_c - then_c) <= least_c:
            return ""
        about = f"{name} is {now_c:.0f} degrees C, {then_c:.0f} when the wall was measured: "
        return about + ("let the lidar warm up" if now_c < then_c else "calibrate the wall again")


def _drift_of(window: Array, reference_frames: int) -> Drift | None:
    """The medians of the frames that show the wall; None for too few.

    The spread over the frames holds what noise and passing objects do. The median's uncertainty is sqrt(pi / 2) of the
    mean's, and the reference was taken with the same noise.
    """
    seen = window[window[:, 0] == window[:, 0]]  # noqa: PLR0124  NaN is no sight
    if len(seen) < LEAST_FRAMES:
        return None
    middle = len(seen) // 2
    median = np.sort(seen, axis=0)[middle]
    spread = 1.4826 * np.sort(np.abs(seen - median), axis=0)[middle]
    stds = spread * sqrt(np.pi / 2 / len(seen) + 1 / max(reference_frames, 1))
    *changes, misfit = median.tolist()
    return Drift(*changes, *stds[:4].tolist(), uniform=misfit < UNIFORM_MISFIT)


def _apart(told: Drift, now: Drift) -> bool:
    """Whether what was told is no longer what is."""
    if told.uniform != now.uniform:
        return True
    return (
        abs(now.range_m - told.range_m) > TOLERANCE_M
        or abs(now.distance_m - told.distance_m) > TOLERANCE_M
        or hypot(now.yaw_deg - told.yaw_deg, now.pitch_deg - told.pitch_deg) > TOLERANCE_DEG
    )
