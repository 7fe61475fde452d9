"""Drift check: comparison of live frames with the bare wall's reference in pose, range, settings
and temperature.

The changes of single frames (`wall_tracker`) are combined over a second into a median with its
uncertainty.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot, isclose

import numpy as np

from nlos_calibration.arrays import Float32, Float64
from nlos_calibration.errors import CalibrationError
from nlos_calibration.noise import SCATTER_PER_MEDIAN, with_degrees, with_mm
from nlos_calibration.reference import BareWall, is_temperature
from nlos_calibration.wall import TOLERANCE_DEG, TOLERANCE_M
from nlos_calibration.wall_tracker import WallObservation, WallTrack

WINDOW_FRAMES = 30
MIN_FRAMES = 15
"""Frames that medians are taken over, and number of these that must show the wall."""
UNIFORM_MISFIT = 3.0
"""Largest misfit of a constant change of range, per frame: by noise, the plane's two further
parameters absorb a sum of squares of 2."""
CARRIED_OVER = 1.25
"""Factor on the median's uncertainty, from simulation: each fit begins at the previous one and
depends on it.
"""
SHARP_TOLERANCES = 0.5


@dataclass(frozen=True)
class Drift:
    """Change of the wall against the reference over the last second; *_std are standard
    uncertainties.
    """

    distance_m: float
    """Positive is farther."""
    yaw_deg: float
    pitch_deg: float
    range_m: float
    """Alternative explanation: one constant change of every depth; positive is longer."""
    distance_std_m: float
    yaw_std_deg: float
    pitch_std_deg: float
    range_std_m: float
    uniform: bool
    """True if `range_m` explains the depths as well as a moved lidar does."""

    def tolerances(self, sigmas: float = 0.0) -> float:
        """Return the drift in tolerances, less `sigmas` standard uncertainties."""
        if self.uniform:
            return (abs(self.range_m) - sigmas * self.range_std_m) / TOLERANCE_M
        # The worst of three, not their sum: each tolerance is one that the reconstruction bears by
        # itself.
        return max(
            (abs(self.distance_m) - sigmas * self.distance_std_m) / TOLERANCE_M,
            (abs(self.yaw_deg) - sigmas * self.yaw_std_deg) / TOLERANCE_DEG,
            (abs(self.pitch_deg) - sigmas * self.pitch_std_deg) / TOLERANCE_DEG,
        )

    @property
    def sharp(self) -> bool:
        """True if the uncertainties are small enough to detect a lidar that moves by a few
        tolerances.
        """
        turn_std_deg = max(self.yaw_std_deg, self.pitch_std_deg)
        return (
            max(self.distance_std_m / TOLERANCE_M, turn_std_deg / TOLERANCE_DEG) <= SHARP_TOLERANCES
        )

    def apart(self, other: "Drift") -> bool:
        """Return True if two drifts differ in kind, or by more than a tolerance."""
        # A change of range and a moved lidar explain the same depths: their figures cannot be
        # compared with each other.
        if self.uniform or other.uniform:
            return self.uniform != other.uniform or abs(self.range_m - other.range_m) > TOLERANCE_M
        # Yaw and pitch turn about perpendicular axes: for small angles the whole turn is their
        # hypotenuse.
        turn_deg = hypot(self.yaw_deg - other.yaw_deg, self.pitch_deg - other.pitch_deg)
        return abs(self.distance_m - other.distance_m) > TOLERANCE_M or turn_deg > TOLERANCE_DEG

    def __str__(self) -> str:
        """Return one line: kind of drift, amount with its 95 % interval, remedy."""
        if self.uniform:
            return (
                "the range has drifted (or the lidar has moved straight back or forth): depths of"
                f" the wall are {_amount(self.range_m, self.range_std_m, 'longer', 'shorter')} than"
                " in the calibration: let the lidar warm up, then calibrate the wall again"
            )
        turn = with_degrees(
            hypot(self.yaw_deg, self.pitch_deg), max(self.yaw_std_deg, self.pitch_std_deg)
        )
        return (
            "the lidar has moved: the wall is"
            f" {_amount(self.distance_m, self.distance_std_m, 'farther', 'nearer')} and turned by"
            f" {turn} against the calibration: calibrate the wall again"
        )


def _amount(change_m: float, std_m: float, more: str, less: str) -> str:
    return f"{with_mm(abs(change_m), std_m)} {more if change_m > 0 else less}"


class DriftWindow:
    """Ring buffer of the last WINDOW_FRAMES observations of a WallTrack. One thread."""

    def __init__(self, reference_frames: int) -> None:
        self._reference_frames = reference_frames
        self._frames = 0
        self._observations = np.full((WINDOW_FRAMES, len(WallObservation._fields)), np.nan)
        self._shares = np.zeros(WINDOW_FRAMES)

    def add(self, observation: WallObservation | None, share: float) -> None:
        """Add a frame's observation, and the share of the watched pixels that showed the wall."""
        # A frame without a pose takes its place too: medians are over a second, not over 30 poses.
        place = self._frames % WINDOW_FRAMES
        self._observations[place] = np.nan if observation is None else observation
        self._shares[place] = share
        self._frames += 1

    @property
    def share(self) -> float:
        """Mean share of the watched pixels that showed the wall; 0 before the first frame."""
        return float(self._shares.sum()) / max(min(self._frames, WINDOW_FRAMES), 1)

    def drift(self) -> Drift | None:
        """Return the medians over the frames that show the wall, and their uncertainty; None for
        too few frames.
        """
        valid = self._observations[~np.isnan(self._observations[:, 0])]
        if len(valid) < MIN_FRAMES:
            return None
        # The spread over the frames contains noise and passing objects. The median of n frames has
        # the variance (pi / 2) spread^2 / n; the reference, a mean over its frames with the same
        # noise, adds spread^2 / frames.
        middle = len(valid) // 2
        median = np.sort(valid, axis=0)[middle]
        off = np.abs(valid - median)
        spread = SCATTER_PER_MEDIAN * np.sort(off, axis=0)[middle]
        # Just after a knock half of the frames agree with the median, and only these count.
        agreeing = np.maximum((off <= 3.0 * spread).sum(axis=0), 1)
        share = np.pi / 2 / agreeing + 1 / max(self._reference_frames, 1)
        *stds, _ = (CARRIED_OVER * spread * np.sqrt(share)).tolist()
        *changes, misfit = median.tolist()
        return Drift(*changes, *stds, uniform=misfit < UNIFORM_MISFIT)


