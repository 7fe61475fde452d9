"""Measured light of two public sets, where $NLOS_CAM_MEASURED names their folder."""

import importlib
import os
import sys
from pathlib import Path
from types import ModuleType

import pytest

TOOLS = Path(__file__).parents[2] / "tools" / "studies"


@pytest.fixture
def data() -> Path:
    folder = Path(os.environ.get("NLOS_CAM_MEASURED", ""))
    if not (folder / "tmf8828_u.npz").is_file():
        pytest.skip("the measured sets are not here: set NLOS_CAM_MEASURED to their folder")
    return folder


@pytest.fixture
def reality(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(TOOLS))
    assert str(TOOLS) in sys.path
    return importlib.import_module("reality")


@pytest.mark.parametrize("name", ["E", "K", "Y", "Mannequin", "Mannequin_Assymetric"])
def test_measured_arrivals_fit_within_six_bins(data: Path, reality: ModuleType, name: str) -> None:
    scan = reality.read_scan(data / f"keyhole_{name}.npz")
    model = reality.arrival_model(name, 0.6, scan.bin_s)

    assert reality.rms(reality.fit_offsets(scan, model)[1]) < 6


def test_measured_ratio_is_a_thousandth(data: Path, reality: ModuleType) -> None:
    zones = reality.read_zones(data / "tmf8828_u.npz")
    found = reality.percentiles(reality.measured_ratio(zones))

    assert found["median"] == pytest.approx(1.1e-3, rel=0.15)
    assert found["p90"] == pytest.approx(2.9e-3, rel=0.15)
