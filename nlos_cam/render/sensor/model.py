"""What a sensor is like, and the wall to it: gain, pulse, texture, ambient light, noise, bias as a validated record."""

from math import exp
from typing import Annotated, Self

from nlos_calibration import Record
from pydantic import Field, model_validator

from nlos_cam.frames import SATURATED

DEPTH_UNIT_M = 0.00025
"""The L515's Z16 unit."""
FARTHEST = 65535
"""The most that Z16 holds, in its unit."""
MAX_CONFIDENCE = 15
SURE_COUNTS = 6.0
"""IR counts at which the signal alone gives 63 % of the confidence it can give."""
STEADY_CELSIUS = 40.0
"""What a device that is told no warm-up stays at."""

Celsius = Annotated[float, Field(ge=0, le=100)]
"""The range that the L515's firmware tells."""


class WarmUp(Record):
    """How a device warms from its start on, as a body that loses heat to the air does."""

    from_celsius: Celsius
    to_celsius: Celsius
    time_constant_s: float = Field(gt=0, le=1e6)

    @model_validator(mode="after")
    def _warms(self) -> Self:
        if self.from_celsius >= self.to_celsius:
            raise ValueError("a warm-up needs from_celsius < to_celsius")
        return self


class SensorModel(Record):
    """Gain, pulse, ambient light, noise and bias. All at 0 (but the gain) leaves saturation and quantisation alone.

    Light is counted in IR counts before saturation, which are linear in it.
    """

    bare_wall_counts: float = Field(default=48.0, gt=0, le=1e6)
    """IR counts of the brightest bare-wall return: fixes the gain."""
    pulse_ns: float = Field(default=0.0, ge=0, le=100, allow_inf_nan=False)
    """Full width of the laser's pulse at half its maximum. 1 ns is 0.3 m of path; 0 is a pulse shorter than any bin."""
    wall_texture: float = Field(default=0.0, ge=0, le=1)
    """Standard deviation, over the view, of the logarithm of the wall's reflectance; its mean is the even wall's."""
    ambient_counts: float = Field(default=0.0, ge=0, lt=SATURATED, allow_inf_nan=False)
    """Steady light on the detector beside the echo. The device subtracts its mean: the data sheet calls the IR the
    intensity of the reflected laser, not the scene's. Left of it are its shot noise, the counts it takes of the 8
    bits, which saturate that much earlier, and the confidence it costs."""
    range_noise_m: float = Field(default=0.0005, ge=0, le=10)
    range_noise_per_m: float = Field(default=0.002, ge=0, le=1)
    """Standard deviation of range: the one, plus the other for each metre of depth."""
    read_noise_counts: float = Field(default=0.7, ge=0, le=SATURATED)
    shot_noise: float = Field(default=0.3, ge=0, le=SATURATED)
    """Standard deviation over the square root of the counts: 1 / shot_noise^2 photoelectrons make a count."""
    dead_share: float = Field(default=0.002, ge=0, lt=1)
    """Share of pixels that never give depth; which ones is a matter of the sensor, not of the frame."""
    range_offset_m: float = Field(default=0.0, ge=-1, le=1)
    """What is missing from every depth, as in a wall's record: true depth = the lidar's depth + range_offset_m. The
    data sheet's 4.5 mm, whose sign its readers disagree about."""
    ripple_m: float = Field(default=0.0, ge=0, le=1)
    """Amplitude of a wave of the depth across the view, which stays where it is."""
    patch_drift_m: float = Field(default=0.0, ge=0, le=1)
    """Standard deviation, over the view, of smooth patches of depth that grow with the temperature: nothing where the
    warm-up begins, this where it ends, and where there is no warm-up."""
    drift_m_per_celsius: float = Field(default=0.0, ge=-1, le=1)
    """What each degree adds to every depth; the warm device has none of it."""
    warm_up: WarmUp | None = None
    """Without it the temperature stays where it is."""

    def celsius_at(self, seconds: float) -> float:
        """The device's temperature so long after its start."""
        if (warm := self.warm_up) is None:
            return STEADY_CELSIUS
        return warm.to_celsius - (warm.to_celsius - warm.from_celsius) * exp(-seconds / warm.time_constant_s)
