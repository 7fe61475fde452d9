"""The record of a fault in scene files: what befalls a simulated camera, when, and for how long."""

from typing import Literal, Self

from nlos_calibration.rig import Record
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

FaultKind = Literal[
    "stall",
    "drops",
    "duplicate",
    "out_of_order",
    "all_zero",
    "saturated",
    "half_invalid",
    "wrong_size",
    "unplug",
    "clock_wrap",
]


class Fault(Record):
    """One `[[faults]]` table: `kind` says what the device does instead of delivering its frames as they are.

    stall: it delivers nothing and does not count on. drops: it counts on, and delivers nothing. duplicate: each frame
    comes twice. out_of_order: each comes after the one that follows it. all_zero: black in depth, infrared and
    confidence. saturated: infrared is 255 throughout. half_invalid: no depth in the lower half. wrong_size: half the
    rows and columns. unplug: the device is gone, and counts from 0 when it is back. clock_wrap: timestamps are of a
    hardware clock of 32 bits of microseconds, which starts again at 0.
    """

    kind: FaultKind
    at_frame: int = Field(ge=0)
    """The first frame that it befalls; the world has 30 a second, counted from 0 when the camera is entered."""
    frames: int = Field(default=1, gt=0)
    """How many it befalls: for stall and unplug, that is how long they last; of out_of_order, those that are late."""
    stream: Literal["depth", "infrared", "confidence"] | None = None
    """Of drops: the only stream that loses frames."""

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        if self.stream and self.kind != "drops":
            raise PydanticCustomError("stream", "stream is for drops: a {kind} befalls all", {"kind": self.kind})
        if self.kind == "clock_wrap" and "frames" in self.model_fields_set:
            raise PydanticCustomError("frames", "a clock_wrap is at one frame: leave `frames` away")
        return self

    @property
    def until_frame(self) -> int:
        """The first frame that it does not befall any more."""
        return self.at_frame + self.frames * (2 if self.kind == "out_of_order" else 1)

    def befalls(self, frame: int) -> bool:
        """Whether it lasts at this frame."""
        return self.at_frame <= frame < self.until_frame


def one_wrap(faults: tuple[Fault, ...]) -> tuple[Fault, ...]:
    """The same. Raises PydanticCustomError for a clock that wraps more often than every 71 minutes."""
    if sum(fault.kind == "clock_wrap" for fault in faults) > 1:
        raise PydanticCustomError("clock_wrap", "a clock wraps every 71.6 minutes: give one clock_wrap")
    return faults
