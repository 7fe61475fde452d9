"""Storage of trained weights in a byte each, for weights that ship."""

import json
from pathlib import Path

import torch
from safetensors.torch import save

from nlos_cam.files import atomic_directory, write_checked
from nlos_models.byte_weights import SCALE, fits_bytes, to_bytes
from nlos_models.checkpoint import FULL, read_tensors, save_parts, stored_tensors
from nlos_models.quality import UNCERTAINTY_FILES, load_quality_model
from nlos_models.records import (
    UNCERTAINTY_RECORD,
    checksum_of_watched,
    load_uncertainty_record,
    watched_files,
)
from nlos_models.training.checkpoints import copy_weights
from nlos_models.training.quality import write_quality


def store_in_bytes(folder: Path) -> None:
    """Store the large weights of a folder's image networks in a byte each, unless they are.

    The uncertainty network and the quality model beside them are tied to the new bytes as they are:
    rounding changes the pictures that they judge less than noise does. All files change in one step,
    so that an interrupted call may be repeated. Raises CheckpointError, OSError, FileBusyError.
    """
    with atomic_directory(folder) as part:
        copy_weights(folder, part)
        _store_in_bytes(part)


def _store_in_bytes(folder: Path) -> None:
    uncertainty = load_uncertainty_record(folder)
    quality = load_quality_model(folder)
    # Both are read before the first file changes: afterwards they watch weights that are gone.
    for name in watched_files(folder):
        write_checked(folder, {name: _in_bytes(folder / name)})

    if uncertainty:
        tied = uncertainty.model_copy(update={"watches": checksum_of_watched(folder)})
        text = json.dumps(tied.model_dump(mode="json"), indent=2)
        save_parts(folder, {}, {UNCERTAINTY_RECORD: text})
    # The quality model watches the uncertainty network's record, which has just been written.
    if quality:
        watches = checksum_of_watched(folder, UNCERTAINTY_FILES)
        write_quality(folder, quality.record.model_copy(update={"watches": watches}))


def _in_bytes(path: Path) -> bytes:
    """Return a file of tensors whose large weights are in bytes, with their scales; normalizations
    stay in full.
    """
    found = stored_tensors(path)
    full = read_tensors(path)
    stored = dict[str, torch.Tensor]()
    for name, weight in full.items():
        in_full = name.rpartition(".")[2] in FULL
        if weight.is_floating_point() and not in_full and fits_bytes(tuple(weight.shape)):
            in_bytes, scale = to_bytes(weight.numpy())
            stored[name] = torch.from_numpy(in_bytes)
            stored[name + SCALE] = torch.from_numpy(scale)
        else:
            stored[name] = weight if in_full else found[name]
    return save(stored)
