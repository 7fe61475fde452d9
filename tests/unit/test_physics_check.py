import logging

import numpy as np
import pytest

from nlos_cam.frames import LidarMaps
from nlos_cam.reconstruct.physics_check import NullPhysicsCheck, failure, log_warning


def test_where_nothing_is_checked_there_is_never_a_check() -> None:
    nothing = np.zeros((64, 80), np.float32)
    with NullPhysicsCheck() as checks:
        checks.offer(1, LidarMaps(nothing, nothing, nothing > 0), nothing[:, :64])
        assert checks.newest is None


def test_a_failure_names_its_frame_and_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        log_warning(failure(7, "SceneError: 100 % wrong"))
    assert caplog.messages == ["the physics check of frame 7 failed (SceneError: 100 % wrong): frames go on without"]
