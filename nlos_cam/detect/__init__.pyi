__all__ = [
    "BASELINE",
    "BLOCK_TURNS",
    "CHANNELS",
    "REPORT",
    "SETTLING_FRAMES",
    "Analysis",
    "Finding",
    "Hands",
    "Plan",
    "Session",
    "Setting",
    "SimulatedHands",
    "Turn",
    "analyze",
    "how_to_go_on",
    "is_session",
    "measure_turn",
    "measure_turns",
    "min_blocks",
    "power_text",
    "setting_as_started",
    "swept_settings",
    "verdict",
    "write_report",
]

from .analysis import Analysis, Finding, analyze
from .hands import Hands, SimulatedHands
from .measure import (
    SETTLING_FRAMES,
    measure_turn,
    measure_turns,
    setting_as_started,
    swept_settings,
)
from .plan import BASELINE, BLOCK_TURNS, Plan, Setting, min_blocks
from .report import power_text, verdict, write_report
from .session import REPORT, Session, how_to_go_on, is_session
from .turns import CHANNELS, Turn
