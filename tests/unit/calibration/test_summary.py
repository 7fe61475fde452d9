from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from measured_walls import BOARD, exact_wall
from nlos_calibration import (
    INTERVAL_STDS,
    OccluderRecord,
    board_agreement,
    wall_facts,
    with_degrees,
    with_mm,
)

RECORD = exact_wall().record
OFFSET = {"range_offset_m": -0.0045, "range_offset_std_m": 0.0005, "range_offset_cause": "depth"}


def values(**fields: Any) -> dict[str, str]:
    return {name: value for name, value, _ in wall_facts(RECORD.model_copy(update=fields))}


@pytest.mark.parametrize(
    ("std_m", "text"),
    [
        *(
            (1e-9, "200.00 ± 0.01 mm"),
            (0.0, "200.00 ± 0.01 mm"),
            (1e-4, "200.00 ± 0.20 mm"),
            (5e-4, "200.0 ± 1.0 mm"),
        ),
        *((0.0016, "200 ± 3 mm"), (0.008, "200 ± 16 mm"), (None, "200.0 mm")),
    ],
)
def test_length_has_the_digits_of_its_interval(std_m: float | None, text: str) -> None:
    assert with_mm(0.2, std_m) == text


@given(st.floats(1e-3, 30.0), st.floats(-90.0, 90.0))
def test_interval_is_printed_within_a_tenth_of_a_digit(std_deg: float, value_deg: float) -> None:
    value, half = with_degrees(value_deg, std_deg, "+").removesuffix("°").split(" ± ")

    assert float(half) == pytest.approx(INTERVAL_STDS * std_deg, rel=0.26)
    assert float(value) == pytest.approx(value_deg, abs=0.51 * float(half))
    assert len(value.partition(".")[2]) == len(half.partition(".")[2])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("distance", "200.00 ± 0.20 mm"),
        ("facing angle", "45.000 ± 0.020°"),
        ("yaw", "+45.000 ± 0.020°"),
        ("pitch", "+0.00 ± 0.04°"),
        ("measured on", "2026-11-22"),
        ("temperature", "41.7 °C"),
        ("depth", "refused"),
        ("view on the wall", "100.0 %"),
    ],
)
def test_fact_has_its_interval_or_unit(name: str, text: str) -> None:
    assert values()[name] == text


def test_facts_of_the_depth_are_those_measured() -> None:
    assert values(residual_m=0.0001)["residual"] == "0.10 mm RMS"


def test_facts_leave_out_what_was_not_measured() -> None:
    facts = values(temperatures_c={})
    for name in ("range offset", "printed board", "occluder's tilt", "temperature"):
        assert name not in facts


def test_board_agrees_with_the_range_offset_of_its_record() -> None:
    apart = board_agreement(BOARD)

    assert "agree" not in apart
    assert board_agreement(BOARD, 0.0047).startswith(apart)
    assert "+4.7 mm, the two agree" in board_agreement(BOARD, 0.0047)


def test_facts_hold_offset_board_occluder_and_footprint() -> None:
    found = OccluderRecord(
        source="detected", x_m=0.21, gap_m=0.09, x_std_m=0.001, gap_std_m=0.001, tilt_deg=-1.5
    )
    warm = {"ldd_temperature": 40.0, "apd_temperature": 35.5}
    facts = values(
        **OFFSET, occluder=found, board=BOARD, footprint_share=0.875, temperatures_c=warm
    )

    assert facts["range offset"] == "-4.5 ± 1.0 mm"
    assert facts["occluder's edge (detected)"] == "210.0 ± 2.0 mm"
    assert facts["occluder's gap (detected)"] == "90.0 ± 2.0 mm"
    assert facts["occluder's tilt"] == "-1.50°"
    assert facts["printed board"] == "203.4 ± 1.0 mm, 40.10 ± 0.04°"
    assert facts["view on the wall"] == "87.5 %"
    assert facts["temperature"] == "35.5 to 40.0 °C"

    entered = OccluderRecord(source="entered", x_m=0.21, gap_m=0.09)

    assert values(occluder=entered)["occluder's gap (entered)"] == "90.0 mm"


@pytest.mark.parametrize(
    ("apart", "words"), [({}, "+3.40 mm and 0.117°"), ({"disagreement_m": None}, "refused: mirror")]
)
def test_facts_compare_board_with_depth(apart: dict[str, Any], words: str) -> None:
    board = BOARD.model_copy(update={"depth_refused": "mirror", **apart})
    [meaning] = [
        row[2]
        for row in wall_facts(RECORD.model_copy(update={"board": board}))
        if row[0] == "printed board"
    ]

    assert words in meaning
    assert "24 corners; used: depth" in meaning
