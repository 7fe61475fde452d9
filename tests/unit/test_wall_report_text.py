from collections.abc import Callable
from dataclasses import replace
from html import unescape

import pytest
from nlos_calibration.board import BOARDS
from nlos_calibration.board_wall import BoardRecord
from nlos_calibration.wall_record import MeasuredWall, OccluderRecord

from nlos_cam.calibrate import report as text

Measured = Callable[..., MeasuredWall]
BOARD = BoardRecord(
    printed=BOARDS["a4"],
    measured=True,
    corners=24,
    residual_px=0.07,
    stretch=0.001,
    bow_m=0.0002,
    distance_m=0.2034,
    distance_std_m=0.0005,
    yaw_deg=40.1,
    yaw_std_deg=0.02,
    pitch_deg=3.0,
    pitch_std_deg=0.02,
    facing_deg=40.2,
    facing_std_deg=0.02,
    used="depth",
    disagreement_m=0.0034,
    disagreement_deg=0.117,
    disagreement_sigmas=6.5,
    causes=("printed at 97 %",),
)


@pytest.mark.parametrize("verdict", ["good", "out of range", "doubtful"])
def test_the_banner_holds_verdict_advice_and_warnings(measured: Measured, verdict: str) -> None:
    told = {"verdict": verdict, "advice": "move <4 cm> back", "warnings": ("ripples & noise", "cold")}
    banner = text.verdict(measured().record.model_copy(update=told))
    assert f"class='verdict {verdict.replace(' ', '-')}'" in banner
    assert verdict in banner.lower()
    assert all(sentence in unescape(banner) for sentence in ("move <4 cm> back", "ripples & noise", "cold"))


def test_the_bars_are_of_what_is_known(measured: Measured) -> None:
    record = measured(0.35, 80.0, 0.0).record
    bars = text.ranges(record)
    assert "distance: 35.0 cm, too large (15 to 30 cm)" in bars
    assert "facing angle: 80.0 degrees, too large (15 to 75 degrees)" in bars
    assert "occluder" not in bars
    wide = OccluderRecord(source="entered", x_m=0.2, gap_m=0.25)
    assert "gap: 25.0 cm, too large (5 to 20 cm)" in unescape(text.ranges(record.model_copy(update={"occluder": wide})))


def test_measures_are_told_with_their_95_percent(measured: Measured) -> None:
    stds = {"distance_std_m": 0.001, "facing_std_deg": 0.1, "yaw_std_deg": 0.2, "pitch_std_deg": 1e-6}
    told = text.measures(measured(0.2, 40.0, -3.0).record.model_copy(update=stds))
    for words in ("0.2000 m ± 2 mm", "40.09° ± 0.2°", "40.00° ± 0.39°", "-3.00° ± less than 0.001°", "not measured"):
        assert words in told
    assert "occluder" not in told


def test_measures_without_uncertainty_are_told_alone(measured: Measured) -> None:
    assert "0.2000 m</td>" in text.measures(measured(0.2).record.model_copy(update={"distance_std_m": None}))


def test_offset_occluder_and_footprint_are_told_where_they_are_known(measured: Measured) -> None:
    found = OccluderRecord(source="detected", x_m=0.21, gap_m=0.09, x_std_m=0.001, gap_std_m=0.001, tilt_deg=-1.5)
    told = {"range_offset_m": -0.0045, "range_offset_std_m": 0.0005, "range_offset_cause": "depth"}
    record = measured().record.model_copy(update={**told, "occluder": found, "footprint_share": 0.875})
    made = unescape(text.measures(record))
    for words in ("-4.50 mm ± 0.98 mm", "each depth lacks it", "0.2100 m ± 2 mm", "0.0900 m ± 2 mm", "-1.50°", "87.5%"):
        assert words in made


def test_a_refused_depth_is_told(measured: Measured) -> None:
    made = text.measures(measured().record.model_copy(update={"residual_m": None}))
    assert "refused" in made
    assert "ripples" not in made


def test_a_board_is_told_beside_the_record(measured: Measured) -> None:
    record = measured().record
    assert not text.board(record)
    made = unescape(text.board(record.model_copy(update={"board": BOARD})))
    for words in (
        "0.2034 m ± 0.98 mm",
        "0.2000 m",
        "+3.40 mm and 0.117°",
        "6.5 standard",
        "the depth alone",
        "at 97 %",
    ):
        assert words in made
    alone = {"used": "board", "disagreement_m": None, "depth_refused": "a <mirror>"}
    refused = unescape(text.board(record.model_copy(update={"board": BOARD.model_copy(update=alone)})))
    assert "The depth was refused: a <mirror>." in refused
    assert "the board alone" in refused


def test_the_device_is_told_with_its_temperatures_and_settings(measured: Measured) -> None:
    wall = measured(
        serial="f0246262", firmware="1.5.8.1", settings={"laser_power": 80.0}, temperatures_c={"LLD": 41.26}
    )
    assert wall.reference is not None
    warming = MeasuredWall(wall.record, replace(wall.reference, celsius_span={"LLD": 1.5}))
    made = text.device(warming)
    for words in ("f0246262", "1.5.8.1", "laser_power", "80", "41.3 °C, changed by 1.5", "2026-01-31", "64 x 48"):
        assert words in made
    bare = text.device(MeasuredWall(measured().record, None))
    assert "not known" in bare
    assert "Temperatures" not in bare


@pytest.mark.parametrize(
    ("camera", "record_file", "live"),
    [
        ("l515:f0246262", "wall.toml", "live --camera l515:f0246262 --wall wall.toml"),
        ("sim:bare-wall", "wall.toml", "live --camera sim --wall wall.toml"),
        ("bag:my wall.bag", "my wall.toml", "live --camera l515 --wall 'my wall.toml'"),
    ],
)
def test_the_commands_can_be_pasted(measured: Measured, camera: str, record_file: str, live: str) -> None:
    record = measured(reference="wall.npz", reference_sha256="ab" * 32).record.model_copy(update={"camera": camera})
    made = unescape(text.files(record, record_file))
    assert f"nlos-cam {live}\n" in made
    assert all(words in made for words in ("render cup --rig", "wall.npz", "ab" * 32, record.rig.checksum))
