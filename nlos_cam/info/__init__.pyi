__all__ = ["KINDS", "Description", "ProgramFacts", "describe", "describe_program", "write_picture"]

from .describe import KINDS, describe
from .files import Description
from .program import ProgramFacts, describe_program
from .transients import write_picture
