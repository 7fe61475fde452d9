"""A camera that is watched: frames that come, stand still, or stay away."""

from dataclasses import replace

import numpy as np
from small_frames import FrameCamera, small_frame

from nlos_cam.doctor.checks import stream
from nlos_cam.doctor.facts import Facts, Finding, Watched
from nlos_cam.doctor.stream import watch, watch_camera
from nlos_cam.frames import Frame


def noisy(number: int) -> Frame:
    """A frame whose infrared is noise of its own."""
    ir = np.random.default_rng(number).integers(5, 60, (64, 80), np.uint8)
    return replace(small_frame(number), ir=ir)


def finding(found: Watched) -> Finding:
    """Return what the check makes of it."""
    facts = object.__new__(Facts)
    object.__setattr__(facts, "watched", found)
    return stream(facts)


def test_camera_with_other_frames_passes() -> None:
    found = watch_camera(FrameCamera(20, make=noisy), "l515", 60.0)

    assert (found.frames, found.is_frozen) == (20, False)
    assert finding(found).status == "ok"


def test_camera_that_repeats_one_frame_is_frozen() -> None:
    found = watch_camera(
        FrameCamera(20, make=lambda number: replace(noisy(0), frame_number=number)), "l515", 60.0
    )

    assert found.is_frozen
    assert "again and again" in finding(found).detail
    assert "replug" in finding(found).fix or "plug it in" in finding(found).fix


def test_camera_that_repeats_one_number_is_frozen() -> None:
    camera = FrameCamera(1, make=noisy)
    camera.counts["duplicate"] = 149
    found = watch_camera(camera, "l515", 60.0)

    assert found.is_frozen
    assert "again and again" in finding(found).detail


def test_camera_with_few_frames_is_a_warning() -> None:
    few = finding(Watched("l515", 70, 5.0, frames_expected=150.0))
    enough = finding(Watched("l515", 80, 5.0, frames_expected=150.0))

    assert few.status == "warning"
    assert "70 frames" in few.detail
    assert enough.status == "ok"


def test_camera_without_frames_ends_with_a_fix() -> None:
    found = watch_camera(FrameCamera(0), "l515", 60.0)

    assert found.frames == 0
    assert "no frame" in finding(found).detail


def test_camera_that_does_not_open_is_an_answer() -> None:
    found = watch("bag:missing.bag")

    assert "missing.bag" in found.error
    assert finding(found).status == "failed"
