from collections.abc import Iterator
from io import StringIO
from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import wall_depth
from rich.console import Console

from nlos_cam.calibrate.measure import Glance, glance
from nlos_cam.cli.calibrate import EVERY, gauge, panel, until_enter, watch
from nlos_cam.frames import Frame

INTRINSICS = load_rig("bare-wall").pinhole.scaled(160, 120)
DEPTH_M = wall_depth(load_rig("bare-wall").wall_from_lidar, INTRINSICS)
DEPTH_M += np.random.default_rng(0).standard_normal(DEPTH_M.shape) * (0.0005 + 0.002 * DEPTH_M)


def frames(count: int) -> Iterator[Frame]:
    counts = np.full(DEPTH_M.shape, 48, np.uint8)
    for number in range(count):
        yield Frame(DEPTH_M.astype(np.float32), counts, counts, number / 30, number, INTRINSICS)


def shown(seen: Glance) -> str:
    text = StringIO()
    Console(file=text, width=140).print(panel(seen))
    return text.getvalue()


def test_distance_angle_and_verdict_are_shown() -> None:
    text = shown(glance(next(frames(1))))
    for part in ("0.2000 m", "45.00 deg", "good", "●"):
        assert part in text


def test_a_refusal_and_saturation_are_shown_as_they_are() -> None:
    text = shown(Glance(None, "the wall [so to say] is not flat", 0.25))
    assert "the wall [so to say] is not flat" in text
    assert "25.0% saturated" in text


def test_it_ends_with_the_camera_or_when_told() -> None:
    asked: list[int] = []

    def stop() -> bool:
        asked.append(1)
        return len(asked) == 2 * EVERY

    camera: Any = frames(100)
    last = watch(camera, stop)
    assert last is not None
    assert last.fit is not None
    assert len(asked) == 2 * EVERY
    assert watch(frames(0), lambda: False) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("typed", ["\n", ""])
def test_enter_or_the_end_of_the_input_stops(monkeypatch: pytest.MonkeyPatch, typed: str) -> None:
    monkeypatch.setattr("sys.stdin", StringIO(typed))
    stopped = until_enter()
    for _ in range(1000):
        if stopped():
            return
        np.linalg.svd(np.eye(30))
    pytest.fail("it was not noticed")


def test_a_gauge_points_to_where_a_value_lies() -> None:
    places = [gauge(value, 0.15, 0.3).index("●") for value in (0.15, 0.2, 0.25, 0.3)]
    assert places == sorted(places)
    assert "◀" in gauge(0.1, 0.15, 0.3)
    assert "▶" in gauge(0.31, 0.15, 0.3)
    assert len({len(gauge(value, 0.15, 0.3)) for value in (0.0, 0.2, 1.0)}) == 1
