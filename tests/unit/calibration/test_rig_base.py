"""A rig file with a base: only the changed keys, everything else from another rig."""

from pathlib import Path

import pytest
from nlos_calibration import load_rig
from nlos_calibration.errors import RecordFileError

from nlos_cam.render import load_scene

PAPER = load_rig("paper-rig")


def rig_file(folder: Path, text: str, name: str = "mine") -> Path:
    path = folder / f"{name}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_base_gives_all_that_the_file_does_not_change(tmp_path: Path) -> None:
    rig = load_rig(rig_file(tmp_path, 'base = "paper-rig"\n[lidar]\ndistance_m = 0.25\n'))
    lidar = PAPER.lidar.model_copy(update={"distance_m": 0.25})

    assert rig == PAPER.model_copy(update={"name": "mine", "lidar": lidar})


def test_base_may_be_a_whole_rig_beside_the_file(tmp_path: Path) -> None:
    whole = rig_file(tmp_path, 'base = "paper-rig"\n[occluder]\nx_m = 0.18\n', "one")
    text = f'base = "{whole.name}"\nname = "two"\n'
    with pytest.raises(RecordFileError, match="base of its own"):
        load_rig(rig_file(tmp_path, text, "two"))

    from nlos_calibration import dump_toml

    whole.write_text(dump_toml(load_rig(whole)), encoding="utf-8")
    rig = load_rig(rig_file(tmp_path, text, "two"))

    assert (rig.name, rig.occluder.x_m, rig.lidar) == ("two", 0.18, PAPER.lidar)


def test_scene_changes_a_base_rig(tmp_path: Path) -> None:
    text = 'name = "near"\n[rig]\nbase = "paper-rig"\n[rig.lidar]\ndistance_m = 0.17\n'
    scene = load_scene(rig_file(tmp_path, text))

    assert scene.rig.lidar.distance_m == 0.17
    assert scene.rig.name == "near"
    assert scene.rig.object_box == PAPER.object_box


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("base = 3\n", "name or file"),
        ('base = "paper-rgi"\n', "paper-rig"),
        ('base = "mine.toml"\n', "base of its own"),
        ('base = "paper-rig"\n[lidar]\ndistnace_m = 0.2\n', "distnace_m"),
        ('base = "paper-rig"\nlidar = 0.2\n', "lidar"),
    ],
)
def test_base_that_cannot_be_used_is_named(tmp_path: Path, text: str, word: str) -> None:
    with pytest.raises(RecordFileError, match=word):
        load_rig(rig_file(tmp_path, text))


def test_file_goes_before_a_packaged_rig_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = rig_file(tmp_path, 'base = "paper-rig"\n[lidar]\ndistance_m = 0.25\n')
    own.rename(tmp_path / "wide-rig")
    monkeypatch.chdir(tmp_path)

    assert load_rig("wide-rig").lidar.distance_m == 0.25
    assert load_rig("paper-rig") == PAPER
