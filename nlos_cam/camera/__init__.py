"""Cameras behind one protocol."""

from nlos_cam.camera.protocol import Camera
from nlos_cam.camera.recorder import Recording
from nlos_cam.camera.registry import SIMULATED, open_camera

__all__ = ["SIMULATED", "Camera", "Recording", "open_camera"]
