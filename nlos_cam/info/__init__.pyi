__all__ = ["KINDS", "Description", "describe"]

from .describe import KINDS, describe
from .files import Description
