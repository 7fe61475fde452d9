"""Adaptation to locked differences, in the small."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from made_adaptations import job_in
from nlos_calibration import load_rig
from nlos_models import load_network

from nlos_cam.adapt import Locked, Stage, adapt
from nlos_cam.adapt.plan import load_plan
from nlos_cam.errors import SceneError
from nlos_cam.render import SensorModel

LOCKED = Locked(frames=9000)
FEW = 16


def guess_alone(_weights: Path | None, folder: Path, _objects: Path | None) -> None:
    """Measure nothing but the guess."""
    folder.mkdir(exist_ok=True)
    (folder / "figures.json").write_text(json.dumps({"baselines": {"mean_object": {"iou": 0.4}}}))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_network_is_trained_on_locked_differences(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.adapt.run.HELD_OUT_OBJECTS", FEW)
    monkeypatch.setattr("nlos_cam.adapt.plan.BATCH", FEW)
    job = job_in(tmp_path / "work", load_rig("paper-rig"))
    job = replace(job, locked=LOCKED, sensor=SensorModel(pulse_ns=1.0))
    plan = load_plan(job.folder)
    assert plan is not None
    stage = Stage(minutes=1.0, objects=100, epochs=1, steps=1)
    update = {"locked": LOCKED, "sensor": job.sensor, "stages": (stage,)}
    plan.model_copy(update=update).save(job.folder)

    result = adapt(job, 1.0, guess_alone)

    network, record = load_network(result.weights)
    assert result.before == {"iou": 0.4}
    assert float(network.normal.median.abs().max()) == 0
    assert float(network.normal.spread[0].median()) < 1e-4  # micrometers, not the wall's depth
    assert record.rig_checksum != job.rig.checksum


def test_other_locked_differences_are_refused(tmp_path: Path) -> None:
    job = job_in(tmp_path / "work", load_rig("paper-rig"))

    with pytest.raises(SceneError, match="--frames"):
        adapt(replace(job, locked=LOCKED), 1.0, guess_alone)
