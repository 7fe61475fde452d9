"""Why a camera is not found, and what to do about it."""

from nlos_cam.doctor.diagnosis import diagnose
from nlos_cam.doctor.facts import Check, Facts, gather

__all__ = ["Check", "Facts", "diagnose", "gather"]
