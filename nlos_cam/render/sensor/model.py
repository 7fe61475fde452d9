"""Sensor model: gain, pulse, wall texture, ambient light, noise and bias as a validated record."""

from math import exp
from typing import Annotated, Self

from nlos_calibration import Record
from pydantic import Field, model_validator

from nlos_cam.frames import SATURATED

DEPTH_UNIT_M = 0.00025
"""Unit of the L515's Z16 depth."""
FARTHEST = 65535
"""Largest value of Z16, in its unit."""
MAX_CONFIDENCE = 15
SURE_COUNTS = 6.0
"""IR counts at which the signal alone reaches 63 % of its largest confidence."""
STEADY_CELSIUS = 40.0
"""Temperature of a device without a warm-up."""

Celsius = Annotated[float, Field(ge=0, le=100)]
"""Range of temperatures that the L515's firmware reports."""


class WarmUp(Record):
    """Warm-up of a device from its start: exponential, as for a body that loses heat to the air."""

    from_celsius: Celsius
    to_celsius: Celsius
    time_constant_s: float = Field(gt=0, le=1e6)

    @model_validator(mode="after")
    def _warms(self) -> Self:
        if self.from_celsius >= self.to_celsius:
            raise ValueError("a warm_up needs from_celsius < to_celsius")
        return self


class SensorModel(Record):
    """Gain, pulse, ambient light, noise and bias. With all but the gain at 0, saturation and
    quantization remain.

    Light is counted in IR counts before saturation, which are linear in it.
    """

    bare_wall_counts: float = Field(default=48.0, gt=0, le=1e6)
    """IR counts of the brightest bare-wall return: fixes the gain."""
    pulse_ns: float = Field(default=0.0, ge=0, le=100, allow_inf_nan=False)
    """Full width of the laser's pulse at half maximum. 1 ns is 0.3 m of path; 0 is shorter than any
    bin.
    """
    wall_texture: float = Field(default=0.0, ge=0, le=1)
    """Standard deviation, over the view, of the logarithm of the wall's reflectance, whose mean is
    1.
    """
    ambient_counts: float = Field(default=0.0, ge=0, lt=SATURATED, allow_inf_nan=False)
    """Steady light on the detector beside the echo. The device subtracts its mean: the data sheet
    calls the IR the intensity of the reflected laser, not the scene's. Its shot noise remains, it
    takes up counts of the 8 bits, which saturate that much earlier, and it lowers the confidence.
    """
    range_noise_m: float = Field(default=0.0005, ge=0, le=10)
    range_noise_per_m: float = Field(default=0.002, ge=0, le=1)
    """Standard deviation of range: range_noise_m plus this for each meter of depth."""
    read_noise_counts: float = Field(default=0.7, ge=0, le=SATURATED)
    shot_noise: float = Field(default=0.3, ge=0, le=SATURATED)
    """Standard deviation over the square root of the counts: 1 / shot_noise^2 photoelectrons per
    count.
    """
    dead_share: float = Field(default=0.002, ge=0, lt=1)
    """Share of pixels that never give depth; the same pixels in every frame."""
    range_offset_m: float = Field(default=0.0, ge=-1, le=1)
    """Amount missing from every depth, as in a wall's record: true depth = the lidar's depth +
    range_offset_m. The data sheet's 4.5 mm, the sign of which is disputed.
    """
    ripple_m: float = Field(default=0.0, ge=0, le=1)
    """Amplitude of a fixed wave of the depth across the view."""
    patch_drift_m: float = Field(default=0.0, ge=0, le=1)
    """Standard deviation, over the view, of smooth patches of depth that grow with the temperature.

    0 at the start of the warm-up; this value at its end, and without a warm-up.
    """
    drift_m_per_celsius: float = Field(default=0.0, ge=-1, le=1)
    """Depth added per degree of difference from the warm device."""
    warm_up: WarmUp | None = None
    """Without it the temperature is constant."""

    def celsius_at(self, seconds: float) -> float:
        """Return the device's temperature a number of seconds after its start."""
        # Newton's law of cooling: the difference from the end decays with the time constant.
        if (warm := self.warm_up) is None:
            return STEADY_CELSIUS
        return warm.to_celsius - (warm.to_celsius - warm.from_celsius) * exp(
            -seconds / warm.time_constant_s
        )


QUIET = SensorModel(
    range_noise_m=0, range_noise_per_m=0, read_noise_counts=0, shot_noise=0, dead_share=0
)
"""Sensor without noise or dead pixels; saturation and quantisation stay."""
