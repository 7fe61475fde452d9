"""What a plane's slopes say about distance and angles, and how surely: first-order propagation of their covariance."""

from dataclasses import dataclass
from math import degrees, sqrt

import numpy as np

from nlos_calibration.arrays import Float64
from nlos_calibration.geometry import angles_from_normal

INTERVAL_STDS = 1.96
"""Half the width of a 95 % interval, in standard uncertainties."""


@dataclass(frozen=True)
class WallMeasures:
    """Distance and angles of a plane 1 / z = slopes . ray, with standard uncertainties; 1.96 of them hold 95 %."""

    distance_m: float
    yaw_deg: float
    pitch_deg: float
    facing_deg: float
    distance_std_m: float
    yaw_std_deg: float
    pitch_std_deg: float
    facing_std_deg: float


def measures_of(slopes: Float64, covariance: Float64) -> WallMeasures:
    """Distance and angles of `slopes` (3,) = -normal / distance_m, uncertain by `covariance` (3, 3)."""
    distance_m = 1.0 / float(np.linalg.norm(slopes))
    normal = -slopes * distance_m
    # a change of the slopes moves the distance along the normal and turns the normal across it
    along, across = distance_m**2 * normal, -distance_m * (np.eye(3) - np.outer(normal, normal))
    turn = across @ covariance @ across.T
    x, z = normal[0], normal[2]
    level = x**2 + z**2
    yaw_rad, pitch_rad = angles_from_normal(normal)
    return WallMeasures(
        distance_m=distance_m,
        yaw_deg=degrees(yaw_rad),
        pitch_deg=degrees(pitch_rad),
        facing_deg=degrees(_facing_rad(normal)),
        distance_std_m=_std(along, covariance),
        yaw_std_deg=degrees(_std(np.array([-z, 0.0, x]) / level, turn)),
        pitch_std_deg=degrees(_std(np.array([0.0, -1.0, 0.0]) / sqrt(level), turn)),
        facing_std_deg=degrees(_facing_std_rad(normal, turn)),
    )


def _facing_rad(normal: Float64) -> float:
    """By the tangent: the cosine says nothing about small angles."""
    return float(np.arctan2(np.hypot(normal[0], normal[1]), -normal[2]))


def _facing_std_rad(normal: Float64, turn: Float64) -> float:
    """How surely the facing angle f is known.

    Turns towards the axis change it one for one. Turns aside by s change it to sqrt(f^2 + s^2): nothing while s is
    small against f, s itself where the wall is faced squarely, s^2 / sqrt(f^2 + s^2) in between. There f is measured
    too large by s: the least f that s allows is taken.
    """
    facing_rad, sideways = _facing_rad(normal), float(np.hypot(normal[0], normal[1]))
    x, y = normal[:2] / sideways if sideways > 0.0 else (1.0, 0.0)
    towards = np.array([x * -normal[2], y * -normal[2], sideways])
    aside = np.array([-y, x, 0.0])
    variance = float(aside @ turn @ aside)
    least_rad = max(facing_rad - 2.0 * sqrt(max(variance, 0.0)), 0.0)
    second_order = variance**2 / (variance + least_rad**2) if variance > 0.0 else 0.0
    return sqrt(float(towards @ turn @ towards) + second_order)


def _std(gradient: Float64, covariance: Float64) -> float:
    return sqrt(max(float(gradient @ covariance @ gradient), 0.0))
