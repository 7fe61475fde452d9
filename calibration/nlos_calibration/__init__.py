"""Scene geometry: wall, rig, calibration records."""
