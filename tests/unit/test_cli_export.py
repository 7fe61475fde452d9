import json
from pathlib import Path

import pytest

from nlos_cam.cli.main import main


def test_json_tells_what_was_written(noise_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["export", str(noise_bag), "--out", str(out), "--ply", "--every", "10", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told == {"frames": {"depth": 2, "infrared": 2, "confidence": 2, "points": 2}, "out": str(out)}
    assert len(list((out / "points").glob("*.ply"))) == 2


def test_a_folder_with_something_in_it_is_not_replaced_unasked(noise_bag: Path, tmp_path: Path) -> None:
    (tmp_path / "depth.csv").write_text("precious")
    arguments = ["export", str(noise_bag), "--out", str(tmp_path)]
    assert main(arguments) == 1
    assert (tmp_path / "depth.csv").read_text() == "precious"
    assert main([*arguments, "--overwrite"]) == 0
    assert (tmp_path / "depth.csv").read_text() != "precious"


def test_an_unknown_stream_and_a_wrong_file_are_4(
    noise_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "out")]
    assert main(["export", str(noise_bag), "--streams", "color", *out]) == 4
    assert "has no color stream" in capsys.readouterr().err
    assert main(["export", str(tmp_path / "none.bag"), *out]) == 4
    assert list(tmp_path.iterdir()) == []


def test_damage_is_4_and_names_what_was_kept(
    noise_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = bytearray(noise_bag.read_bytes())
    middle = len(content) // 3
    content[middle : middle + 200] = bytes(200)
    path = tmp_path / "damaged.bag"
    path.write_bytes(content)
    code = main(["export", str(path), "--out", str(tmp_path / "out")])
    assert code == 4
    assert "nlos-cam repair" in capsys.readouterr().err
