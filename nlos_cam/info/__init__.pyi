__all__ = ["KINDS", "Description", "describe", "write_picture"]

from .describe import KINDS, describe
from .files import Description
from .transients import write_picture
