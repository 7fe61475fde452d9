from typing import Any

import pytest
from pydantic import ValidationError

from nlos_cam.render.scene_file import Fault, SceneFile, bare_wall_scene, one_wrap


@pytest.mark.parametrize(
    ("table", "told"),
    [
        ({"kind": "explode", "at_frame": 1}, "'stall', 'drops'"),
        ({"kind": "stall"}, "at_frame"),
        ({"kind": "stall", "at_frame": -1}, "greater than or equal to 0"),
        ({"kind": "stall", "at_frame": 0, "frames": 0}, "greater than 0"),
        ({"kind": "stall", "at_frame": 0.5}, "integer"),
        ({"kind": "stall", "at_frame": 0, "seconds": 3}, "seconds"),
        ({"kind": "stall", "at_frame": 0, "stream": "depth"}, "stream is for drops: a stall befalls all"),
        ({"kind": "drops", "at_frame": 0, "stream": "color"}, "'depth', 'infrared' or 'confidence'"),
        ({"kind": "clock_wrap", "at_frame": 0, "frames": 2}, "a clock_wrap is at one frame"),
    ],
)
def test_a_table_that_makes_no_sense_is_told(table: dict[str, Any], told: str) -> None:
    with pytest.raises(ValidationError, match=told):
        Fault.model_validate(table)


def test_a_clock_wraps_once_a_run() -> None:
    wraps = tuple(Fault(kind="clock_wrap", at_frame=frame) for frame in (1, 9))
    assert one_wrap(wraps[:1]) == wraps[:1]
    with pytest.raises(ValidationError, match="give one clock_wrap"):
        SceneFile.model_validate({**dict(bare_wall_scene()), "faults": wraps})


@pytest.mark.parametrize(("kind", "frames"), [("stall", [5, 6, 7]), ("out_of_order", [5, 6, 7, 8, 9, 10])])
def test_a_fault_lasts_from_its_frame_on(kind: Any, frames: list[int]) -> None:
    fault = Fault(kind=kind, at_frame=5, frames=3)
    assert [frame for frame in range(20) if fault.befalls(frame)] == frames
