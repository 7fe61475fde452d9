"""Datasets that may grow while a training run reads them, and the shards that they hold by now."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nlos_calibration import Rig

from nlos_cam.dataset.build import SHARD
from nlos_cam.dataset.packed_index import shard_key
from nlos_cam.dataset.plan import DatasetPlan, RigSpread
from nlos_cam.dataset.reader import Dataset, check_held_out, open_dataset
from nlos_cam.dataset.rig_range import RigRange
from nlos_cam.dataset.shards import SHARD_PATTERN, read_head
from nlos_cam.errors import SceneError
from nlos_cam.render import Material, SensorModel


@dataclass(frozen=True)
class FoundShard:
    """Shard of a dataset, as it is now."""

    path: Path
    key: str
    """Its `shard_key`."""
    objects: int
    """Number of its objects."""


class GrowingDatasets:
    """Training datasets of one rig and kind, to which builders may add shards and seeds meanwhile.

    Objects that are held out are compared with all of theirs, also with those that appear later.
    """

    def __init__(
        self, folders: Sequence[Path], *, color: bool = False, locked: bool = False
    ) -> None:
        """Open the datasets.

        Datasets of locked differences are refused unless `locked`. Raises RecordingError where a
        folder is not a dataset, SceneError for datasets of two kinds, and for maps in color of more
        than one rig.
        """
        opened = [
            open_dataset(folder, color=color, expected=True, locked=locked) for folder in folders
        ]
        _check_of_one_kind(opened)
        self.plan: DatasetPlan = opened[0].plan
        """Of the first dataset."""
        if color and self.plan.spread != RigSpread():
            raise SceneError(
                f"{folders[0]} varies the rig, but maps in color are not aligned: build it without"
                " a spread"
            )
        self.opened = opened
        """The datasets, as they were found."""
        self._color = color
        self._locked = locked
        self._held_out: Dataset | None = None
        there = [shard for dataset in opened for shard in dataset.shards]
        self._found = {
            shard.path: FoundShard(shard.path, shard_key(shard), len(shard.seeds))
            for shard in there
        }

    @property
    def keys(self) -> dict[Path, str]:
        """The `shard_key` of every shard found so far, by its path."""
        return {path: shard.key for path, shard in self._found.items()}

    def shards(self, first: int | None = None) -> list[FoundShard]:
        """Return the shards that are there now, or the `first` of them.

        Raises SceneError where one that is new, or has grown, holds held-out objects.
        """
        paths = [
            path for dataset in self.opened for path in sorted(dataset.folder.glob(SHARD_PATTERN))
        ]
        return [self._look_at(path) for path in paths[:first]]

    def _look_at(self, path: Path) -> FoundShard:
        """Return a shard as it is now. Its head is read until it is full, its key once."""
        known = self._found.get(path)
        if known and known.objects >= SHARD:
            return known

        head = read_head(path)
        has_new = known is None or len(head.seeds) > known.objects
        if self._held_out and has_new:
            check_held_out(Dataset(path.parent, head.plan, (head,)), self._held_out)
        key = known.key if known else shard_key(head)
        self._found[path] = FoundShard(path, key, len(head.seeds))
        return self._found[path]

    def hold_out(self, folder: Path) -> Dataset:
        """Open a dataset of objects that must not be among those of training. Raises SceneError
        where they are.
        """
        opened = open_dataset(folder, color=self._color, locked=self._locked)
        for training in self.opened:
            check_held_out(training, opened)
        self._held_out = opened
        return opened


def _check_of_one_kind(opened: Sequence[Dataset]) -> None:
    """Raise SceneError for datasets of two rigs or sensors, or with and without noise."""
    first = opened[0]
    for other in opened[1:]:
        both = f"{other.folder} and {first.folder}"
        if _rigs_of(other.plan) != _rigs_of(first.plan):
            raise SceneError(f"{both} were rendered for different rigs: give datasets of one")
        if other.plan.expected != first.plan.expected:
            raise SceneError(f"of {both} one holds expected maps, without noise: give one kind")
        # the noise that training adds is that of one sensor
        if _light_of(other.plan) != _light_of(first.plan):
            raise SceneError(
                f"{both} differ in sensor, radiometry or material: give datasets of one kind"
            )


def _light_of(plan: DatasetPlan) -> tuple[SensorModel, str, Material]:
    return plan.sensor, plan.radiometry, plan.material


def _rigs_of(plan: DatasetPlan) -> tuple[Rig, RigRange | None]:
    return plan.rig, plan.rigs
