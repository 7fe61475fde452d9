"""`repair`, `export` and `info` of files: outputs kept safe, damage is exit code 4, facts and next
commands.
"""

import os
import signal
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from nlos_cam.cli import recordings
from nlos_cam.cli.info import _format_size
from nlos_cam.recording import repair_recording, verify

Run = Callable[..., Any]


def test_repair_reports_new_file_and_overwrites_if_asked(
    run: Run, noise_bags: dict[str, Path], tmp_path: Path
) -> None:
    (out := tmp_path / "good.bag").write_bytes(b"mine")
    command = "repair", noise_bags["packed-unindexed"], "--out", out
    error = run(*command, code=1)["error"]

    assert error["type"] == "OutputExistsError"
    assert out.read_bytes() == b"mine"

    found = run(*command, "--overwrite")

    assert set(found) == {"recovered_frames", "chunks", "damaged", "out"}
    assert found["recovered_frames"] == verify(out).streams
    assert found["damaged"] == 1
    assert found["out"] == str(out)
    assert found["chunks"] > 2


def test_repair_leaves_no_sidecar_of_what_it_replaces(
    run: Run, noise_bags: dict[str, Path], tmp_path: Path
) -> None:
    sidecar = tmp_path / "good.json"
    sidecar.write_text("{}", encoding="utf-8")
    command = "repair", noise_bags["packed"], "--out", tmp_path / "good.bag"
    assert run(*command, code=1)["error"]["type"] == "OutputExistsError"
    assert sidecar.exists()

    run(*command, "--overwrite")

    assert not sidecar.exists()


def test_repair_prints_what_was_recovered_and_lost(
    shown: Run, noise_bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    printed = shown("repair", noise_bags["packed"], "--out", tmp_path / "a.bag").out

    assert all(word in printed for word in ("40 depth", "40 infrared", "40 confidence", " 0 bytes"))

    content = bytearray(noise_bags["packed"].read_bytes())
    for at in range(1_000_000, len(content), 500_000):
        content[at] ^= 1
    (tmp_path / "bad.bag").write_bytes(content)
    repair = "repair", tmp_path / "bad.bag", "--overwrite", "--out", tmp_path / "b.bag"
    printed = shown(*repair).out

    assert " 0 bytes" not in printed
    assert str(tmp_path / "b.bag") in printed

    monkeypatch.setattr(recordings, "MAX_REPORTED", 1)  # much damage in few lines

    assert 1 < len(shown(*repair).out.splitlines()) < len(printed.splitlines())


def test_repair_interrupted_is_exit_code_130_without_output(
    run: Run, noise_bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(path: Path, out: Path, report: Callable[[int, int], None], **_: Any) -> Any:
        def once_half_way(done: int, total: int) -> None:
            report(done, total)
            if done > 0.7 * total:
                os.kill(os.getpid(), signal.SIGINT)

        return repair_recording(path, out, once_half_way)

    monkeypatch.setattr("nlos_cam.recording.repair_recording", interrupted)
    run("repair", noise_bags["plain"], "--out", tmp_path / "a.bag", code=130)

    assert list(tmp_path.iterdir()) == []


def test_interrupted_export_of_objects_says_what_it_kept(
    shown: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, stop: Event, **__: Any) -> int:
        stop.set()
        return 2

    monkeypatch.setattr("nlos_cam.replay.export_objects", interrupted)
    printed = shown("export", "a.npz", "--object", "ply", "--out", tmp_path / "out", code=130)

    assert "holds the surfaces until then" in printed.err
    assert "nothing was written" not in printed.err


def test_folder_of_a_replay_stands_for_its_result(
    shown: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export = Mock(return_value=2)
    monkeypatch.setattr("nlos_cam.replay.export_objects", export)
    result = tmp_path / "replayed" / "reconstruction.npz"
    result.parent.mkdir()
    result.touch()

    shown("export", result.parent, "--object", "ply", "--out", tmp_path / "out")
    shown("export", result.parent, "--out", tmp_path / "out", code=2)

    assert [call.args[0] for call in export.call_args_list] == [result]


def test_export_reports_its_files_and_overwrites_if_asked(
    noise_bag: Path, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "depth.csv").write_text("precious")
    command = "export", noise_bag, "--out", tmp_path, "--ply", "--every", "10"
    run(*command, code=1)

    assert (tmp_path / "depth.csv").read_text() == "precious"

    found = run(*command, "--overwrite")

    assert (tmp_path / "depth.csv").read_text() != "precious"
    assert found == {
        "frames": {"depth": 2, "infrared": 2, "confidence": 2, "points": 2},
        "out": str(tmp_path),
    }
    assert len(list((tmp_path / "points").glob("*.ply"))) == 2


def test_export_of_wrong_streams_or_damage_is_exit_code_4(
    noise_bag: Path, tmp_path: Path, shown: Run
) -> None:
    out = "--out", tmp_path / "out"

    assert "color" in shown("export", noise_bag, "--streams", "color", *out, code=4).err
    assert list(tmp_path.iterdir()) == []

    content = bytearray(noise_bag.read_bytes())
    middle = len(content) // 3
    content[middle : middle + 200] = bytes(200)
    (tmp_path / "damaged.bag").write_bytes(content)

    assert "nlos-cam repair" in shown("export", tmp_path / "damaged.bag", *out, code=4).err


def test_export_writes_hidden_surfaces_of_a_replay(tmp_path: Path, run: Run) -> None:
    depth_m = np.full((2, 64, 64), np.nan, np.float32)
    depth_m[0, 8:20, 8:20] = 0.2
    box = {"origin_m": [0.3, 0.1], "pitch_m": [0.004, -0.004], "z_near_m": 0.12, "z_far_m": 0.4}
    result = tmp_path / "reconstruction.npz"
    np.savez(result, depth_m=depth_m, uncertainty_m=depth_m, frame_number=[5, 6], **box)  # pyright: ignore[reportArgumentType]
    export = "export", result, "--out", tmp_path / "out", "--object"

    assert run(*export, "glb,points")["frames"] == {"objects": 1}
    assert {file.name for file in (tmp_path / "out").iterdir()} == {
        "000005.glb",
        "000005-points.ply",
    }

    for formats, word in (("", "--object ply"), ("ply,fbx", "fbx")):
        assert word in run(*export, formats, "--overwrite", code=2).err


def test_info_prints_facts_and_next_commands(noise_bag: Path, shown: Run) -> None:
    printed = shown("info", noise_bag, "--verify").out
    for words in (
        "recording of a lidar",
        "20 frames",
        "yes (checked: every message)",
        f"nlos-cam replay {noise_bag}",
    ):
        assert words in printed
    texts = {0: "0 bytes", 999: "999 bytes", 1_780_000: "1.78 MB", 48 * 10**9: "48 GB"}

    assert {size: _format_size(size) for size in texts} == texts


def test_info_of_damaged_or_unknown_file_is_exit_code_4(
    noise_bag: Path, tmp_path: Path, run: Run, shown: Run
) -> None:
    (cut := tmp_path / "cut.bag").write_bytes(noise_bag.read_bytes()[:9_000])
    found = run("info", cut, code=4)

    assert not found["whole"]
    assert "nlos-cam repair" in found["problem"]

    (tmp_path / "notes.txt").write_text("")
    for name in ("notes.txt", "nothing.bag"):
        out, err = shown("info", tmp_path / name, code=4)
        assert (out, name in err) == ("", True)
