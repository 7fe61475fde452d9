"""A small version of the study of the watch over drift, and of the streams that it looks at."""

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from drift_trials import AT_REST, KNOCKED, SHIFTS, Knock, Rest, Shift, at_rest, knock, poses
from nlos_calibration.drift import BLIND_FRAMES, Drift

TRUE = Drift(0.002, 0.0, 0.0, 0.0, 0.0001, 0.02, 0.02, 0.0001, uniform=False)
EVERY = 61


@pytest.fixture
def study() -> ModuleType:
    return importlib.import_module("drift_study")


def test_some_streams_are_looked_at_and_told(
    study: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(study, "DOCS", tmp_path)
    monkeypatch.setattr(sys, "argv", ["drift_study.py", "--every", str(EVERY)])
    study.main()
    table = json.loads((tmp_path / "drift_study.json").read_text(encoding="utf-8"))
    assert sum(one["streams"] for one in table["at_rest"]) == -(-len(AT_REST) * len(list(poses())) // EVERY)
    assert sum(one["tried"] for one in table["knocks"]) == -(-len(SHIFTS) * len(KNOCKED) * len(list(poses())) // EVERY)
    assert all(one["frames"] == 400 * one["streams"] for one in table["at_rest"])
    assert table["at_rest"][0]["warned_per_10000"] == 0.0
    turned = [one for one in table["knocks"] if "yaw" in one["name"]]
    assert sum(one["told"] for one in turned) == sum(one["tried"] for one in turned) > 0
    assert "| yaw -2 degrees |" in capsys.readouterr().out


def test_a_move_is_told_and_a_lidar_that_stands_is_not_and_again_the_same() -> None:
    seed, pose = list(poses())[7]
    moved = [knock(pose, KNOCKED["30-50 % hidden"], Shift(0.003, 0.5), seed) for _ in range(2)]
    assert moved[0] == moved[1]
    assert moved[0].told_after is not None
    assert moved[0].right_kind
    assert not moved[0].warned_before
    assert knock(pose, KNOCKED["noise"], Shift(), seed) == Knock(warned_before=False, told_after=None)
    half = at_rest(pose, AT_REST["50 % hidden"], seed)
    assert half == Rest(0, 0, pytest.approx(0.5, abs=0.01))


def test_what_is_told_before_the_wall_is_missed_is_told_of_the_move() -> None:
    trials = importlib.import_module("drift_trials")
    assert trials.BEFORE_FRAMES + trials.AFTER_FRAMES < BLIND_FRAMES < trials.AT_REST_FRAMES


def test_right_is_the_kind_and_each_number_within_its_uncertainty() -> None:
    shift = Shift(0.002)
    assert shift.inside(TRUE) == 1.0
    assert shift.inside(replace(TRUE, distance_m=0.0023)) == pytest.approx(2 / 3)
    assert shift.inside(replace(TRUE, distance_m=0.0023, yaw_deg=0.1, pitch_deg=-0.1)) == 0.0
    assert shift.inside(replace(TRUE, uniform=True, range_m=0.002)) == 0.0
    longer = Shift(range_m=0.0015)
    assert longer.inside(replace(TRUE, uniform=True, range_m=0.0016)) == 1.0
    assert longer.inside(replace(TRUE, uniform=True, range_m=0.0018)) == 0.0
    assert longer.inside(TRUE) == 0.0


def test_a_row_counts_what_was_told(study: ModuleType) -> None:
    told = [Knock(False, 16, True, 1.0, 1.0), Knock(True, 30, False, 0.0, 0.5), Knock(False, 20, True, 1 / 3, 1.0)]
    row = study.knock_row("+2 mm", "noise", [*told, Knock(False, None)])
    assert (row["tried"], row["told"], row["warned_before"], row["right_kind"]) == (4, 3, 1, 2)
    assert (row["frames_median"], row["frames_max"]) == (20.0, 30)
    assert row["inside_95"] == pytest.approx(4 / 9)
    nothing = study.knock_row("+1 mm", "noise", [Knock(False, None)])
    assert (nothing["told"], nothing["frames_median"], nothing["inside_95"]) == (0, None, None)
    shown = study.as_markdown([study.rest_row("noise", [Rest(4, 1, 0.98), Rest(0, 0, 1.0)])], [row, nothing])
    assert "| noise | 99%, 98% | 800 | 50.0 | 12.5 | 1 of 2 |" in shown
    assert "| +2 mm | 3 / 4, 20 / 30 |" in shown
    assert "| +1 mm | 0 / 1 |" in shown
    assert "44%, 83%" in shown


def test_what_hides_the_wall_is_drawn_by_its_seed() -> None:
    places, depth_m = np.random.default_rng(0).random((400, 2)), np.full(400, 0.3)
    look = KNOCKED["occluder + 50-60 %"]
    first, again, other = (look.hide(places, seed)(depth_m, 0) for seed in (1, 1, 2))
    assert (first == again).all()
    assert (first != other).any()
    assert 0.5 < (first != depth_m).mean() < 0.9
    assert (AT_REST["noise"].hide(places, 1)(depth_m, 0) == depth_m).all()
