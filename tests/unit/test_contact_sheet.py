from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_wall import wall_frame
from matplotlib.figure import Figure

from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.live.replay_media import _even_limits, _limits, draw_sheet
from nlos_cam.reconstruct.network import Reconstruction
from nlos_cam.reconstruct.pipeline import FrameResult
from nlos_cam.reconstruct.verdict import Verdict


def step(number: int, difference: LidarMaps | None = None) -> FrameResult:
    frame = wall_frame(number)
    hidden = Reconstruction(np.full((64, 64), np.nan, np.float32), np.eye(4), None, {})
    return FrameResult(frame, maps_from_frame(frame), hidden, 0.0, {}, difference)


def titles(tmp_path: Path, steps: list[FrameResult], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the sheet's colour bars and columns say."""
    saved: list[Any] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: saved.append(figure))
    draw_sheet(tmp_path / "sheet.png", steps)
    axes = saved[0].axes
    return [axis.get_ylabel() or axis.get_title() for axis in axes if axis.get_ylabel() or axis.get_title()]


def test_a_sheet_has_a_row_for_each_look_and_a_column_for_each_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = ["lidar depth (m)", "infrared (counts)", "hidden depth (m)"]
    assert titles(tmp_path, [step(3), step(9)], monkeypatch) == ["frame 3", "frame 9", *plain]
    differing = [step(number, maps_from_frame(wall_frame(number))) for number in (3, 9)]
    assert titles(tmp_path, differing, monkeypatch)[2:] == [*plain[:2], "difference (mm)", plain[2]]


def test_a_verdict_and_an_uncertainty_are_on_the_sheet_where_there_are_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = step(3)
    spread_m = np.full((64, 64), 0.01, np.float32)
    told = replace(plain, verdict=Verdict.OUTSIDE, reconstruction=replace(plain.reconstruction, uncertainty_m=spread_m))
    said = titles(tmp_path, [told], monkeypatch)
    assert said[0] == "frame 3\noutside the trained range"
    assert said[-1] == "uncertainty (mm)"


def test_it_is_a_picture(tmp_path: Path) -> None:
    nothing = np.full((64, 80), np.nan, np.float32)
    maps = replace(maps_from_frame(wall_frame(0)), depth_m=nothing)
    draw_sheet(tmp_path / "sheet.png", [step(0, maps)])
    assert (tmp_path / "sheet.png").read_bytes().startswith(b"\x89PNG")


def test_limits_hold_what_is_there() -> None:
    images = [np.array([[np.nan, 2.0]], np.float32), np.array([[-1.0, 0.5]], np.float32)]
    assert _limits(images) == (-1.0, 2.0)
    assert _limits([np.full((2, 2), np.nan, np.float32)]) == (0.0, 1.0)


def test_limits_of_differences_are_even_and_leave_out_what_is_far_off() -> None:
    image = np.random.default_rng(0).normal(0.0, 1.0, (64, 80)).astype(np.float32)
    image[:2] = -500.0
    low, high = _even_limits([image])
    assert low == -high
    assert 1.9 < high < 3.0
    assert _even_limits([]) == (-1.0, 1.0)