SURE_SIGMAS = 4.0
"""Standard uncertainties by which a drift must exceed a tolerance to be reported."""
ENDS_AT = 0.7
"""A reported drift ends below this share of the limit that it began at: hysteresis against
flicker.
"""
MAX_RANGE_DRIFT_M = 0.005
"""Largest change of range by temperature, from the data sheet's accuracy; beyond it the lidar has
moved straight back or forth."""
BLIND_FRAMES = 300
BLIND_ENDS = 10
"""Frames without a pose until a warning (10 s, since objects pass by), and frames that one with a
pose takes back.
"""
MIN_PIXELS = 30
"""Watched pixels needed to track the pose."""
TOLERANCE_C = 5.0
"""Nobody has published how the range of an L515 moves with its temperatures, so this is a guess
between warming up and a room's fluctuations. The resulting change of range is measured from the
depth itself."""
HOST_OPTIONS = frozenset(
    {"error_polling_enabled", "frames_queue_size", "global_time_enabled", "host_performance"}
)
"""Options of the host's software, without effect on the depth."""
MEASURED = "_temperature", "noise_estimation"
"""Endings of options that are measurements."""
ALIKE = 1e-5
"""Relative tolerance: a device stores its settings as single floats."""


def settings_changed(reference: BareWall, settings: Mapping[str, float]) -> tuple[str, ...]:
    """Return the settings that differ from those of the bare wall, with both values.

    Measurements, options of the host and options that only one of both has are ignored.
    """
    then = {name: value for name, value in reference.settings.items() if name in settings}
    changed = [
        name for name, value in then.items() if not isclose(value, settings[name], rel_tol=ALIKE)
    ]
    names = sorted(
        name for name in changed if not name.endswith(MEASURED) and name not in HOST_OPTIONS
    )
    return tuple(f"{name} was {then[name]:g} and is {settings[name]:g}" for name in names)


