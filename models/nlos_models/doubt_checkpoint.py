"""Files of an uncertainty ("doubt") network beside the weights that it watches."""

import json
import shutil
from pathlib import Path

from nlos_models.checkpoint import load_part, save_parts
from nlos_models.doubt_network import CalibratedDoubt, DoubtNetwork
from nlos_models.errors import CheckpointError
from nlos_models.records import (
    DOUBT,
    DOUBT_RECORD,
    RECORD,
    DoubtRecord,
    checksum_of_watched,
    load_doubt_record,
    watched_files,
)


def save_doubt(folder: Path, network: DoubtNetwork, record: DoubtRecord, watched: Path) -> None:
    """Write an uncertainty network and its record into a folder, with a copy of the watched weights from elsewhere."""
    if checksum_of_watched(watched) != record.watches:
        raise CheckpointError(f"{watched} changed during the training of its uncertainty network: train again")
    text = json.dumps(record.model_dump(mode="json"), indent=2)
    save_parts(folder, {DOUBT: network}, {DOUBT_RECORD: text})
    if folder.resolve() != watched.resolve():
        for name in (*watched_files(watched), RECORD):
            shutil.copyfile(watched / name, folder / name)


def load_doubt(folder: Path) -> tuple[CalibratedDoubt, DoubtRecord] | None:
    """Return the calibrated uncertainty network beside a pipeline's weights in eval mode, or None where there is none.

    Raises CheckpointError where it cannot be read or watches other weights.
    """
    if (record := load_doubt_record(folder)) is None:
        return None
    network = DoubtNetwork()
    load_part(folder / f"{DOUBT}.safetensors", network)
    return CalibratedDoubt(network, record.temperatures, record.error_scale).eval(), record
