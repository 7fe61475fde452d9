import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from nlos_cam.camera.recorder import FLUSH_S, FLUSHES, STILL_S, SdkRecorder
from nlos_cam.errors import DiskFullError, RecordingError

UNTIL_THE_LIMIT = """
import importlib.util, resource, sys
from pathlib import Path
sys.path.insert(0, str(Path(sys.argv[1]).parent / "fakes"))
spec = importlib.util.spec_from_file_location("fakes", sys.argv[1])
fakes = importlib.util.module_from_spec(spec)
spec.loader.exec_module(fakes)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
from nlos_cam.errors import DiskFullError
try:
    fakes.record_noise(Path(sys.argv[2]), 200)
except DiskFullError as error:
    print(error)
"""


class FakeRecorder:
    """An `rs.recorder` that writes a file, and takes as long to pause as it is told."""

    def __init__(self, path: str, device: Any) -> None:
        Path(path).write_bytes(b"recorded")
        self.device, self.pauses = device, 0
        self.on_pause: Callable[[], None] = lambda: None

    def pause(self) -> None:
        self.pauses += 1
        self.on_pause()


class FakeTime:
    def __init__(self) -> None:
        self.time_s = 0.0

    def now(self) -> float:
        return self.time_s

    def pass_by(self, seconds: float) -> None:
        self.time_s += seconds


@pytest.fixture
def clock() -> FakeTime:
    return FakeTime()


@pytest.fixture
def made(tmp_path: Path, clock: FakeTime) -> SdkRecorder:
    sdk = SimpleNamespace(recorder=FakeRecorder)
    return SdkRecorder(tmp_path / "a.bag", "device", sdk, now=clock.now)


def test_it_replaces_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    path.write_bytes(b"something else, and longer")
    SdkRecorder(path, "device", SimpleNamespace(recorder=FakeRecorder))
    assert path.read_bytes() == b"recorded"


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be written"):
        SdkRecorder(tmp_path / "no folder" / "a.bag", "device", SimpleNamespace(recorder=FakeRecorder))


def test_closing_pauses_and_lets_go(made: SdkRecorder) -> None:
    fake = made._recorder
    made.close()
    assert fake.pauses == 1
    assert made._recorder is None


def test_it_pauses_again_while_a_slow_disk_is_behind(made: SdkRecorder, clock: FakeTime) -> None:
    fake = made._recorder
    fake.on_pause = lambda: clock.pass_by(FLUSH_S + 1 if fake.pauses < 4 else 1.0)
    made.close()
    assert fake.pauses == 4


def test_a_disk_that_takes_nothing_any_more_is_given_up(made: SdkRecorder, clock: FakeTime) -> None:
    fake = made._recorder
    fake.on_pause = lambda: clock.pass_by(FLUSH_S + 1)
    with pytest.raises(DiskFullError, match="takes nothing any more"):
        made.close()
    assert fake.pauses == FLUSHES


def test_a_file_that_grows_no_more_ends_it_in_one_line(made: SdkRecorder, clock: FakeTime) -> None:
    made.watch()
    clock.pass_by(STILL_S + 1)
    made.watch()
    with pytest.raises(
        DiskFullError, match=r"nothing was written .*nlos-cam repair .*a\.bag --out .*a-repaired\.bag"
    ) as told:
        made.close()
    assert "\n" not in str(told.value)


def test_a_file_that_grows_now_and_then_is_no_failure(made: SdkRecorder, clock: FakeTime) -> None:
    for _ in range(10):
        made.watch()
        clock.pass_by(STILL_S / 2)
        made.watch()
        with made.path.open("ab") as file:
            file.write(b"more")
    made.close()
    assert made.failure is None


def test_no_room_for_the_index_is_found_before_the_sdk_finds_it(
    made: SdkRecorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.camera.recorder.can_grow", lambda *_: False)
    with pytest.raises(DiskFullError, match="no room for its index"):
        made.close()


def whole_chunks(content: bytes) -> int:
    """Chunks of a .bag that are there from end to end: the length of one that is still written reads as 0."""
    at, count = content.index(b"\n") + 1, 0
    while at + 4 <= len(content):
        data = at + 4 + int.from_bytes(content[at : at + 4], "little")
        length = int.from_bytes(content[data : data + 4], "little")
        if b"op=\x05" in content[at:data]:
            if length == 0 or data + 4 + length > len(content):
                break
            count += 1
        at = data + 4 + length
    return count


@pytest.mark.parametrize("limit", [5_000, 1_700_000])
def test_librealsense_at_its_limit_ends_in_one_line_and_keeps_whole_chunks(tmp_path: Path, limit: int) -> None:
    """The limit is the process's own, on the size of files: it fails as a full disk does."""
    pytest.importorskip("resource")
    path = tmp_path / "a.bag"
    arguments = [Path(__file__).parents[1] / "conftest.py", path, str(limit)]
    ended = subprocess.run(  # noqa: PLW1510  the code is what is tested
        [sys.executable, "-c", UNTIL_THE_LIMIT, *arguments], capture_output=True, text=True, timeout=120
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.count("\n") == 1
    assert f"nlos-cam repair {path} --out" in ended.stdout
    assert path.stat().st_size <= limit
    assert whole_chunks(path.read_bytes()) == limit // 800_000
