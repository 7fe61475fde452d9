"""Files of hidden objects: written during a replay or from its result, they are the same."""

from pathlib import Path
from threading import Event

import numpy as np
import pytest
from made_up_moments import RIG, Recorded, bump

from nlos_cam.errors import RecordingError
from nlos_cam.live import OBJECT_FORMATS, ReplayMedia, export_objects, replay_recording
from nlos_cam.objects import image_from_depth, mesh_from_depth, object_box
from nlos_cam.reconstruct import CalibratedRig, Pipeline

BENCH, BOX = CalibratedRig(RIG), object_box(RIG)


def network(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
    """Return the same hill for all maps."""
    return np.repeat(image_from_depth(bump(0), BOX)[np.newaxis], len(depth_m), axis=0)


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a replay of seven frames, with every third object in all formats."""
    out = tmp_path_factory.mktemp("replay")
    media = ReplayMedia(BENCH, objects=OBJECT_FORMATS, every=3)
    replay_recording(Recorded(7), Pipeline(BENCH, network), out, stop=Event(), media=media)
    return out


def test_export_of_result_equals_files_of_replay(replay: Path, tmp_path: Path) -> None:
    count = export_objects(replay / "reconstruction.npz", tmp_path / "exported", OBJECT_FORMATS, 3, stop=Event())
    made, exported = (
        {file.name: file for file in folder.iterdir()} for folder in (replay / "object", tmp_path / "exported")
    )
    assert count == 3
    assert sorted(made) == sorted(exported)
    assert len(made) == 3 * len(OBJECT_FORMATS)
    vertices = [np.load(files["000003.npz"])["vertices_m"] for files in (made, exported)]
    np.testing.assert_allclose(*vertices, atol=1e-9)
    depth_m = np.load(replay / "reconstruction.npz")["depth_m"][3]
    np.testing.assert_array_equal(vertices[0], mesh_from_depth(depth_m, BOX).vertices_m)


def test_export_stops_when_asked_and_skips_frames_without_surface(replay: Path, tmp_path: Path) -> None:
    (stop := Event()).set()
    assert export_objects(replay / "reconstruction.npz", tmp_path / "a", ["ply"], stop=stop) == 0
    with np.load(replay / "reconstruction.npz") as file:
        arrays = dict(file)
    arrays["depth_m"][:] = np.nan
    np.savez(tmp_path / "empty.npz", **arrays)
    assert export_objects(tmp_path / "empty.npz", tmp_path / "b", ["ply"], stop=Event()) == 0


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"text"])
def test_export_refuses_other_files(tmp_path: Path, content: bytes) -> None:
    (path := tmp_path / "reconstruction.npz").write_bytes(content)
    with pytest.raises(RecordingError, match="replay"):
        export_objects(path, tmp_path / "out", ["ply"], stop=Event())
    np.savez(path, depth_m=np.zeros(3))
    with pytest.raises(RecordingError, match="replay"):
        export_objects(path, tmp_path / "out", ["ply"], stop=Event())
    assert [file.name for file in tmp_path.iterdir()] == ["reconstruction.npz"]


BAD = {"pitch_m": [0.1], "z_far_m": 0.0, "frame_number": [1, 2], "z_near_m": [[]]}


@pytest.mark.parametrize(("name", "value"), [("depth_m", "text"), ("depth_m", 1.0), *BAD.items()])
def test_export_refuses_arrays_that_contradict(replay: Path, tmp_path: Path, name: str, value: object) -> None:
    with np.load(replay / "reconstruction.npz") as file:
        np.savez(tmp_path / "bad.npz", **{**file, name: np.array(value)})
    with pytest.raises(RecordingError, match="not the reconstruction"):
        export_objects(tmp_path / "bad.npz", tmp_path / "out", ["ply"], stop=Event())
