"""Files of a training run: its last, previous and best state, and its logs.

A state file begins with the SHA-256 of the rest, so that a torn or damaged one is known as such.
"""

import csv
import hashlib
import io
import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, cast

import torch

from nlos_cam.files import TENSOR_LIMIT, TEXT_LIMIT, atomic_file, read_bounded
from nlos_models.errors import CheckpointError, RecipeError, TrainingError
from nlos_models.records import TRAINING_LOG

LAST = "last.ckpt"
PREVIOUS = "previous.ckpt"
BEST = "best.ckpt"
FINISHED = "finished.json"
"""Origin and figures of a run that has ended; its states are gone."""
DIGEST = hashlib.sha256().digest_size

Scores = dict[str, float]
"""Held-out metrics by name."""
State = dict[str, Any]
OnMessage = Callable[[str], None]


def write_last(folder: Path, state: State) -> None:
    """Write the run's last state; the one before it becomes the previous state. Raises
    TrainingError.
    """
    _write(folder / LAST, _pack(state), folder / PREVIOUS)


def write_best(folder: Path, state: State) -> None:
    """Write the run's best state. Raises TrainingError where it cannot be written."""
    _write(folder / BEST, _pack(state))


def write_log(folder: Path, rows: list[Scores]) -> None:
    """Write the whole log, one row per epoch. Raises TrainingError where it cannot be written."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    _write(folder / TRAINING_LOG, text.getvalue().encode())


def has_state(folder: Path) -> bool:
    """Return whether a run in a folder has a state, from which the same command goes on."""
    return any((folder / name).exists() for name in (LAST, PREVIOUS))


def read_last(folder: Path, on_message: OnMessage) -> State | None:
    """Return the newest intact state, or None before the first; a damaged last state is reported
    and skipped.

    Raises CheckpointError where there are states and all of them are damaged.
    """
    # The last state is replaced by a rename, and the one before it is kept: whatever a power cut
    # leaves, one of both is whole.
    damaged: list[Path] = []
    for path in (folder / LAST, folder / PREVIOUS):
        if path.exists():
            if (state := _unpack(path)) is not None:
                if damaged:
                    on_message(
                        f"{damaged[0]} is damaged: resuming from {path.name}, a few minutes earlier"
                    )
                return state
            damaged.append(path)
    if damaged:
        raise CheckpointError(
            f"{' and '.join(map(str, damaged))} damaged: delete {folder}, or choose another --out"
        )
    return None


def read_best(folder: Path) -> State:
    """Return the best state. Raises CheckpointError where it is missing or damaged."""
    state = _unpack(folder / BEST) if (folder / BEST).exists() else None
    if state is None:
        raise CheckpointError(
            f"{folder / BEST} is missing or damaged: train again into another --out"
        )
    return state


def write_finished(folder: Path, origin: str, figures: Scores, parts: Iterable[str] = ()) -> None:
    """Write that the run has ended with these figures, and remove its states, also those in the
    folders `parts`. Its weights have to be saved by then.

    Raises TrainingError where it cannot be written; the states then stay.
    """
    text = json.dumps({"origin": origin, "figures": figures}, indent=2)
    _write(folder / FINISHED, f"{text}\n".encode())
    for part in (folder, *(folder / name for name in parts)):
        for name in (LAST, PREVIOUS, BEST):
            (part / name).unlink(missing_ok=True)


def read_finished(folder: Path, *origins: str | None) -> Scores | None:
    """Return the figures of the run that has ended in a folder, or None where none has.

    Raises RecipeError for a run from none of these origins, CheckpointError for a damaged file.
    """
    path = folder / FINISHED
    if not path.exists():
        return None
    try:
        found = json.loads(read_bounded(path, TEXT_LIMIT))
        figures = {str(name): float(value) for name, value in found["figures"].items()}
        same = found["origin"] in origins
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise CheckpointError(f"{path} is damaged: choose another --out") from error
    if not same:
        raise RecipeError(
            f"{folder} holds a run from other weights or objects: choose another --out"
        )
    return figures


def _pack(state: State) -> bytes:
    # In memory first: the digest has to stand before the content.
    buffer = io.BytesIO()
    torch.save(state, buffer)
    content = buffer.getbuffer()
    return hashlib.sha256(content).digest() + content


def _unpack(path: Path) -> State | None:
    """Return the state in a file, or None where it is none, or its digest does not match. Raises
    CheckpointError where the file cannot be read, which says nothing of the state.
    """
    if not path.is_file():
        return None
    try:
        raw = read_bounded(path, TENSOR_LIMIT)
    except OSError as error:
        raise CheckpointError(
            f"{path} cannot be read ({error.strerror or error}): the same command goes on once it"
            " can"
        ) from error
    if len(raw) < DIGEST or hashlib.sha256(memoryview(raw)[DIGEST:]).digest() != raw[:DIGEST]:
        return None
    try:
        # `weights_only`: a pickle from outside could run any program.
        state = torch.load(io.BytesIO(raw[DIGEST:]), map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception:  # noqa: BLE001  the unpickler raises almost anything for crafted bytes
        return None
    return cast("State", state) if isinstance(state, dict) else None


def _write(path: Path, content: bytes, previous: Path | None = None) -> None:
    """Replace a file, and keep the one before it as `previous`, if given. Raises TrainingError."""
    try:
        with atomic_file(path) as part:
            with part.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())  # what it replaces goes when there is room for the new
            if previous and path.exists():
                path.replace(previous)
    except OSError as error:
        reason = error.strerror or error
        raise TrainingError(
            f"{path} cannot be written ({reason}): free some space and repeat the command, which"
            " resumes the run"
        ) from error


class TensorBoardLog:
    """TensorBoard event file of one start of a run; hides rows that an earlier start logged from
    `epoch` on.

    Starts a writer thread; `fit` closes it. Raises TrainingError without the package tensorboard.
    """

    def __init__(self, folder: Path, epoch: int) -> None:
        try:
            from torch.utils.tensorboard.writer import SummaryWriter
        except ImportError as error:
            raise TrainingError(
                "TensorBoard logs need the package tensorboard: pip install 'nlos-cam[train]', or"
                " drop --tensorboard"
            ) from error
        self._writer: Any = SummaryWriter(str(folder / "tensorboard"), purge_step=epoch)

    def add(self, row: Scores) -> None:
        """Log one epoch's figures."""
        for name, value in row.items():
            if name != "epoch":
                self._writer.add_scalar(name, value, int(row["epoch"]))
        self._writer.flush()

    def close(self) -> None:
        """Close the file and end the writer thread."""
        self._writer.close()
