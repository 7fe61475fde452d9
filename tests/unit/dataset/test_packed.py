"""Packed maps: as the datasets have them, normalised; they grow between epochs, and an epoch can be seen again."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_farm import samples_of
from nlos_calibration.rig import load_rig
from nlos_models import FileBusyError

from nlos_cam.dataset.packed import CELLS, IMAGES, INDEX, MAPS, PackedMaps, map_noise, open_packed_maps
from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.samples import Samples
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.errors import RecordingError, SceneError

PLAN = DatasetPlan(load_rig("paper-rig"), 0)
SHARD = 5


def _samples(first: int) -> Samples:
    """Return samples of five seeds with maps and images of full size, known from their seed."""
    noise = np.random.default_rng([first, 1])
    sizes = {"depth_m": (64, 80), "intensity": (64, 80), "image": (64, 64)}
    arrays = {name: noise.random((SHARD, *size), np.float32) for name, size in sizes.items()}
    arrays["depth_m"][:, 0, 0] = np.nan
    return {**samples_of(range(first, first + SHARD)), **arrays, "image": arrays["image"].astype(np.float16)}


def _add(folder: Path, first: int, plan: DatasetPlan = PLAN) -> Path:
    folder.mkdir(exist_ok=True)
    store(shard_path(folder, first), _samples(first), plan.provenance, "")
    return folder


def _epoch(packed: PackedMaps, seed: int, batch: int = 2) -> tuple[np.ndarray, np.ndarray]:
    parts = list(packed.batches(batch, torch.Generator().manual_seed(seed)))
    return tuple(np.concatenate([part[k].numpy() for part in parts]) for k in (0, 1))


def test_packed_maps_are_the_datasets_normalised(tmp_path: Path) -> None:
    folders = [_add(tmp_path / "a", 0), _add(tmp_path / "b", 20)]
    with open_packed_maps(folders, tmp_path / "store") as packed:
        assert len(packed) == 2 * SHARD
        wanted = dict[bytes, np.ndarray]()
        for first in (0, 20):
            samples = _samples(first)
            normal = packed.normal(*(torch.from_numpy(samples[name]) for name in ("depth_m", "intensity")))
            normal = normal.half().numpy()
            wanted |= {image.tobytes(): one for image, one in zip(samples["image"], normal, strict=True)}
        maps, images = _epoch(packed, 1)
    assert len({image.tobytes() for image in images}) == 2 * SHARD
    for image, one in zip(images, maps, strict=True):
        np.testing.assert_array_equal(one, wanted[image.tobytes()])


def test_new_shards_enter_new_epochs_and_an_epoch_can_be_seen_again(tmp_path: Path) -> None:
    folder = _add(tmp_path / "a", 0)
    with open_packed_maps([folder], tmp_path / "store") as packed:
        first = _epoch(packed, 1)
        _add(folder, 5)
        assert len(_epoch(packed, 2)[0]) == 10
    with (tmp_path / "store" / MAPS).open("ab") as file:
        file.write(b"left by an interruption")
    with open_packed_maps([folder], tmp_path / "store") as again:
        assert (len(again), again.digest) == (10, packed.digest)
        for one, other in zip(_epoch(again, 1), first, strict=True):
            np.testing.assert_array_equal(one, other)
        assert len(_epoch(again, 3)[0]) == 10


def test_open_packed_maps_refuses_a_store_in_use(tmp_path: Path) -> None:
    folder, store_folder = _add(tmp_path / "a", 0), tmp_path / "store"
    with open_packed_maps([folder], store_folder), pytest.raises(FileBusyError, match="store is being written"):
        open_packed_maps([folder], store_folder).__enter__()
    with pytest.raises(ZeroDivisionError), open_packed_maps([folder], store_folder):
        raise ZeroDivisionError
    with open_packed_maps([folder], store_folder) as packed:  # free again after an error
        assert len(packed) == SHARD


@pytest.mark.parametrize("name", [CELLS, INDEX, MAPS, IMAGES])
def test_damaged_store_is_refused(tmp_path: Path, name: str) -> None:
    folder = _add(tmp_path / "a", 0)
    with open_packed_maps([folder], tmp_path / "store"):
        file = tmp_path / "store" / name
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(RecordingError, match=f"{name} is damaged"):
        open_packed_maps([folder], tmp_path / "store").__enter__()


def test_expected_maps_have_their_noise_to_be_drawn_and_are_not_mixed_with_others(tmp_path: Path) -> None:
    plain, expected = _add(tmp_path / "a", 0), _add(tmp_path / "b", 20, replace(PLAN, expected=True))
    for folder, wanted in ((plain, None), (expected, map_noise(PLAN))):
        with open_packed_maps([folder], tmp_path / f"store of {folder.name}") as packed:
            assert packed.noise == wanted
    with pytest.raises(SceneError, match="give one kind"):
        open_packed_maps([plain, expected], tmp_path / "store").__enter__()


def test_datasets_of_two_rigs_and_too_few_objects_are_refused(tmp_path: Path) -> None:
    folder, store_folder = _add(tmp_path / "a", 0), tmp_path / "store"
    other = DatasetPlan(PLAN.rig.model_copy(update={"name": "bench"}), 0)
    with pytest.raises(SceneError, match="different rigs"):
        open_packed_maps([folder, _add(tmp_path / "b", 0, other)], store_folder).__enter__()
    few = pytest.raises(RecordingError, match="fewer than a batch of 64")
    with open_packed_maps([folder], store_folder) as packed, few:
        next(packed.batches(64, torch.Generator()))
