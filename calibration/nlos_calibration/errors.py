"""Errors of the calibration package.

CalibrationError (ValueError)    exit 1   root
├── WallRefusedError             exit 1   what the lidar saw is not a bare wall we can trust
├── BoardRefusedError            exit 1   there is no board in the image whose plane we can trust
├── OccluderRefusedError         exit 1   there is no occluder in the view whose place we can trust
└── RecordFileError              exit 4   a rig or wall record that cannot be read
"""


class CalibrationError(ValueError):
    """Root of the errors that the calibration foresaw."""

    exit_code = 1


class WallRefusedError(CalibrationError):
    """What the lidar saw is not a bare wall that can be trusted; the message says why."""


class BoardRefusedError(CalibrationError):
    """There is no board in the image whose plane can be trusted; the message says why."""


class OccluderRefusedError(CalibrationError):
    """There is no occluder in the view whose place can be trusted; the message says why."""


class RecordFileError(CalibrationError):
    """A rig or wall record that cannot be read."""

    exit_code = 4
