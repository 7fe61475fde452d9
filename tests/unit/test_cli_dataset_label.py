"""`dataset label`: from labelled recordings to a dataset that reads like any other."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import typer

from nlos_cam.cli.dataset import add_label
from nlos_cam.dataset import build
from nlos_cam.errors import OutputExistsError, RecordingError
from nlos_cam.recording.playback import ReplayCamera
from nlos_cam.recording.sidecar import SidecarFile, sidecar_path

Run = Callable[..., dict[str, Any]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    app, group = typer.Typer(), typer.Typer()
    add_label(group)
    group.callback()(lambda: None)
    app.add_typer(group, name="dataset")
    app.callback()(lambda: None)

    def call(*arguments: object) -> dict[str, Any]:
        app(["dataset", "label", *map(str, arguments), "--json"], standalone_mode=False)
        return json.loads(capsys.readouterr().out.splitlines()[-1])

    return call


@pytest.fixture
def recordings(noise_bag: Path, tmp_path: Path) -> Path:
    """Two recordings with a depth map for each, of which one has the label's name."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    for name, label, truth in (("a", "mug", "mug"), ("b", "jug", "b")):
        shutil.copy(noise_bag, bag := folder / f"{name}.bag")
        SidecarFile(sidecar_path(bag), ReplayCamera(bag), label=label)
        np.save(folder / f"{truth}.npy", np.full((64, 64), 0.2 if name == "a" else 0.3, np.float32))
    return folder


def test_it_makes_a_dataset_of_single_frames_and_says_so(run: Run, recordings: Path, tmp_path: Path) -> None:
    told = run(recordings, "--out", out := tmp_path / "data", "--frames", 3)
    maps, plan = build.read(out)
    assert len(maps.image) == told["samples"] == 6
    assert (told["recordings"], told["labels"], told["out"]) == (2, ["jug", "mug"], str(out))
    assert (told["rig_name"], told["rig_checksum"]) == (plan.rig.name, plan.rig.checksum)
    assert [len(np.unique(image)) for image in maps.image] == [1] * 6
    assert maps.image[0, 0, 0] > maps.image[5, 0, 0]


def test_its_shards_have_the_command_that_makes_them(run: Run, recordings: Path, tmp_path: Path) -> None:
    run(recordings, "--out", out := tmp_path / "my data", "--frames", 1)
    with h5py.File(build.open_dataset(out).shards[0].path) as file:
        command = str(file.attrs["command"])
    assert command == f"nlos-cam dataset label {recordings} --out '{out}' --frames 1"


def test_it_replaces_nothing_unless_asked(run: Run, recordings: Path, tmp_path: Path) -> None:
    out = tmp_path / "data"
    run(recordings, "--out", out, "--frames", 2)
    with pytest.raises(OutputExistsError, match="--overwrite"):
        run(recordings, "--out", out, "--frames", 1)
    assert len(build.read(out)[0].image) == 4
    run(recordings, "--out", out, "--frames", 1, "--overwrite")
    assert len(build.read(out)[0].image) == 2


def test_what_is_wrong_with_a_recording_leaves_what_is_there(run: Run, recordings: Path, tmp_path: Path) -> None:
    out = tmp_path / "data"
    run(recordings, "--out", out, "--frames", 1)
    (recordings / "b.npy").unlink()
    with pytest.raises(RecordingError, match="'jug'"):
        run(recordings, "--out", out, "--overwrite")
    assert len(build.read(out)[0].image) == 2
