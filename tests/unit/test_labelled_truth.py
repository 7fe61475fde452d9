"""What was hidden, by a label: a test object, or what lies beside the recording."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from nlos_calibration.rig import load_rig

from nlos_cam.dataset.labelled import fixed_objects, truth_depth_m
from nlos_cam.errors import RecordingError, SceneError
from nlos_cam.objects.benchmark import test_set as fixed_set
from nlos_cam.objects.depth_map import cell_centres_m, object_box

RIG = load_rig("paper-rig")
BOX = object_box(RIG)
KNOWN = {"cup-1": np.full((64, 64), 0.2, np.float32)}


def _truth(folder: Path, label: str, name: str = "F") -> np.ndarray:
    return truth_depth_m(folder / f"{name}.bag", label, RIG, KNOWN)


def _write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def _ball(path: Path) -> Path:
    trimesh.creation.icosphere(subdivisions=3).export(path)
    return path


def test_the_label_of_a_test_object_tells_it() -> None:
    assert _truth(Path("nowhere"), "cup-1") is KNOWN["cup-1"]
    objects = fixed_objects(BOX)
    assert list(objects) == [thing.name for thing in fixed_set(BOX)]
    np.testing.assert_array_equal(objects["cup-2"], next(o.depth_m for o in fixed_set(BOX) if o.name == "cup-2"))


@pytest.mark.parametrize("name", ["F", "mug"])
def test_a_depth_map_of_the_recordings_name_or_of_its_label_is_the_truth(tmp_path: Path, name: str) -> None:
    depth_m = np.where(np.eye(64) > 0, np.float32(0.3), np.float32(np.nan))
    np.save(tmp_path / f"{name}.npy", depth_m)
    np.testing.assert_array_equal(_truth(tmp_path, "mug"), depth_m)


def test_a_take_of_its_own_goes_before_its_label_and_both_before_a_test_object(tmp_path: Path) -> None:
    np.save(tmp_path / "cup-1.npy", np.full((64, 64), 0.3, np.float32))
    assert (_truth(tmp_path, "cup-1") == np.float32(0.3)).all()
    np.save(tmp_path / "F.npy", np.full((64, 64), 0.25, np.float32))
    assert (_truth(tmp_path, "cup-1") == np.float32(0.25)).all()
    assert (_truth(tmp_path, "cup-1", name="G") == np.float32(0.3)).all()


@pytest.mark.parametrize("named", [True, False])
def test_a_mesh_stands_where_its_truth_file_says(tmp_path: Path, named: bool) -> None:
    _ball(tmp_path / ("print.stl" if named else "mug.stl"))
    file = 'file = "print.stl"\n' if named else ""
    _write(tmp_path / "mug.truth.toml", f"{file}size_m = 0.1\nx_m = 0.05\ny_m = -0.03\nfront_m = 0.06\n")
    depth_m = _truth(tmp_path, "mug")
    x_m, y_m = cell_centres_m(BOX)
    rows, columns = np.nonzero(~np.isnan(depth_m))
    assert x_m[columns].mean() == pytest.approx(0.45 + 0.05, abs=0.002)
    assert y_m[rows].mean() == pytest.approx(-0.03, abs=0.002)
    assert np.ptp(x_m[columns]) == pytest.approx(0.1, abs=0.01)
    assert np.nanmin(depth_m) == pytest.approx(BOX.z_near_m + 0.06, abs=0.001)


def test_a_truth_file_may_name_a_variation_of_a_category(tmp_path: Path) -> None:
    _write(tmp_path / "mug.truth.toml", 'category = "cup"\nseed = 3\nsize_m = 0.15\n')
    assert np.isfinite(_truth(tmp_path, "mug")).any()


def test_a_label_that_nothing_tells_says_what_to_add(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"labelled 'mug', .*such as cup-1.*mug\.truth\.toml.*mug\.npy"):
        _truth(tmp_path, "mug")


def test_a_mesh_without_a_pose_says_what_to_write(tmp_path: Path) -> None:
    _ball(tmp_path / "mug.stl")
    with pytest.raises(RecordingError, match=r"how .*mug\.stl stands.*mug\.truth\.toml.*size_m, x_m, y_m, front_m"):
        _truth(tmp_path, "mug")


def test_two_truths_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "mug.npy", KNOWN["cup-1"])
    _write(tmp_path / "mug.truth.toml", 'category = "cup"\n')
    with pytest.raises(RecordingError, match="both tell what 'mug' is"):
        _truth(tmp_path, "mug")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("size = 0.1", "does not tell a hidden object: "),
        ('category = "mug"', "category: .*no such category"),
        ('category = "cup"\nsize_m = 50', "size_m: must be from"),
        ('file = "none.stl"', "none.stl cannot be read"),
        ("size_m 0.1", "cannot be read as TOML"),
        ("size_m = 0.1", "give one of category and file"),
    ],
)
def test_a_truth_file_that_cannot_be_names_its_problem(tmp_path: Path, text: str, problem: str) -> None:
    _write(tmp_path / "mug.truth.toml", text)
    with pytest.raises(RecordingError, match=f"mug.truth.toml .*{problem}"):
        _truth(tmp_path, "mug")


def test_an_object_beside_the_box_is_refused(tmp_path: Path) -> None:
    _write(tmp_path / "mug.truth.toml", 'category = "cup"\nx_m = 1.0\n')
    with pytest.raises(SceneError, match="shows no surface in the object box"):
        _truth(tmp_path, "mug")


def test_a_depth_map_of_another_size_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "mug.npy", np.full((32, 32), 0.2, np.float32))
    with pytest.raises(RecordingError, match=r"shape \(32, 32\)"):
        _truth(tmp_path, "mug")


@pytest.mark.parametrize("label", ["../mug", "a/mug"])
def test_a_label_is_not_a_path(tmp_path: Path, label: str) -> None:
    np.save(tmp_path / "mug.npy", KNOWN["cup-1"])
    folder = tmp_path / "a"
    folder.mkdir()
    with pytest.raises(RecordingError, match="is no test object"):
        _truth(folder, label)
