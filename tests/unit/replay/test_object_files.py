from pathlib import Path
from threading import Event

import numpy as np
import pytest
from made_up_moments import RIG
from replays import replay_moments

from nlos_cam.errors import RecordingError
from nlos_cam.objects import mesh_from_depth, object_box
from nlos_cam.replay import OBJECT_FORMATS, export_objects
from nlos_cam.replay.replay import RESULT


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a replay of seven frames, with every third object in all formats."""
    out = tmp_path_factory.mktemp("replay")
    replay_moments(out, 7, objects=OBJECT_FORMATS, every=3)
    return out


def names_in(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


def vertices_m(folder: Path) -> np.ndarray:
    with np.load(folder / "000003.npz") as mesh:
        return mesh["vertices_m"]


def test_replay_writes_the_surface_of_every_third_frame(replay: Path) -> None:
    assert len(names_in(replay / "object")) == 3 * len(OBJECT_FORMATS)

    with np.load(replay / RESULT) as result:
        mesh = mesh_from_depth(result["depth_m"][3], object_box(RIG))

    np.testing.assert_array_equal(vertices_m(replay / "object"), mesh.vertices_m)


def test_export_of_a_result_equals_the_files_of_its_replay(replay: Path, tmp_path: Path) -> None:
    out = tmp_path / "exported"

    assert export_objects(replay / RESULT, out, OBJECT_FORMATS, 3, stop=Event()) == 3
    assert names_in(out) == names_in(replay / "object")
    np.testing.assert_allclose(vertices_m(out), vertices_m(replay / "object"), atol=1e-9)


def test_export_replaces_the_files_of_an_earlier_one(replay: Path, tmp_path: Path) -> None:
    out = tmp_path / "exported"
    export_objects(replay / RESULT, out, OBJECT_FORMATS, stop=Event())
    for mine in ("notes.csv", "20241003-notes.csv", "123456789-scan.ply"):
        (out / mine).write_text("mine")
    export_objects(replay / RESULT, out, ["ply"], 3, stop=Event())

    written = ["000000.ply", "000003.ply", "000006.ply"]
    assert names_in(out) == sorted(
        [*written, "notes.csv", "20241003-notes.csv", "123456789-scan.ply"]
    )


def test_stopped_export_keeps_its_files_or_the_earlier_ones(replay: Path, tmp_path: Path) -> None:
    stop = Event()
    command = replay / RESULT, tmp_path / "a", ["ply"]

    def after_two(done: int, _: int) -> None:
        if done == 2:
            stop.set()

    assert export_objects(*command, stop=stop, on_frame=after_two) == 2
    with pytest.raises(KeyboardInterrupt):
        export_objects(*command, stop=stop)
    assert names_in(tmp_path / "a") == ["000000.ply", "000001.ply"]


def changed(replay: Path, path: Path, **arrays: object) -> Path:
    """Write a replay's result with other arrays."""
    with np.load(replay / RESULT) as file:
        np.savez(path, **{**file, **arrays})
    return path


def test_export_refuses_a_replay_without_surface(replay: Path, tmp_path: Path) -> None:
    nothing_m = np.full((7, 64, 64), np.nan, np.float32)
    path = changed(replay, tmp_path / "empty.npz", depth_m=nothing_m)
    with pytest.raises(RecordingError, match="no hidden surface"):
        export_objects(path, tmp_path / "out", ["ply"], stop=Event())

    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"text"])
def test_export_refuses_other_files(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "reconstruction.npz"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="replay"):
        export_objects(path, tmp_path / "out", ["ply"], stop=Event())

    assert names_in(tmp_path) == ["reconstruction.npz"]


def test_export_refuses_other_arrays(tmp_path: Path) -> None:
    path = tmp_path / "reconstruction.npz"
    np.savez(path, depth_m=np.zeros(3))
    with pytest.raises(RecordingError, match="replay"):
        export_objects(path, tmp_path / "out", ["ply"], stop=Event())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("depth_m", "text"),
        ("depth_m", 1.0),
        ("pitch_m", [0.1]),
        ("z_far_m", 0.0),
        ("frame_number", [1, 2]),
        ("z_near_m", [[]]),
    ],
)
def test_export_refuses_arrays_that_contradict(
    replay: Path, tmp_path: Path, name: str, value: object
) -> None:
    path = changed(replay, tmp_path / "bad.npz", **{name: np.array(value)})
    with pytest.raises(RecordingError, match="not the reconstruction"):
        export_objects(path, tmp_path / "out", ["ply"], stop=Event())
