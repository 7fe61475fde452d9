"""Errors of the calibration package, with their exit codes and an example of each message.

CalibrationError (ValueError)  1  root
├── WallRefusedError           1  "only 31.0% of the depth lies on one plane (50% needed), ..."
├── BoardRefusedError          1  "4 corners of a board of 6 x 9 squares of 30 mm are visible, ..."
├── OccluderRefusedError       1  "the occluder touches the wall (gap 1.2 ± 2.0 mm): ..."
└── RecordFileError            4  "wall.toml is not a wall record: frames: must be greater than 0"
    └── UnknownRigError        2  "no rig 'paper-rgi'. Did you mean 'paper-rig'?"
"""


class CalibrationError(ValueError):
    """Root of the errors that calibration raises on purpose."""

    exit_code = 1


class WallRefusedError(CalibrationError):
    """The depth is not that of one bare, flat wall; the message gives the reason and the remedy."""


class BoardRefusedError(CalibrationError):
    """The image shows no board whose plane can be trusted; the message gives the reason and the
    remedy.
    """


class OccluderRefusedError(CalibrationError):
    """The depth shows no occluder whose position can be trusted; the message gives the reason and
    the remedy.
    """


class RecordFileError(CalibrationError):
    """A rig or wall record cannot be read."""

    exit_code = 4


class UnknownRigError(RecordFileError):
    """Mistyped name of a packaged rig."""

    exit_code = 2
