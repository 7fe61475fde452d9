"""Index of a packed store: its shards, the objects of each epoch, and the datasets and the rig that
its maps are of.
"""

import hashlib
import json
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from nlos_calibration import Rig

from nlos_cam.dataset.plan import RECORDED, DatasetPlan
from nlos_cam.dataset.reader import MAP_CHANNELS, Dataset
from nlos_cam.dataset.shards import Shard, open_shard
from nlos_cam.errors import RecordingError, SceneError
from nlos_cam.files import atomic_file, read_bounded, read_hdf5_text

INDEX = "index.json"
INDEX_LIMIT = 1 << 26
"""Bytes of the index: some hundred thousand shards."""
DIGITS = 16


class Origin(NamedTuple):
    """Rig and data that a store was begun with."""

    rig: str
    """Name of the rig that the maps are aligned with."""
    rig_checksum: str
    plan: str
    """Plan of the first dataset, as JSON."""
    first: str
    """`shard_key` of that dataset's first shard: the cells' statistics are of it, too."""

    @classmethod
    def of(cls, maps_rig: Rig, dataset: Dataset) -> "Origin":
        """Return the origin of a store that is begun now."""
        first = dataset.shards[0]
        return cls(maps_rig.name, maps_rig.checksum, first.provenance, shard_key(first))

    def is_aligned_with(self, maps_rig: Rig) -> bool:
        """Return True if the maps are aligned with a rig."""
        return self.rig_checksum == maps_rig.checksum

    def differences(self, plan: DatasetPlan) -> list[str]:
        """Return the names of the fields in which the first dataset's plan differs from another."""
        try:
            return DatasetPlan.from_provenance(self.plan).differences(plan)
        except ValueError:  # of a newer nlos-cam
            return ["plan"]


@dataclass
class StoreIndex:
    """Index of a store, as it is in the file INDEX."""

    store: Path
    shards: dict[str, int] = field(default_factory=dict)
    """Number of packed objects of each shard, by its `shard_key`."""
    epochs: dict[str, int] = field(default_factory=dict)
    """Number of objects that each epoch sees."""
    origin: Origin | None = None
    """None for a store that is new, or was written by nlos-cam 0.2.0 or earlier."""
    sizes: dict[str, int] = field(default_factory=dict)
    """Number of objects of each shard when it was packed, also of those that cannot be aligned;
    stores of earlier versions lack it.
    """

    def lacks(self, key: str, size: int) -> bool:
        """Return whether objects of a shard of `size` are not packed yet."""
        return self.sizes.get(key, self.shards.get(key, 0)) < size

    @classmethod
    def read(cls, store: Path) -> "StoreIndex":
        """Read the index of a store; a new one is empty. Raises RecordingError where it is
        damaged.
        """
        if not (store / INDEX).exists():
            return cls(store)
        try:
            found = json.loads(read_bounded(store / INDEX, INDEX_LIMIT))
            origin = found.get("origin")
            return cls(
                store,
                _counts(found["shards"]),
                _counts(found["epochs"]),
                origin and Origin(*(str(origin[name]) for name in Origin._fields)),
                _counts(found.get("sizes", {})),
            )
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise damaged(store, INDEX) from error

    def write(self) -> None:
        """Write the index to its store."""
        facts: dict[str, Any] = {
            "shards": self.shards,
            "epochs": self.epochs,
            "sizes": self.sizes,
        }
        if self.origin:
            facts["origin"] = self.origin._asdict()
        with atomic_file(self.store / INDEX) as part:
            part.write_text(json.dumps(facts), encoding="utf-8")

    def open_for(
        self, maps_rig: Rig, datasets: Sequence[Dataset], keys: Mapping[Path, str]
    ) -> None:
        """Begin a new store, or go on with one whose maps are of these datasets, aligned with the
        rig `maps_rig`; `keys` are the `shard_key` of their shards, by path.

        A store of nlos-cam 0.2.0 or earlier does not say what it is aligned with. If its shards are
        those of the datasets, by their paths, it is taken for this one's. Raises SceneError for a
        store of other maps.
        """
        if self.origin is None:
            by_path = {str(path.resolve()): key for path, key in keys.items()}
            self.shards = {by_path.get(name, name): count for name, count in self.shards.items()}
            origin = Origin.of(maps_rig, datasets[0])
        else:
            origin = self.origin
        if not origin.is_aligned_with(maps_rig):
            raise SceneError(
                f"{self.store} holds maps aligned with rig {origin.rig} ({origin.rig_checksum}),"
                f" not with {maps_rig.name} ({maps_rig.checksum}): name another --store"
            )
        here = set(keys.values())
        if missing := [key for key in (origin.first, *self.shards) if key not in here]:
            raise SceneError(
                f"{self.store} holds maps packed from other data than {datasets[0].folder}"
                f" ({_reason(origin, datasets, missing)}): name another --store, or delete this one"
            )
        if self.origin is None:
            self.origin = origin
            self.write()


def shard_key(shard: Shard) -> str:
    """Return the key of a shard's samples, which does not depend on the folder: a digest, and the
    shard's name.

    The digest is that of the plan, which decides rendered samples; for recordings it covers the
    checksums of the samples too.
    """
    digest = hashlib.sha256(shard.provenance.encode())
    if _is_recorded(shard.provenance):
        with open_shard(shard.path) as file:
            for name in MAP_CHANNELS:
                digest.update(read_hdf5_text(file[name], "sha256", "").encode())
    return f"{digest.hexdigest()[:DIGITS]}/{shard.path.name}"


def data_key(dataset: Dataset) -> str:
    """Return the key of a dataset's samples, which does not depend on the folder: its plan, and for
    recordings, which no plan decides, the keys of its shards.
    """
    keys = map(shard_key, dataset.shards) if dataset.plan.accuracy == RECORDED else ()
    return "\n".join([dataset.plan.provenance, *keys])


@lru_cache(maxsize=8)
def _is_recorded(provenance: str) -> bool:
    return DatasetPlan.from_provenance(provenance).accuracy == RECORDED


def _reason(origin: Origin, datasets: Sequence[Dataset], missing: Sequence[str]) -> str:
    """Return in what a store's data differ from datasets."""
    differences = [origin.differences(dataset.plan) for dataset in datasets]
    if all(differences):
        return f"the plans differ in: {', '.join(differences[0])}"
    return f"{missing[0].rpartition('/')[2]} is another one there, or missing"


def _counts(found: Mapping[str, Any]) -> dict[str, int]:
    return {str(key): operator.index(found[key]) for key in found}


def damaged(store: Path, name: str) -> RecordingError:
    """Return the error for a file of a store that cannot be read."""
    return RecordingError(
        f"{store / name} is damaged: delete {store}, the packed maps are then made again"
    )
