"""TensorBoard logs of a training run; the package `tensorboard` is imported only where they are wanted."""

from pathlib import Path
from typing import Any

from nlos_models.errors import TrainingError


class Board:
    """One event file for each start of a run; what an earlier start logged of these epochs gives way."""

    def __init__(self, folder: Path, epoch: int) -> None:
        try:
            from torch.utils.tensorboard.writer import SummaryWriter
        except ImportError as error:
            raise TrainingError(
                "TensorBoard logs need the package tensorboard: pip install 'nlos-cam[train]', or do without"
            ) from error
        self._writer: Any = SummaryWriter(str(folder / "tensorboard"), purge_step=epoch)

    def add(self, row: dict[str, float]) -> None:
        """One epoch's figures, drawn over the epoch."""
        for name, value in row.items():
            if name != "epoch":
                self._writer.add_scalar(name, value, int(row["epoch"]))
        self._writer.flush()

    def close(self) -> None:
        """End the file."""
        self._writer.close()