class DriftCheck:
    """Comparison of a stream's frames with the bare wall's reference, with warnings that do not
    flicker.

    Stateful, one thread: feed frames in order. Time is counted in frames, 30 per second.
    """

    def __init__(self, reference: BareWall, wall_from_lidar: Float64) -> None:
        self.drift: Drift | None = None
        """Drift over the last second; None while too few frames show the wall."""
        self._reference = reference
        self._track = WallTrack(reference, wall_from_lidar)
        self._window = DriftWindow(reference.frames)
        self._watches = len(self._track.pixels) >= MIN_PIXELS
        self._reported: Drift | None = None
        self._blind = 0
        self._blindness = ""
        self._settings: Mapping[str, float] = {}
        self._about_settings: tuple[str, ...] = ()
        self._about_celsius: dict[str, str] = {}

    @property
    def wall_share(self) -> float:
        """Share of the watched pixels that showed the wall over the last second."""
        return self._window.share

    @property
    def moved(self) -> bool:
        """True while a warning reports a lidar that has moved or lost the wall; a small range drift
        does not count.
        """
        if (drift := self._reported) is None:
            return bool(self._blindness)
        return not drift.uniform or abs(drift.range_m) > MAX_RANGE_DRIFT_M

    def observe(self, depth_m: Float32, settings: Mapping[str, float]) -> None:
        """Add a frame (height, width), NaN where there is no return, and the settings that it was
        taken with.

        Raises CalibrationError for a frame of another size.
        """
        # The watched pixels are places in the image: they mean the same parts of the wall only at
        # the reference's size.
        then = self._reference.intrinsics
        height, width = depth_m.shape
        if (height, width) != (then.height, then.width):
            raise CalibrationError(
                f"a frame of {width} x {height} pixels does not match the bare wall of {then.width}"
                f" x {then.height}: open the camera at that size, or calibrate the wall again"
            )
        if settings != self._settings:
            self._settings = dict(settings)
            self._about_settings = settings_changed(self._reference, settings)
        if self._watches:
            self._window.add(self._track.follow(depth_m), self._track.share)
            self.drift = self._window.drift()
            self._update_reported()
            self._update_blindness()

    def update_temperatures(self, celsius: Mapping[str, float]) -> None:
        """Add a reading of the device's temperatures by the SDK's name; the others keep their last
        value.
        """
        for name, now_c in celsius.items():
            if name in self._reference.celsius and is_temperature(now_c):
                self._about_celsius[name] = self._about_temperature(name, now_c)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Current warnings, a line each, constant while nothing changes; empty while all is
        well.
        """
        lines = [str(self._reported) if self._reported else "", self._blindness]
        # It is one device: the first of its temperatures stands for all.
        off = [line for line in self._about_celsius.values() if line]
        lines += off[:1]
        if len(off) > 1:
            lines[-1] += f" ({len(off) - 1} more of its temperatures are off)"
        if self._about_settings:
            changes = ", ".join(self._about_settings)
            lines.append(
                f"settings have changed since the wall was measured: {changes}: calibrate the wall"
                " again"
            )
        if not self._watches:
            lines.append(
                f"the bare-wall reference has {len(self._track.pixels)} good pixels to watch,"
                f" {MIN_PIXELS} needed: a move of the lidar would not be noticed: calibrate the"
                " wall again"
            )
        return tuple(line for line in lines if line)

    def _update_reported(self) -> None:
        """Begin, renew or end the reported drift; while the wall is hidden, it stays as it is."""
        if self.drift is None:
            return
        # begins above a tolerance with certainty, ends clearly below it, and is renewed only by a
        # different drift
        if self._reported is None:
            self._reported = self.drift if self.drift.tolerances(SURE_SIGMAS) > 1.0 else None
        elif self.drift.tolerances() < ENDS_AT:
            self._reported = None
        elif self._reported.apart(self.drift):
            self._reported = self.drift

    def _update_blindness(self) -> None:
        """Begin or end the warning that too little of the wall is in view."""
        # A counter that rises by one and falls by ten: objects may hide the wall for ten seconds,
        # and one second in which the pose is well known takes all of that back.
        sharp = self.drift is not None and self.drift.sharp
        if sharp:
            self._blind = max(self._blind - BLIND_ENDS, 0)
        else:
            self._blind = min(self._blind + 1, BLIND_FRAMES)
        if self._blind == 0:
            self._blindness = ""
        elif self._blind == BLIND_FRAMES and not self._blindness:
            self._blindness = (
                f"only {self.wall_share:.0%} of the wall is where it was calibrated, too little to"
                " notice a move of the lidar: remove the hidden object for a moment; if this"
                " warning stays, calibrate the wall again"
            )

    def _about_temperature(self, name: str, now_c: float) -> str:
        """Return a warning for a temperature beyond the tolerance; empty within it."""
        then_c = self._reference.celsius[name]
        span_c = self._reference.celsius_span.get(name, 0.0)
        # A lidar that warmed up during the calibration itself is compared with that range.
        limit_c = max(TOLERANCE_C, span_c) * (ENDS_AT if self._about_celsius.get(name) else 1.0)
        if abs(now_c - then_c) <= limit_c:
            return ""
        about = f"{name} is {now_c:.0f} °C and was {then_c:.0f} °C when the wall was measured: "
        return about + ("let the lidar warm up" if now_c < then_c else "calibrate the wall again")
