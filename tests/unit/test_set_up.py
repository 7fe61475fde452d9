"""Networks on a bench: what is made of frames, and what does not fit."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_wall import RIG, measured_wall

from nlos_cam.reconstruct import pipeline as module
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.reconstruct.pipeline import load_networks, misfits, set_up

DOUBTER: Any = object()


def trained(rig_name: str = RIG.name, rig_checksum: str = RIG.checksum, eats: str = "raw maps") -> Any:
    return SimpleNamespace(rig_name=rig_name, rig_checksum=rig_checksum, input=eats)


def test_networks_of_this_very_rig_fit() -> None:
    assert misfits(CalibratedRig(RIG), trained(), DOUBTER) == []


def test_a_bench_that_stands_elsewhere_is_told_by_what_differs() -> None:
    farther = RIG.model_copy(update={"lidar": RIG.lidar.model_copy(update={"distance_m": 0.3})})
    (told,) = misfits(CalibratedRig(farther), trained(), DOUBTER)
    assert told.startswith("unlike the rig of the networks, this one has")
    assert "they err more" in told


@pytest.mark.parametrize(("checksum", "told"), [(RIG.checksum, 0), ("0" * 12, 1)])
def test_a_rig_that_is_not_at_hand_is_known_by_its_checksum(checksum: str, told: int) -> None:
    found = misfits(CalibratedRig(RIG), trained("a rig of somebody else's", checksum), DOUBTER)
    assert len(found) == told
    assert all("trained for another rig" in one for one in found)


def test_a_record_without_its_reference_is_told(tmp_path: Path) -> None:
    measured = measured_wall(tmp_path)
    assert not any("no reference" in told for told in misfits(CalibratedRig(RIG, measured), trained(), DOUBTER))
    assert any(
        "no reference" in told
        for told in misfits(CalibratedRig(RIG, replace(measured, reference=None)), trained(), DOUBTER)
    )


def test_weights_that_tell_no_doubt_are_told() -> None:
    (told,) = misfits(CalibratedRig(RIG), trained(), None)
    assert "no uncertainty is told" in told


@pytest.mark.parametrize("eats", ["raw maps", "difference maps"])
def test_networks_are_fed_what_they_eat(tmp_path: Path, eats: str) -> None:
    network: Any = SimpleNamespace(record=trained(eats=eats))
    processing = set_up(CalibratedRig(RIG, measured_wall(tmp_path)), network, average=7)
    assert processing.network is network
    assert processing._eats_difference is (eats == "difference maps")
    assert len(processing._mean._last) == 7


def test_networks_are_exported_into_the_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[Any] = []
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path))
    monkeypatch.setattr(module, "load_reconstructor", lambda *given: asked.append(given) or np)
    assert load_networks(Path("mine")) is np
    assert asked == [(Path("mine"), tmp_path / "onnx")]
