import json
import signal
from pathlib import Path
from typing import Any

import pytest

from nlos_cam.cli import capture
from nlos_cam.cli.capture import ending, result, told
from nlos_cam.cli.main import main
from nlos_cam.errors import CameraLostError, DiskFullError
from nlos_cam.recording.capture import CaptureResult, CaptureTarget
from nlos_cam.recording.playback import Verified
from nlos_cam.recording.quality import Quality

STREAMS = {"depth": 30, "infrared": 30, "confidence": 30}
SEEN = Quality(30, 0.001, 0.25, 9.0, 1.234, 0.1)


class Beside:
    """Stands for a SidecarFile: only its path is told."""

    path = Path("a.json")


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / "a.bag"
    path.write_bytes(bytes(3_000_000))
    return path


def take(path: Path, **changes: Any) -> CaptureResult:
    found = Verified(30, 1, 1.00049, STREAMS)
    values = {
        "job": CaptureTarget(path),
        "state": "complete",
        "sets": 30,
        "quality": SEEN,
        "sidecar": Beside(),
        "found": found,
    }
    return CaptureResult(**values | changes)


def test_one_take_is_told_as_it_is(bag: Path) -> None:
    assert result([take(bag)], several=False) == {
        "frames": 30,
        "dropped": 1,
        "seconds": 1.0,
        "out": str(bag),
        "state": "complete",
        "streams": STREAMS,
        "saturated_share": 0.001,
        "invalid_share": 0.25,
        "temporal_noise_mm": 1.234,
        "sidecar": "a.json",
    }


def test_a_label_is_told_where_there_is_one(bag: Path) -> None:
    assert result([take(bag, job=CaptureTarget(bag, "a cup"))], several=False)["label"] == "a cup"


def test_several_takes_have_totals(bag: Path) -> None:
    found = result([take(bag), take(bag)], several=True)
    assert [one["frames"] for one in found["takes"]] == [30, 30]
    assert (found["frames"], found["dropped"], found["seconds"]) == (60, 2, 2.0)


def test_what_was_not_read_back_is_unknown_and_not_zero(bag: Path) -> None:
    found = result([take(bag, found=None, state="interrupted")], several=False)
    assert found["frames"] is found["dropped"] is found["seconds"] is None
    assert result([take(bag, found=None)], several=True)["frames"] == 0


def test_an_error_is_in_the_result_with_what_is_kept(bag: Path) -> None:
    lost = take(bag, state="lost", error=CameraLostError("l515 vanished: replug it"))
    message = f"l515 vanished: replug it; 30 frames are kept in {bag}"
    assert result([lost], several=False)["error"] == {"type": "CameraLostError", "message": message}
    assert isinstance(ending(lost), CameraLostError)


def test_an_error_says_where_nothing_is_kept(bag: Path) -> None:
    lost = take(bag, state="lost", sets=0, found=None, error=CameraLostError("l515 vanished: replug it"))
    assert str(ending(lost)) == "l515 vanished: replug it; nothing is kept"


def test_an_error_that_says_how_to_get_it_back_stays_as_it_is(bag: Path) -> None:
    full = take(bag, state="disk full", found=None, closed=False, error=DiskFullError("repair it"))
    assert str(ending(full)) == "repair it"


def test_no_error_is_none(bag: Path) -> None:
    assert ending(take(bag, state="interrupted")) is None
    assert "error" not in result([take(bag)], several=False)


def test_a_take_is_told_to_a_person(bag: Path) -> None:
    text = told(take(bag))
    assert "30 frames, 1.0 s, 3 MB, read back whole" in text
    assert "saturated 0.10%, without depth 25.0%, noise in time 1.23 mm" in text
    assert text.endswith(f"wrote {bag}")


def test_a_take_that_ended_early_says_so(bag: Path) -> None:
    assert told(take(bag, state="interrupted")).startswith("interrupted: 30 frames")
    assert told(take(bag, state="interrupted", found=None)).startswith("interrupted: 30 frames came, not read back")
    assert told(take(bag, state="lost", sets=0, found=None)) == "lost before the first frame: nothing is kept"


def test_noise_that_is_unknown_is_told_so(bag: Path) -> None:
    assert "noise in time unknown" in told(take(bag, quality=Quality(1, 0.0, 0.0)))


@pytest.mark.parametrize("takes", [1, 3])
def test_an_interruption_before_the_camera_runs_is_told_with_the_same_fields(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, takes: int
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(capture, "open_camera", interrupted)
    several = ["--takes", str(takes), "--frames", "2"] if takes > 1 else []
    assert main(["capture", "--camera", "sim", "--out", str(tmp_path / "a.bag"), "--json", *several]) == 130
    made = json.loads(capsys.readouterr().out)
    fields = set(result([take(tmp_path / "a.bag")], several=takes > 1))
    assert set(made) == fields
    one = made["takes"][0] if takes > 1 else made
    assert (one["frames"], one["state"], made["frames"]) == (0, "interrupted", 0)
    assert list(tmp_path.iterdir()) == []
