"""Which of the measured ways to reconstruct keeps a budget of delay on this machine, and what that costs.

    expected delay = hand-over + all but the network, here + network's 90 % in the table x how much slower this machine
                     is + (n - 1) / 2 frame periods

The last is what a mean over n frames adds: its middle is so much older than its newest frame. Accuracy is what was
measured on objects that stand still; what moves also smears.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, Field, ValidationError

from nlos_cam.camera.streams import FRAMES_PER_S
from nlos_cam.errors import BudgetError, RecordingError

TRADEOFF = "tradeoff.json"
"""What `tradeoff reconstruct` writes; one lies beside the shipped weights."""
SHIPPED = "shipped"
PERIOD_MS = 1000 / FRAMES_PER_S
HANDOVER_MS = 2.4
"""From a frame's timestamp until it is its turn: 95 % of both stages in docs/live.json."""
BUSY_SHARE = 0.5
"""Of each frame's period: the rest is for the camera, the view and whatever else runs."""


class Figure(BaseModel):
    """A metric's estimate."""

    value: float | None


class Option(BaseModel):
    """One measured setting of a trade-off."""

    name: str
    weights: str
    """"shipped", or a folder."""
    runtime: str
    threads: int = Field(ge=1)
    frames: int = Field(ge=1)
    """Averaged."""
    milliseconds: float = Field(gt=0)
    milliseconds_p90: float = Field(gt=0)
    foreground_rmse_mm: Figure

    @property
    def rmse_mm(self) -> float:
        """Infinite where no surface was found at all."""
        value = self.foreground_rmse_mm.value
        return float("inf") if value is None else value

    @property
    def averaging_ms(self) -> float:
        """The delay that the mean over its frames adds."""
        return (self.frames - 1) / 2 * PERIOD_MS


class _Table(BaseModel):
    settings: list[Option] = Field(min_length=1)


@dataclass(frozen=True)
class Machine:
    """What was measured of this machine."""

    slower: float
    """How many times longer a network takes at its 90 % than in the table."""
    rest_ms: float
    """All that is done to a frame but the network."""

    def busy_ms(self, option: Option) -> float:
        """What a frame costs."""
        return self.rest_ms + self.slower * option.milliseconds_p90

    def expected_ms(self, option: Option) -> float:
        """The delay of what is shown."""
        return HANDOVER_MS + self.busy_ms(option) + option.averaging_ms


def load_tradeoff(path: Path) -> list[Option]:
    """The settings of a table that `tradeoff reconstruct` wrote. Raises RecordingError."""
    file = path / TRADEOFF if path.is_dir() else path
    try:
        return _Table.model_validate_json(file.read_text(encoding="utf-8")).settings
    except (OSError, UnicodeDecodeError, ValidationError) as error:
        what = error.strerror if isinstance(error, OSError) else "no table of settings"
        raise RecordingError(
            f"{file} cannot be read ({what}): measure these weights with `nlos-cam tradeoff reconstruct --out DIR`, "
            "and give --tradeoff DIR"
        ) from error


def in_pace(options: Sequence[Option], machine: Machine) -> list[Option]:
    """Those that leave time between frames; the quickest alone where none does."""
    kept = [option for option in options if machine.busy_ms(option) <= BUSY_SHARE * PERIOD_MS]
    return kept or [min(options, key=lambda option: (machine.busy_ms(option), option.frames))]


def choose(options: Sequence[Option], machine: Machine, budget_ms: float) -> Option:
    """The most accurate that keeps budget and pace; of those alike, that of the fewest threads, then the quickest.

    Raises BudgetError where none does.
    """
    paced = in_pace(options, machine)
    kept = [option for option in paced if machine.expected_ms(option) <= budget_ms]
    if not kept:
        least = min(paced, key=machine.expected_ms)
        raise BudgetError(
            f"no setting keeps a delay of {budget_ms:g} ms on this machine: the least is "
            f"{machine.expected_ms(least):.1f} ms ({least.name}); give a larger --budget-ms"
        )
    return min(kept, key=lambda option: (round(option.rmse_mm, 2), option.threads, machine.expected_ms(option)))
