"""The files of a training run: checkpoints that a kill at any moment leaves whole, and the log."""

import csv
import hashlib
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import nn

from nlos_models.errors import CheckpointError, TrainingError

LAST, PREVIOUS, BEST, LOG = "last.ckpt", "previous.ckpt", "best.ckpt", "log.csv"
DIGEST = hashlib.sha256().digest_size

State = dict[str, Any]
Tell = Callable[[str], None]


def write_last(folder: Path, state: State) -> None:
    """Make this the run's last state; the one that was last becomes the previous. Raises TrainingError."""
    part = _write(folder / LAST, _packed(state))
    if (folder / LAST).exists():
        (folder / LAST).replace(folder / PREVIOUS)
    part.replace(folder / LAST)


def write_best(folder: Path, state: State) -> None:
    """Make this the run's best state. Raises TrainingError where it cannot be written."""
    _write(folder / BEST, _packed(state)).replace(folder / BEST)


def write_log(folder: Path, rows: list[dict[str, float]]) -> None:
    """The whole log, one row an epoch. Raises TrainingError where it cannot be written."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    _write(folder / LOG, text.getvalue().encode()).replace(folder / LOG)


def read_last(folder: Path, tell: Tell) -> State | None:
    """The last state that is whole, None before the first; a damaged one is told of, and the previous taken.

    Raises CheckpointError where there are states, and none of them is whole.
    """
    damaged: list[Path] = []
    for path in (folder / LAST, folder / PREVIOUS):
        if path.exists():
            if (state := _unpacked(path)) is not None:
                if damaged:
                    tell(f"{damaged[0]} is damaged: going on from {path.name}, a few minutes earlier")
                return state
            damaged.append(path)
    if damaged:
        raise CheckpointError(f"{' and '.join(map(str, damaged))} damaged: delete {folder}, or choose another --out")
    return None


def read_best(folder: Path) -> State:
    """The best state. Raises CheckpointError where it is damaged or not there."""
    state = _unpacked(folder / BEST) if (folder / BEST).exists() else None
    if state is None:
        raise CheckpointError(f"{folder / BEST} is missing or damaged: train again into another --out")
    return state


def digest_of(*parts: nn.Module | str | None) -> str:
    """A word for networks, down to their last bit, and whatever else a run sets out from."""
    digest = hashlib.sha256()
    for part in parts:
        tensors = part.state_dict() if isinstance(part, nn.Module) else {str(part): torch.zeros(0)}
        for name, tensor in tensors.items():
            digest.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _packed(state: State) -> bytes:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    content = buffer.getbuffer()
    return hashlib.sha256(content).digest() + content


def _unpacked(path: Path) -> State | None:
    """None where the file is not what was written."""
    raw = path.read_bytes()
    if len(raw) < DIGEST or hashlib.sha256(memoryview(raw)[DIGEST:]).digest() != raw[:DIGEST]:
        return None
    return torch.load(io.BytesIO(raw[DIGEST:]), map_location="cpu", weights_only=True)


def _write(path: Path, content: bytes) -> Path:
    """A file beside `path`, on the disk and whole, that is to be renamed to it."""
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        part.unlink(missing_ok=True)
        reason = error.strerror or error
        raise TrainingError(f"{path} cannot be written ({reason}): make room and train again, it goes on") from error
    return part
