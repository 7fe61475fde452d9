"""Whether pose, range, settings or temperature have left the bare wall's reference, told while frames come.

What a second of frames says of the wall together: by how much it has left the reference, and how surely.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot, isclose

import numpy as np

from nlos_calibration.arrays import Float32, Float64
from nlos_calibration.errors import CalibrationError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.reference import BareWall
from nlos_calibration.wall import TOLERANCE_DEG, TOLERANCE_M
from nlos_calibration.wall_tracker import WallObservation, WallTrack

WINDOW_FRAMES, MIN_FRAMES = 30, 15
"""What is told is the median over the first, of at least so many that showed the wall."""
UNIFORM_MISFIT = 3.0
"""In one frame. The plane's two parameters more take up a sum of squares of 2 that is noise."""
CARRIED_OVER = 1.25
"""A fit that begins where the last one ended is not independent of it: by so much the median is less sure than the
spread says, as simulated."""
SHARP_TOLERANCES = 0.5


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
        """How many tolerances it is off at the least, allowing for so many standard uncertainties."""
        if self.uniform:
            return (abs(self.range_m) - sigmas * self.range_std_m) / TOLERANCE_M
        return max(
            (abs(self.distance_m) - sigmas * self.distance_std_m) / TOLERANCE_M,
            (abs(self.yaw_deg) - sigmas * self.yaw_std_deg) / TOLERANCE_DEG,
            (abs(self.pitch_deg) - sigmas * self.pitch_std_deg) / TOLERANCE_DEG,
        )

    @property
    def sharp(self) -> bool:
        """Whether the wall was seen well enough to tell a lidar that moves by a few tolerances."""
        turn_std_deg = max(self.yaw_std_deg, self.pitch_std_deg)
        return max(self.distance_std_m / TOLERANCE_M, turn_std_deg / TOLERANCE_DEG) <= SHARP_TOLERANCES

    def apart(self, other: "Drift") -> bool:
        """Whether another drift is of another kind, or by more than a tolerance another."""
        if self.uniform or other.uniform:
            return self.uniform != other.uniform or abs(self.range_m - other.range_m) > TOLERANCE_M
        turn_deg = hypot(self.yaw_deg - other.yaw_deg, self.pitch_deg - other.pitch_deg)
        return abs(self.distance_m - other.distance_m) > TOLERANCE_M or turn_deg > TOLERANCE_DEG

    def __str__(self) -> str:
        """One line: what drifted, by how much, what to do."""
        if self.uniform:
            return (
                "the range has drifted (or the lidar has moved straight back or forth): depths of the wall are "
                f"{_amount(self.range_m, self.range_std_m, 'longer', 'shorter')} than in the calibration: let the "
                "lidar warm up, then calibrate the wall again"
            )
        turn_deg, turn_std_deg = hypot(self.yaw_deg, self.pitch_deg), max(self.yaw_std_deg, self.pitch_std_deg)
        return (
            f"the lidar has moved: the wall is {_amount(self.distance_m, self.distance_std_m, 'farther', 'nearer')} "
            f"and turned by {turn_deg:.2f} +- {turn_std_deg:.2f} degrees from the calibration: calibrate the wall again"
        )


def _amount(change_m: float, std_m: float, more: str, less: str) -> str:
    return f"{abs(change_m) * 1e3:.2f} +- {std_m * 1e3:.2f} mm {more if change_m > 0 else less}"


