"""What a second of frames says of the wall together: by how much it has left the reference, and how surely."""

from dataclasses import dataclass
from math import hypot

import numpy as np

from nlos_calibration.verdict import TOLERANCE_DEG, TOLERANCE_M
from nlos_calibration.wall_track import Sight

WINDOW_FRAMES, LEAST_FRAMES = 30, 15
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
        self._sights = np.full((WINDOW_FRAMES, len(Sight._fields)), np.nan)
        self._shares = np.zeros(WINDOW_FRAMES)

    def add(self, sight: Sight | None, share: float) -> None:
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
        if len(seen) < LEAST_FRAMES:
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
