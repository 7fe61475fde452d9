"""A reconstruction rendered again, and held against what the lidar saw."""

from dataclasses import dataclass

from nlos_cam.frames import Float32


@dataclass(frozen=True)
class Check:
    """What one frame's check found."""

    frame_number: int
    residual_depth_m: Float32
    """(64, 80): seen less rendered; NaN where either has no return."""
    residual_intensity: Float32
    """(64, 80): seen less rendered."""
    score: float
    """0 where the maps are explained to within the sensor's noise; 1 where they are explained no better than by nothing
    at all hidden."""
    seconds: float
    """How long it took."""