class DriftWindow:
    """The last frames of a WallTrack. Time is counted in frames, 30 in a second."""

    def __init__(self, reference_frames: int) -> None:
        self._reference_frames, self._frames = reference_frames, 0
        self._sights = np.full((WINDOW_FRAMES, len(WallObservation._fields)), np.nan)
        self._shares = np.zeros(WINDOW_FRAMES)

    def add(self, sight: WallObservation | None, share: float) -> None:
        """Take in what a frame said, and the share of the watched pixels that showed the wall."""
        place = self._frames % WINDOW_FRAMES
        self._sights[place] = np.nan if sight is None else sight
        self._shares[place] = share
        self._frames += 1

    @property
    def share(self) -> float:
        """Of the watched pixels, those that showed the wall; 0 before the first frame."""
        return float(self._shares.sum()) / max(min(self._frames, WINDOW_FRAMES), 1)

    def drift(self) -> Drift | None:
        """The medians of the frames that show the wall; None for too few.

        The spread over the frames holds what noise and passing objects do. A median's uncertainty is sqrt(pi / 2) times
        a mean's, and the reference was taken with the same noise.
        """
        seen = self._sights[~np.isnan(self._sights[:, 0])]
        if len(seen) < MIN_FRAMES:
            return None
        middle = len(seen) // 2
        median = np.sort(seen, axis=0)[middle]
        off = np.abs(seen - median)
        spread = 1.4826 * np.sort(off, axis=0)[middle]
        agreeing = np.maximum((off <= 3.0 * spread).sum(axis=0), 1)  # just after a knock, half of them
        share = np.pi / 2 / agreeing + 1 / max(self._reference_frames, 1)
        *stds, _ = (CARRIED_OVER * spread * np.sqrt(share)).tolist()
        *changes, misfit = median.tolist()
        return Drift(*changes, *stds, uniform=misfit < UNIFORM_MISFIT)


SURE_SIGMAS = 4.0
"""A drift is told that is beyond a tolerance by so many standard uncertainties."""
ENDS_AT = 0.7
"""What is told stays told until it is below this share of what it took, so that it does not flicker."""
MAX_RANGE_DRIFT_M = 0.005
"""What a temperature may do to the range, by the data sheet's accuracy; beyond it the lidar has moved straight back or
forth."""
BLIND_FRAMES, BLIND_ENDS = 300, 10
"""So many frames without a pose are told (10 s; objects pass by); each frame with one counts for so many."""
MIN_PIXELS = 30
"""To watch; with fewer the pose is not looked after."""
TOLERANCE_C = 5.0
"""Nobody has published how the range of an L515 moves with its temperatures, so this is a guess: warming up shows, a
room's ups and downs do not. What the range then does is told from the depth itself."""
ABSOLUTE_ZERO_C = -273.15
"""What is below is no temperature: an L515 says -9999 until it has measured the photodiode's."""
HOST_OPTIONS = frozenset({"error_polling_enabled", "frames_queue_size", "global_time_enabled", "host_performance"})
"""How the host is served; nothing of it is in the depth."""
MEASURED = "_temperature", "noise_estimation"
"""Endings of the options that are measurements."""
ALIKE = 1e-5
"""Relative: a device keeps its settings as single floats."""


def settings_changed(reference: BareWall, settings: Mapping[str, float]) -> tuple[str, ...]:
    """The options that are not as they were at the bare wall, with both values.

    Measurements are no settings, and an option that only one of both tells of is no change.
    """
    then = {name: value for name, value in reference.settings.items() if name in settings}
    changed = [name for name, value in then.items() if not isclose(value, settings[name], rel_tol=ALIKE)]
    told = sorted(name for name in changed if not name.endswith(MEASURED) and name not in HOST_OPTIONS)
    return tuple(f"{name} was {then[name]:g} and is {settings[name]:g}" for name in told)


def _check_size(shape: tuple[int, ...], then: Intrinsics) -> None:
    if shape != (then.height, then.width):
        size = " x ".join(str(pixels) for pixels in reversed(shape))
        raise CalibrationError(
            f"a frame of {size} pixels cannot be held against a bare wall of {then.width} x {then.height}: open the "
            "camera at that size, or calibrate the wall again",
        )


