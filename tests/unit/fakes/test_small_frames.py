"""The camera of small frames and the network of one sheet have the parts of real ones."""

import inspect
from itertools import islice, pairwise

import numpy as np
import pytest
from fake_wall import WallCamera
from made_up_moments import Recorded
from nlos_models.checkpoint import CheckpointRecord
from small_frames import FrameCamera, SheetNetwork, sheet_network

from nlos_cam.camera import Camera
from nlos_cam.reconstruct import load_networks

METHODS = sorted(name for name, _ in inspect.getmembers(Camera, inspect.isfunction))


@pytest.mark.parametrize(
    "camera", [FrameCamera(3), WallCamera(3), Recorded(3)], ids=["frames", "wall", "recorded"]
)
def test_fake_camera_has_every_part_of_a_camera(camera: FrameCamera) -> None:
    assert [name for name in Camera.__annotations__ if not hasattr(camera, name)] == []
    assert {"__enter__", "__exit__", "__iter__", "telemetry"} <= set(METHODS)
    assert [name for name in METHODS if not callable(getattr(camera, name, None))] == []
    assert isinstance(camera.telemetry(ending="_temperature"), dict)


def test_frames_of_the_fake_camera_rise_by_30_a_second() -> None:
    with FrameCamera(None) as camera:
        frames = list(islice(camera, 4))

    for one, next_one in pairwise(frames):
        assert next_one.frame_number == one.frame_number + 1
        assert next_one.timestamp_s - one.timestamp_s == pytest.approx(1 / 30)

    assert camera.closed.is_set()


def test_sheet_networks_answer_in_the_shape_of_a_real_one() -> None:
    maps = np.full((1, 64, 80), 0.3, np.float32), np.full((1, 64, 80), 40.0, np.float32)
    real = load_networks()(*maps)

    for fake in (SheetNetwork()(*maps), sheet_network(*maps)):
        assert (fake.shape, fake.dtype) == (real.shape, real.dtype)


def test_record_of_the_sheet_network_has_fields_of_a_real_one() -> None:
    assert set(vars(SheetNetwork().record)) <= set(dir(CheckpointRecord)) | set(
        CheckpointRecord.model_fields
    )
