"""See around a corner with a consumer lidar."""

__version__ = "0.1.0"