class DriftCheck:
    """Holds the frames of a stream against the bare wall's reference. Time is counted in frames, 30 in a second."""

    def __init__(self, reference: BareWall, wall_from_lidar: Float64) -> None:
        self.drift: Drift | None = None
        """Over the last second; None while too few frames show the wall."""
        self._reference = reference
        self._track, self._window = WallTrack(reference, wall_from_lidar), DriftWindow(reference.frames)
        self._watches = len(self._track.pixels) >= MIN_PIXELS
        self._told: Drift | None = None
        self._blind, self._blindness = 0, ""
        self._settings: Mapping[str, float] = {}
        self._about_settings: tuple[str, ...] = ()
        self._about_celsius: dict[str, str] = {}

    @property
    def wall_share(self) -> float:
        """Of the pixels that are watched, those that showed the wall over the last second."""
        return self._window.share

    @property
    def moved(self) -> bool:
        """Whether it is told that the lidar has moved, or no longer sees the wall; a range that drifts a little is not.

        As with `warnings`, the answer does not flicker.
        """
        if (told := self._told) is None:
            return bool(self._blindness)
        return not told.uniform or abs(told.range_m) > MAX_RANGE_DRIFT_M

    def look(self, depth_m: Float32, settings: Mapping[str, float]) -> None:
        """Take a frame (height, width) in, NaN where there is no return, and the settings it was taken with.

        Raises CalibrationError for a frame of another size.
        """
        _check_size(depth_m.shape, self._reference.intrinsics)
        if settings != self._settings:
            self._settings = dict(settings)
            self._about_settings = settings_changed(self._reference, settings)
        if self._watches:
            self._window.add(self._track.follow(depth_m), self._track.share)
            self.drift = self._window.drift()
            self._tell_drift()
            self._tell_blindness()

    def look_at(self, celsius: Mapping[str, float]) -> None:
        """Take a reading of the device's temperatures in, by the SDK's name; what is not named stays as it was."""
        for name, now_c in celsius.items():
            if name in self._reference.celsius and now_c > ABSOLUTE_ZERO_C:
                self._about_celsius[name] = self._about_temperature(name, now_c)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to tell now, a line each; they stay as they are while nothing changes. Empty while all is well."""
        lines = [str(self._told) if self._told else "", self._blindness, self._about_temperatures()]
        if self._about_settings:
            changes = ", ".join(self._about_settings)
            lines.append(f"settings have changed since the wall was measured: {changes}: calibrate the wall again")
        if not self._watches:
            lines.append(
                f"the bare wall's reference has {len(self._track.pixels)} good pixels to watch, {MIN_PIXELS} needed: a "
                "lidar that moves would not be noticed: calibrate the wall again"
            )
        return tuple(line for line in lines if line)

    def _tell_drift(self) -> None:
        """Begin, renew or end what is told of the pose; while the wall is hidden, what was told stays."""
        if self.drift is None:
            return
        if self._told is None:
            self._told = self.drift if self.drift.tolerances(SURE_SIGMAS) > 1.0 else None
        elif self.drift.tolerances() < ENDS_AT:
            self._told = None
        elif self._told.apart(self.drift):
            self._told = self.drift

    def _tell_blindness(self) -> None:
        sees = self.drift is not None and self.drift.sharp
        self._blind = max(self._blind - BLIND_ENDS, 0) if sees else min(self._blind + 1, BLIND_FRAMES)
        if self._blind == 0:
            self._blindness = ""
        elif self._blind == BLIND_FRAMES and not self._blindness:
            self._blindness = (
                f"{self.wall_share:.0%} of the wall is seen where it was calibrated, too little to notice a lidar that "
                "moves: look once with nothing hidden; if this stays, it has moved far: calibrate the wall again"
            )

    def _about_temperatures(self) -> str:
        """Of several that are off, the first: they are of one device."""
        told = [line for line in self._about_celsius.values() if line]
        others = f" ({len(told) - 1} more of its temperatures are off)" if len(told) > 1 else ""
        return told[0] + others if told else ""

    def _about_temperature(self, name: str, now_c: float) -> str:
        then_c, span_c = self._reference.celsius[name], self._reference.celsius_span.get(name, 0.0)
        least_c = max(TOLERANCE_C, span_c) * (ENDS_AT if self._about_celsius.get(name) else 1.0)
        if abs(now_c - then_c) <= least_c:
            return ""
        about = f"{name} is {now_c:.0f} degrees C and was {then_c:.0f} when the wall was measured: "
        return about + ("let the lidar warm up" if now_c < then_c else "calibrate the wall again")
