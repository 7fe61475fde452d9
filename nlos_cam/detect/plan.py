"""Plan of a detection: settings, turns and their order, drawn before the first frame."""

import hashlib
from math import ceil, log2
from pathlib import Path
from typing import Literal, Self

import numpy as np
from nlos_calibration import Record, Rig
from numpy.typing import NDArray
from pydantic import Field, model_validator

from nlos_cam import __version__
from nlos_cam.files import program_commit, with_commit

MIN_ALPHA = 1e-3
"""Least rate of false alarms that the analysis resolves: of more than 4096 patterns of signs it
draws 4096, of which four may then be as large as the observed one.
"""
BLOCK_TURNS = 4
"""Turns of a block, out-in-in-out or in-out-out-in: either cancels a drift that is linear in time.
"""


def source_checksum() -> str:
    """Return twelve hexadecimal digits that change with this package's source."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


class Setting(Record):
    """Options of the camera under which every turn is measured."""

    name: str
    options: dict[str, float] = Field(default_factory=dict)
    """Values by the SDK's names; empty leaves the camera as it started."""


BASELINE = Setting(name="as started")


class Plan(Record):
    """Everything that is fixed before the first turn; a session never changes it.

    More turns after a look at the result would raise the rate of false alarms above `alpha`.
    """

    schema_version: Literal[1] = 1
    kind: Literal["detection"] = "detection"
    created: str
    """Date and time, ISO 8601."""
    version: str = Field(default_factory=lambda: with_commit(__version__, program_commit()))
    source: str = Field(default_factory=source_checksum)
    """Checksum of the analysis's source files."""
    camera: str
    serial: str = ""
    firmware: str = ""
    rig: Rig | None = None
    """Set-up, from which the cells without information follow; None levels on all cells."""
    rig_option: str = ""
    """Option that named the rig, "--bench NAME" or "--wall NAME", without the folders above it: the
    page may be published. Empty where the camera knew its rig."""
    turns: int = Field(ge=2 * BLOCK_TURNS, le=4096)
    """Whole blocks, half of the turns with the object."""
    frames: int = Field(ge=2, le=100_000)
    """Frames of each turn and setting."""
    alpha: float = Field(default=0.01, ge=MIN_ALPHA, lt=0.5)
    """Probability that anything is reported where the object has no effect at all."""
    seed: int = Field(ge=0)
    """Seed of the order of the turns."""
    control: bool = False
    """True for a control: the same motions with an empty hand."""
    settings: tuple[Setting, ...] = (BASELINE,)

    @model_validator(mode="after")
    def _whole_blocks(self) -> Self:
        if self.turns % BLOCK_TURNS:
            raise ValueError(f"turns must be a multiple of {BLOCK_TURNS} (got {self.turns})")
        if self.blocks < (least := min_blocks(self.alpha)):
            raise ValueError(
                f"{self.turns} turns cannot reach a false-alarm rate of {self.alpha:g}: at least"
                f" {least * BLOCK_TURNS} are needed"
            )
        return self

    @property
    def is_simulated(self) -> bool:
        """True for a simulated camera."""
        return self.camera.startswith("sim")

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return self.turns // BLOCK_TURNS

    def order(self) -> NDArray[np.bool_]:
        """Return for each turn whether the object is in."""
        # One coin for each block. Without an effect of the object the readings would have been the
        # same under any coins, so that flipping the blocks' signs gives draws of the very law of
        # the result: no assumption about noise or drift is needed (Fisher's randomization test).
        coins = np.random.default_rng(self.seed).random(self.blocks) < 0.5
        first = np.array([False, True, True, False])
        return np.concatenate([first ^ coin for coin in coins])


def min_blocks(alpha: float) -> int:
    """Return the least number of blocks with which a p-value can be `alpha`."""
    # 2^(N - 1) patterns of signs differ, since flipping all blocks changes no absolute value.
    return ceil(1.0 - log2(alpha))
