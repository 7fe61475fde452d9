"""A run's files: whole or not there, the one before where the last is damaged, and what a full disk leaves."""

import copy
import errno
import os
from pathlib import Path
from typing import NoReturn

import pytest
import torch
from nlos_models.errors import CheckpointError, TrainingError
from nlos_models.train import (
    BEST,
    LAST,
    LOG,
    PREVIOUS,
    digest_of,
    read_best,
    read_last,
    write_best,
    write_last,
    write_log,
)


def _state(step: int) -> dict[str, object]:
    return {"step": step, "module": {"weight": torch.arange(4.0) + step}, "rows": [{"loss": float(step)}]}


def _silent(line: str) -> None:
    pytest.fail(line)


def _harm(path: Path, how: str) -> None:
    raw = bytearray(path.read_bytes())
    if how == "cut":
        raw = raw[: len(raw) // 2]
    if how == "flipped":
        raw[-20] ^= 1
    path.write_bytes(b"" if how == "empty" else raw)


def test_there_is_no_state_before_the_first(tmp_path: Path) -> None:
    assert read_last(tmp_path, _silent) is None


def test_the_last_state_comes_back_and_the_one_before_is_kept(tmp_path: Path) -> None:
    for step in range(3):
        write_last(tmp_path, _state(step))
    state = read_last(tmp_path, _silent)
    assert state is not None
    assert (state["step"], state["rows"]) == (2, [{"loss": 2.0}])
    assert torch.equal(state["module"]["weight"], torch.arange(4.0) + 2)
    assert {path.name for path in tmp_path.iterdir()} == {LAST, PREVIOUS}


@pytest.mark.parametrize("how", ["cut", "flipped", "empty"])
def test_a_damaged_last_state_is_told_of_and_the_previous_taken(tmp_path: Path, how: str) -> None:
    write_last(tmp_path, _state(1))
    write_last(tmp_path, _state(2))
    _harm(tmp_path / LAST, how)
    told: list[str] = []
    state = read_last(tmp_path, told.append)
    assert state is not None
    assert state["step"] == 1
    assert len(told) == 1
    assert told[0].startswith(f"{tmp_path / LAST} is damaged: going on from {PREVIOUS}")


def test_a_kill_between_the_two_renames_leaves_the_previous_state(tmp_path: Path) -> None:
    write_last(tmp_path, _state(1))
    (tmp_path / LAST).replace(tmp_path / PREVIOUS)
    state = read_last(tmp_path, _silent)
    assert state is not None
    assert state["step"] == 1


def test_two_damaged_states_are_one_line(tmp_path: Path) -> None:
    for step in range(2):
        write_last(tmp_path, _state(step))
    for name in (LAST, PREVIOUS):
        _harm(tmp_path / name, "flipped")
    with pytest.raises(CheckpointError, match="damaged: delete") as caught:
        read_last(tmp_path, _silent)
    assert caught.value.exit_code == 4
    assert "\n" not in str(caught.value)


def test_a_full_disk_is_one_line_and_what_was_there_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_last(tmp_path, _state(1))
    write_log(tmp_path, [{"loss": 1.0}])

    def full(file: int) -> NoReturn:
        raise OSError(errno.ENOSPC, "No space left on device", str(file))

    monkeypatch.setattr(os, "fsync", full)
    for write in (lambda: write_last(tmp_path, _state(2)), lambda: write_log(tmp_path, [{"loss": 2.0}])):
        with pytest.raises(TrainingError, match=r"cannot be written \(No space left on device\): make room"):
            write()
    state = read_last(tmp_path, _silent)
    assert state is not None
    assert state["step"] == 1
    assert {path.name for path in tmp_path.iterdir()} == {LAST, LOG}
    assert "1.0" in (tmp_path / LOG).read_text(encoding="utf-8")


def test_the_best_state_comes_back_and_a_missing_or_damaged_one_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="missing or damaged"):
        read_best(tmp_path)
    write_best(tmp_path, _state(3))
    assert read_best(tmp_path)["step"] == 3
    _harm(tmp_path / BEST, "cut")
    with pytest.raises(CheckpointError, match="missing or damaged"):
        read_best(tmp_path)


def test_the_log_is_a_table_with_a_row_an_epoch(tmp_path: Path) -> None:
    write_log(tmp_path, [{"epoch": 0, "loss": 2.5}])
    write_log(tmp_path, [{"epoch": 0, "loss": 2.5}, {"epoch": 1, "loss": 1.5}])
    assert (tmp_path / LOG).read_text(encoding="utf-8").splitlines() == ["epoch,loss", "0,2.5", "1,1.5"]


def test_a_digest_is_of_every_bit_of_what_a_run_sets_out_from() -> None:
    torch.manual_seed(0)
    net, words = torch.nn.Linear(3, 2), {digest_of(), digest_of("a"), digest_of("b"), digest_of(None)}
    words.add(before := digest_of(net))
    assert digest_of(copy.deepcopy(net)) == before
    net.bias.data[0] += 1e-3
    words |= {digest_of(net), digest_of(net, "a"), digest_of("a", net), digest_of(torch.nn.Linear(3, 2).half())}
    assert len(words) == 9
