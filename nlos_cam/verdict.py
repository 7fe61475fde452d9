"""What may be believed of a frame's reconstruction, in plain words."""

from enum import StrEnum


class Verdict(StrEnum):
    """One of six for each frame; where several hold, the one that comes last here is told."""

    SEEN = "object seen"
    NOTHING = "nothing there"
    OUTSIDE = "outside the trained range"
    SATURATED = "saturated"
    WALL_MOVED = "wall moved"
    STALLED = "camera stalled"
