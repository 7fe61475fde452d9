"""`info` prints what a file is and what to do next; a damaged or unknown file is exit code 4."""

import json
from pathlib import Path

import pytest

from nlos_cam.cli.info import _format_size
from nlos_cam.cli.main import main


def test_info_prints_facts_and_next_commands(noise_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(noise_bag), "--verify"]) == 0
    shown = capsys.readouterr().out
    for words in ("recording of a lidar", "20 frames", "yes (checked: every message)", f"nlos-cam replay {noise_bag}"):
        assert words in shown


def test_info_of_damaged_or_unknown_file_is_exit_code_4(
    noise_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (cut := tmp_path / "cut.bag").write_bytes(noise_bag.read_bytes()[:9_000])
    assert main(["info", str(cut), "--json"]) == 4
    found = json.loads(capsys.readouterr().out)
    assert not found["whole"]
    assert "nlos-cam repair" in found["problem"]
    (tmp_path / "notes.txt").write_text("")
    for name in ("notes.txt", "nothing.bag"):
        assert main(["info", str(tmp_path / name)]) == 4
        captured = capsys.readouterr()
        assert not captured.out
        assert name in captured.err


@pytest.mark.parametrize(
    ("size", "text"), [(0, "0 bytes"), (999, "999 bytes"), (1_780_000, "1.78 MB"), (48 * 10**9, "48 GB")]
)
def test_sizes_have_one_unit_and_three_digits(size: int, text: str) -> None:
    assert _format_size(size) == text
