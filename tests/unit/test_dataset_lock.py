"""One builder to a folder, told by its process; who died holds nothing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock

from nlos_cam.dataset.shards import LOCK, NOTE, only_builder
from nlos_cam.errors import FolderBusyError, OutputExistsError

HOLD = """
import sys
from filelock import FileLock
lock = FileLock(sys.argv[1])
lock.acquire()
print("held", flush=True)
input()
"""


def test_the_lock_is_held_once_and_says_by_whom(tmp_path: Path) -> None:
    with only_builder(tmp_path):
        with pytest.raises(FolderBusyError, match=rf"process {os.getpid()} on .*choose another --out"):
            only_builder(tmp_path).__enter__()
        assert str(os.getpid()) in (tmp_path / NOTE).read_text(encoding="utf-8")
    assert not (tmp_path / NOTE).exists()


def test_it_is_free_again_after_an_error(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), only_builder(tmp_path):
        raise ZeroDivisionError
    with only_builder(tmp_path):
        pass


def test_the_lock_of_a_killed_process_is_taken_over(tmp_path: Path) -> None:
    (tmp_path / NOTE).write_text("process 1 on elsewhere", encoding="utf-8")
    command = [sys.executable, "-c", HOLD, str(tmp_path / ".build.lock")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(FolderBusyError, match="process 1 on elsewhere"), only_builder(tmp_path):
            pass
        holder.kill()
    with only_builder(tmp_path):
        assert str(os.getpid()) in (tmp_path / NOTE).read_text(encoding="utf-8")


def test_a_folder_that_may_not_be_written_to_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(_: FileLock, **__: object) -> None:
        raise PermissionError(13, "Permission denied", str(tmp_path / LOCK))

    monkeypatch.setattr(FileLock, "acquire", refused)
    with pytest.raises(OutputExistsError, match=f"{tmp_path} cannot be written to"), only_builder(tmp_path):
        pass
