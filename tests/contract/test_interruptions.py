"""Live runs interrupted at random moments; tools/robustness/interrupt_live.py does the same fifty times."""

from pathlib import Path

import pytest
from interrupt_live import Plan, interrupt

pytestmark = [
    pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="lists processes as Linux does"),
    pytest.mark.slow,
    pytest.mark.timeout(900),
]
EARLY_S, LATE_S = 0.5, 8.0
"""Seconds after the process begins: during its start, and mostly while it runs."""


@pytest.mark.parametrize(
    ("kind", "after_s", "view"),
    [
        ("ctrl-c", EARLY_S, True),
        ("terminate", LATE_S, True),
        ("viewer killed", LATE_S, True),
        ("unplugged, then ctrl-c", LATE_S, False),
    ],
)
def test_interrupted_live_leaves_no_process_or_partial_file(
    tmp_path: Path, kind: str, after_s: float, view: bool
) -> None:
    outcome = interrupt(Plan(0, kind, after_s, 5, view), tmp_path)
    assert outcome.good, outcome
    if kind == "viewer killed":
        assert outcome.frames_recorded > 0
        assert outcome.lines_logged > 0
