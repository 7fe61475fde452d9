import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer

from nlos_cam.cli import recordings
from nlos_cam.cli.main import main
from nlos_cam.errors import OutputExistsError
from nlos_cam.recording.playback import verify

Run = Callable[..., tuple[int, dict[str, Any], str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run `nlos-cam repair --json`: the exit code, the last line of stdout, and stderr."""

    def call(*arguments: Path | str) -> tuple[int, dict[str, Any], str]:
        code = main(["repair", *map(str, arguments), "--json"])
        captured = capsys.readouterr()
        lines = captured.out.splitlines()
        return code, json.loads(lines[-1]) if lines else {}, captured.err

    return call


def test_json_tells_what_is_in_the_new_file(run: Run, noise_bags: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "good.bag"
    code, told, _ = run(noise_bags["packed-unindexed"], "--out", out)
    assert code == 0
    assert set(told) == {"recovered_frames", "chunks", "damaged", "out"}
    assert told["recovered_frames"] == verify(out).streams
    assert (told["damaged"], told["out"]) == (1, str(out))
    assert told["chunks"] > 2


def test_a_person_is_told_what_was_recovered_and_what_was_lost(
    capsys: pytest.CaptureFixture[str], noise_bags: dict[str, Path], tmp_path: Path
) -> None:
    recordings.repair_bag(noise_bags["packed"], tmp_path / "a.bag")
    told = capsys.readouterr().out
    assert "40 depth, 40 infrared, 40 confidence frames; lost 0 bytes" in told
    content = bytearray(noise_bags["packed"].read_bytes())
    for at in range(1_000_000, len(content), 500_000):
        content[at] ^= 1
    (tmp_path / "bad.bag").write_bytes(content)
    recordings.repair_bag(tmp_path / "bad.bag", tmp_path / "b.bag")
    told = capsys.readouterr().out
    assert "its data is damaged" in told
    assert "lost 0 bytes" not in told
    assert f"wrote {tmp_path / 'b.bag'}" in told


def test_many_damages_are_told_in_a_few_lines(
    capsys: pytest.CaptureFixture[str], noise_bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recordings, "MAX_TOLD", 1)
    content = noise_bags["plain"].read_bytes()
    (tmp_path / "bad.bag").write_bytes(b"X" + content[1:-1])
    recordings.repair_bag(tmp_path / "bad.bag", tmp_path / "a.bag")
    assert "and at 1 more places" in capsys.readouterr().out


def test_what_cannot_be_recovered_is_exit_code_4(run: Run, tmp_path: Path) -> None:
    (tmp_path / "bad.bag").write_bytes(b"nothing")
    for path in (tmp_path / "bad.bag", tmp_path / "none.bag"):
        code, told, shown = run(path, "--out", tmp_path / "a.bag")
        assert code == 4
        assert told["error"]["type"] == "RecordingError"
        assert "Traceback" not in shown
    assert not (tmp_path / "a.bag").exists()


def test_nothing_is_overwritten_unasked_and_the_original_never(
    run: Run, noise_bags: dict[str, Path], tmp_path: Path
) -> None:
    out, bag = tmp_path / "a.bag", noise_bags["plain"]
    out.write_bytes(b"mine")
    code, told, _ = run(bag, "--out", out)
    assert (code, told["error"]["type"], out.read_bytes()) == (1, "OutputExistsError", b"mine")
    assert run(bag, "--out", out, "--overwrite")[0] == 0
    before = bag.read_bytes()
    assert run(bag, "--out", bag, "--overwrite")[0] == 1
    assert bag.read_bytes() == before == out.read_bytes()
    with pytest.raises(OutputExistsError):
        recordings.repair_bag(bag, out)


def test_a_name_that_is_no_recordings_is_wrong_usage(noise_bags: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(typer.BadParameter, match=r"ends in \.bag"):
        recordings.repair_bag(noise_bags["plain"], tmp_path / "a.txt")


def test_ctrl_c_is_exit_code_130_and_leaves_nothing(
    run: Run, noise_bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repair = recordings.repair

    def interrupted(path: Path, out: Path, report: Callable[[int, int], None]) -> Any:
        def once_half_way(done: int, total: int) -> None:
            report(done, total)
            if done > 0.7 * total:
                os.kill(os.getpid(), signal.SIGINT)

        return repair(path, out, once_half_way)

    monkeypatch.setattr(recordings, "repair", interrupted)
    code, _, _ = run(noise_bags["plain"], "--out", tmp_path / "a.bag")
    assert code == 130
    assert list(tmp_path.iterdir()) == []


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
