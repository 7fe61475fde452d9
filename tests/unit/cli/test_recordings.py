"""`repair`, `export` and `info` of files: outputs kept safe, damage is exit code 4, facts and next commands."""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlos_cam.cli import recordings
from nlos_cam.cli.info import _format_size
from nlos_cam.cli.main import main
from nlos_cam.recording import repair_recording, verify

Capsys = pytest.CaptureFixture[str]

Run = Callable[..., dict[str, Any]]


@pytest.fixture
def run(capsys: Capsys) -> Run:
    """Run a command with --json, assert its exit code, and return the last line of stdout."""

    def call(*arguments: Path | str, code: int = 0) -> dict[str, Any]:
        assert main([*map(str, arguments), "--json"]) == code
        return json.loads((capsys.readouterr().out.splitlines() or ["{}"])[-1])

    return call


def test_repair_json_reports_the_new_file(run: Run, noise_bags: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "good.bag"
    found = run("repair", noise_bags["packed-unindexed"], "--out", out)
    assert set(found) == {"recovered_frames", "chunks", "damaged", "out"}
    assert found["recovered_frames"] == verify(out).streams
    assert (found["damaged"], found["out"]) == (1, str(out))
    assert found["chunks"] > 2


def test_repair_prints_what_was_recovered_and_lost(
    capsys: Capsys, noise_bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings.repair(noise_bags["packed"], tmp_path / "a.bag")
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("40 depth", "40 infrared", "40 confidence", " 0 bytes"))
    content = bytearray(noise_bags["packed"].read_bytes())
    for at in range(1_000_000, len(content), 500_000):
        content[at] ^= 1
    (tmp_path / "bad.bag").write_bytes(content)
    recordings.repair(tmp_path / "bad.bag", tmp_path / "b.bag")
    shown = capsys.readouterr().out
    assert " 0 bytes" not in shown
    assert str(tmp_path / "b.bag") in shown
    monkeypatch.setattr(recordings, "MAX_REPORTED", 1)  # much damage in few lines
    recordings.repair(tmp_path / "bad.bag", tmp_path / "c.bag")
    assert 1 < len(capsys.readouterr().out.splitlines()) < len(shown.splitlines())


def test_repair_overwrites_with_the_option_but_not_its_input(
    run: Run, noise_bags: dict[str, Path], tmp_path: Path
) -> None:
    out, bag = tmp_path / "a.bag", noise_bags["plain"]
    out.write_bytes(b"mine")
    error = run("repair", bag, "--out", out, code=1)["error"]
    assert (error["type"], out.read_bytes()) == ("OutputExistsError", b"mine")
    run("repair", bag, "--out", out, "--overwrite")
    before = bag.read_bytes()
    run("repair", bag, "--out", bag, "--overwrite", code=1)
    assert bag.read_bytes() == before == out.read_bytes()


def test_repair_interrupted_is_exit_code_130_without_output(
    run: Run, noise_bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(path: Path, out: Path, report: Callable[[int, int], None]) -> Any:
        def once_half_way(done: int, total: int) -> None:
            report(done, total)
            if done > 0.7 * total:
                os.kill(os.getpid(), signal.SIGINT)

        return repair_recording(path, out, once_half_way)

    monkeypatch.setattr("nlos_cam.recording.repair_recording", interrupted)
    run("repair", noise_bags["plain"], "--out", tmp_path / "a.bag", code=130)
    assert list(tmp_path.iterdir()) == []


def test_export_json_reports_what_was_written(noise_bag: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "out"
    found = run("export", noise_bag, "--out", out, "--ply", "--every", "10")
    assert found == {"frames": {"depth": 2, "infrared": 2, "confidence": 2, "points": 2}, "out": str(out)}
    assert len(list((out / "points").glob("*.ply"))) == 2


def test_export_overwrites_only_with_the_option(noise_bag: Path, tmp_path: Path) -> None:
    (tmp_path / "depth.csv").write_text("precious")
    arguments = ["export", str(noise_bag), "--out", str(tmp_path)]
    assert main(arguments) == 1
    assert (tmp_path / "depth.csv").read_text() == "precious"
    assert main([*arguments, "--overwrite"]) == 0
    assert (tmp_path / "depth.csv").read_text() != "precious"


def test_export_of_wrong_streams_or_damage_is_exit_code_4(noise_bag: Path, tmp_path: Path, capsys: Capsys) -> None:
    out = ["--out", str(tmp_path / "out")]
    assert main(["export", str(noise_bag), "--streams", "color", *out]) == 4
    assert "color" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    content = bytearray(noise_bag.read_bytes())
    middle = len(content) // 3
    content[middle : middle + 200] = bytes(200)
    (tmp_path / "damaged.bag").write_bytes(content)
    assert main(["export", str(tmp_path / "damaged.bag"), *out]) == 4
    assert "nlos-cam repair" in capsys.readouterr().err


def test_export_writes_hidden_surfaces_of_a_replay(tmp_path: Path, capsys: Capsys) -> None:
    depth_m = np.full((2, 64, 64), np.nan, np.float32)
    depth_m[0, 8:20, 8:20] = 0.2
    box = {"origin_m": [0.3, 0.1], "pitch_m": [0.004, -0.004], "z_near_m": 0.12, "z_far_m": 0.4}
    result = tmp_path / "reconstruction.npz"
    np.savez(result, depth_m=depth_m, uncertainty_m=depth_m, frame_number=[5, 6], **box)  # pyright: ignore[reportArgumentType]
    export = ["export", str(result), "--out", str(tmp_path / "out"), "--json"]
    assert main([*export, "--object", "glb,points"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == {"objects": 1}
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"000005.glb", "000005-points.ply"}
    for formats, word in (("", "--object ply"), ("ply,fbx", "fbx")):
        assert main([*export, "--object", formats, "--overwrite"]) == 2
        assert word in capsys.readouterr().err


def test_info_prints_facts_and_next_commands(noise_bag: Path, capsys: Capsys) -> None:
    assert main(["info", str(noise_bag), "--verify"]) == 0
    shown = capsys.readouterr().out
    for words in ("recording of a lidar", "20 frames", "yes (checked: every message)", f"nlos-cam replay {noise_bag}"):
        assert words in shown


def test_info_of_damaged_or_unknown_file_is_exit_code_4(noise_bag: Path, tmp_path: Path, capsys: Capsys) -> None:
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


def test_sizes_have_one_unit_and_three_digits() -> None:
    texts = {0: "0 bytes", 999: "999 bytes", 1_780_000: "1.78 MB", 48 * 10**9: "48 GB"}
    assert {size: _format_size(size) for size in texts} == texts
