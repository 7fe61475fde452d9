__all__ = ["KINDS", "Description", "describe"]

from .describe import KINDS, describe
from .description import Description
