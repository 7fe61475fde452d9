"""A doubt network goes with the weights that it was trained to watch, and with no others."""

from pathlib import Path

import pytest
import torch
from nlos_models.doubt_checkpoint import DOUBT_RECORD, WATCHED, checksum_of_watched, load_doubt, save_doubt
from nlos_models.errors import CheckpointError
from small_doubt import untrained_doubt, watched_weights


@pytest.fixture
def watched(tmp_path: Path) -> Path:
    return watched_weights(tmp_path / "watched")


def test_what_is_saved_is_loaded_in_eval_mode(tmp_path: Path, watched: Path) -> None:
    record = untrained_doubt(tmp_path / "run", watched)
    loaded = load_doubt(tmp_path / "run")
    assert loaded is not None
    told, found = loaded
    assert found == record
    assert not told.training
    assert told.temperature.tolist() == [0.5, 2.0]
    assert float(told.error_scale) == 1.5


def test_the_folder_of_a_run_holds_the_weights_that_are_watched_too(tmp_path: Path, watched: Path) -> None:
    untrained_doubt(tmp_path / "run", watched)
    for name in (*WATCHED, "checkpoint.json"):
        assert (tmp_path / "run" / name).read_bytes() == (watched / name).read_bytes()


def test_it_is_within_its_size(tmp_path: Path, watched: Path) -> None:
    untrained_doubt(tmp_path / "run", watched)
    assert (tmp_path / "run" / "doubt.safetensors").stat().st_size < 700_000


def test_weights_without_doubt_have_none(watched: Path) -> None:
    assert load_doubt(watched) is None


@pytest.mark.parametrize("name", WATCHED)
def test_other_weights_beside_it_are_refused(tmp_path: Path, watched: Path, name: str) -> None:
    untrained_doubt(tmp_path / "run", watched)
    (tmp_path / "run" / name).write_bytes(b"another network")
    with pytest.raises(CheckpointError, match=r"is of other weights .* train it again with `train doubt`, or take it"):
        load_doubt(tmp_path / "run")


def test_weights_that_changed_meanwhile_are_not_given_a_doubt(tmp_path: Path, watched: Path) -> None:
    record = untrained_doubt(tmp_path / "run", watched)
    loaded = load_doubt(tmp_path / "run")
    assert loaded is not None
    (watched / WATCHED[0]).write_bytes(b"another network")
    with pytest.raises(CheckpointError, match="changed while its doubt was trained"):
        save_doubt(tmp_path / "other", loaded[0].network, record, watched)


@pytest.mark.parametrize("text", ["{", '{"watches": "x"}', "\xff"])
def test_a_damaged_record_is_told_of_by_name(tmp_path: Path, watched: Path, text: str) -> None:
    untrained_doubt(tmp_path / "run", watched)
    (tmp_path / "run" / DOUBT_RECORD).write_bytes(text.encode("latin-1"))
    with pytest.raises(CheckpointError, match=DOUBT_RECORD):
        load_doubt(tmp_path / "run")


def test_the_bare_wall_keeps_its_precision(tmp_path: Path, watched: Path) -> None:
    record = untrained_doubt(tmp_path / "first", watched)
    loaded = load_doubt(tmp_path / "first")
    assert loaded is not None
    network, wall_m = loaded[0].network, 0.3 + 1e-4 * torch.rand(5, 64, 80)
    network.learn_bare(wall_m, wall_m)
    save_doubt(tmp_path / "second", network, record, watched)
    again = load_doubt(tmp_path / "second")
    assert again is not None
    torch.testing.assert_close(again[0].network.bare_depth_m, wall_m.median(0).values, rtol=0, atol=0)


def test_a_folder_without_weights_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="compressor"):
        checksum_of_watched(tmp_path)
