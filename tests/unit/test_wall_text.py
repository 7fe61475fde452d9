import dataclasses
from pathlib import Path

import pytest
from measured_walls import exact_wall
from nlos_calibration.board import BOARDS
from nlos_calibration.board_wall import BoardRecord
from nlos_calibration.rig import OccluderRecord
from nlos_calibration.wall_record import load_wall

from nlos_cam.view.wall_drawing import ALL_IS_WELL, NOT_WATCHED, calibration_text

RECORD = exact_wall().record.model_copy(update={"reference": "wall.npz", "reference_sha256": "0" * 64})
BOARD = BoardRecord(
    printed=BOARDS["a4"],
    measured=True,
    corners=20,
    residual_px=0.1,
    stretch=0.0,
    bow_m=0.0,
    distance_m=0.2003,
    distance_std_m=0.0005,
    yaw_deg=45.0,
    yaw_std_deg=0.1,
    pitch_deg=0.0,
    pitch_std_deg=0.1,
    facing_deg=45.0,
    facing_std_deg=0.1,
    used="both",
    disagreement_m=0.0003,
    disagreement_deg=0.04,
    disagreement_sigmas=1.2,
)


def row(text: str, name: str) -> str:
    (found,) = [line for line in text.splitlines() if line.startswith(f"| {name} |")]
    return found.split("|")[2].strip()


def test_what_was_measured_is_told_with_its_interval() -> None:
    text = calibration_text(RECORD)
    assert text.startswith("**GOOD**: distance and angle are inside")
    assert row(text, "distance") == "0.2000 m ± 0.20 mm"
    assert row(text, "facing") == "45.00° ± 0.020°"
    assert row(text, "yaw") == "+45.00° ± 0.020°"
    assert row(text, "pitch") == "+0.00° ± 0.039°"
    assert row(text, "temperature") == "41.7 °C"
    assert row(text, "date") == "2026-11-22, 30 frames"


def test_an_interval_below_a_thousandth_is_rounded_up_to_it() -> None:
    sure = RECORD.model_copy(update={"facing_std_deg": 1e-7})
    assert row(calibration_text(sure), "facing") == "45.00° ± 0.001°"


def test_without_a_reference_nothing_is_said_to_be_well() -> None:
    text = calibration_text(RECORD.model_copy(update={"reference": "", "reference_sha256": ""}))
    assert NOT_WATCHED in text
    assert ALL_IS_WELL not in text


def test_what_is_wrong_now_takes_the_place_of_all_being_well() -> None:
    calm, alarmed = calibration_text(RECORD), calibration_text(RECORD, ["the lidar has moved", "it is warm"])
    assert ALL_IS_WELL in calm
    assert "WARNING" not in calm
    assert ALL_IS_WELL not in alarmed
    assert "> - the lidar has moved\n> - it is warm" in alarmed
    assert alarmed.index("it is warm") < alarmed.index("| distance |")  # seen without scrolling


def test_what_was_not_measured_is_left_out() -> None:
    bare = RECORD.model_copy(update={"temperatures_c": {}})
    text = calibration_text(bare)
    assert not any(word in text for word in ("temperature", "offset", "Board", "Note"))


def test_offset_board_and_notes_are_told_where_they_are() -> None:
    offset = {"range_offset_m": -0.0045, "range_offset_std_m": 0.0005, "range_offset_cause": "depth"}
    text = calibration_text(RECORD.model_copy(update={**offset, "board": BOARD, "warnings": ("it has ripples",)}))
    assert row(text, "offset of depth") == "-4.5 mm ± 0.98 mm"
    assert "Board: +0.30 mm and 0.04° from the depth's plane (1.2 sigma); used: both" in text
    assert "Note: it has ripples" in text


def test_a_board_that_stands_alone_says_so() -> None:
    alone = {"disagreement_m": None, "disagreement_deg": None, "disagreement_sigmas": None, "used": "board"}
    text = calibration_text(RECORD.model_copy(update={"board": BOARD.model_copy(update=alone)}))
    assert "Board: 20 corners; the depth was refused" in text


@pytest.mark.parametrize("version", [1, 2])
def test_older_records_are_told_too(version: int) -> None:
    record = load_wall(Path(__file__).parent / f"wall_v{version}.toml")
    told = row(calibration_text(dataclasses.replace(exact_wall(), record=record).record), "distance")
    assert told.startswith("0.2000 m")
    assert ("±" in told) == (record.distance_std_m is not None)


def test_the_occluder_and_the_span_of_the_temperatures_are_told() -> None:
    occluder = OccluderRecord(source="entered", x_m=0.21, gap_m=0.09)
    warm = {"ldd_temperature": 40.0, "apd_temperature": 35.5}
    text = calibration_text(RECORD.model_copy(update={"occluder": occluder, "temperatures_c": warm}))
    assert row(text, "occluder") == "0.210 m, gap 0.090 m"
    assert row(text, "temperature") == "35.5 to 40.0 °C"
    assert "occluder" not in calibration_text(RECORD)
