"""Cameras behind one protocol."""

from nlos_cam.camera.base import Camera
from nlos_cam.camera.record import Recording
from nlos_cam.camera.table import SIMULATED, open_camera

__all__ = ["SIMULATED", "Camera", "Recording", "open_camera"]
