"""How `render` renders: each option reaches the scene or the setting, and a wrong one is one line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlos_cam.cli.main import main


@pytest.fixture
def plate(tmp_path: Path) -> str:
    depth = np.full((16, 16), np.nan, np.float32)
    depth[4:12, 4:12] = 0.2
    np.save(tmp_path / "plate.npy", depth)
    return str(tmp_path / "plate.npy")


def _rendered(
    plate: str, capsys: pytest.CaptureFixture[str], *options: str
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The result and the file of one rendering of a plate."""
    out = Path(plate).with_name("maps.npz")
    assert main(["render", plate, "--out", str(out), "--overwrite", "--json", *options]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    with np.load(out) as file:
        return result, dict(file)


def _included(result: dict[str, Any]) -> set[str]:
    return {effect["name"] for effect in result["effects"] if effect["included"]}


def test_lambertian_radiometry_is_another_and_is_told(plate: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, paper = _rendered(plate, capsys)
    _, lambertian = _rendered(plate, capsys, "--radiometry", "lambertian")
    assert (str(paper["radiometry"]), str(lambertian["radiometry"])) == ("paper", "lambertian")
    assert lambertian["intensity"].max() > 1.5 * paper["intensity"].max()  # 1/pi in place of 1/(2 pi)


def test_a_material_calls_for_its_brdf_and_an_albedo_darkens(plate: str, capsys: pytest.CaptureFixture[str]) -> None:
    result, _ = _rendered(
        plate, capsys, "--material", "phong", "--specular", "0.3", "--exponent", "4", "--accuracy", "draft"
    )
    assert "brdf" in _included(result)
    _, black = _rendered(plate, capsys, "--albedo", "0")
    _, white = _rendered(plate, capsys, "--albedo", "1")
    assert (white["intensity"] > black["intensity"]).any()


def test_three_albedos_give_colour(plate: str, capsys: pytest.CaptureFixture[str]) -> None:
    result, file = _rendered(plate, capsys, "--albedo", "0.9,0.5,0.1")
    assert "colour" in _included(result)
    assert file["colour"].shape == (64, 80, 3)
    assert (file["colour"][..., 0] >= file["colour"][..., 2]).all()
    assert (file["colour"][..., 0] > file["colour"][..., 2]).any()


def test_effects_are_those_asked_for(plate: str, capsys: pytest.CaptureFixture[str]) -> None:
    result, file = _rendered(plate, capsys, "--effects", "three-bounce")
    assert _included(result) & {"direct", "occluder", "three-bounce"} == {"three-bounce"}
    assert (file["intensity"] > 0).any()


def test_a_pulse_and_more_beams_reach_the_rendering(plate: str, capsys: pytest.CaptureFixture[str]) -> None:
    plain, sharp = _rendered(plate, capsys)
    wide, blurred = _rendered(plate, capsys, "--pulse-ns", "1")
    assert "pulse" in _included(wide) - _included(plain)
    assert not np.array_equal(sharp["intensity"], blurred["intensity"])
    _, finer = _rendered(plate, capsys, "--beams-per-cell", "2")
    assert not np.array_equal(sharp["intensity"], finer["intensity"])


@pytest.mark.parametrize("bound", [["--max-error", "0.9"], ["--max-seconds", "1000"]])
def test_a_bound_chooses_the_accuracy(plate: str, capsys: pytest.CaptureFixture[str], bound: list[str]) -> None:
    result, _ = _rendered(plate, capsys, *bound)
    assert result["accuracy"] in {"draft", "standard", "fine", "reference"}
    if bound[0] == "--max-seconds":
        assert result["accuracy"] == "reference"  # all the time in the world


@pytest.mark.parametrize(
    ("options", "code", "told"),
    [
        (["--radiometry", "magic"], 1, "radiometry 'magic'"),
        (["--material", "glass"], 2, "kind"),
        (["--albedo", "1.5"], 2, "albedo: must lie in 0 to 1"),
        (["--albedo", "white"], 2, "albedo 'white'"),
        (["--exponent", "0"], 2, "exponent"),
        (["--pulse-ns", "-1"], 1, "pulse_ns is -1"),
        (["--effects", "rain"], 1, "no effect 'rain'"),
        (["--beams-per-cell", "0"], 1, "beams_per_cell is 0"),
        (["--backend", "abacus"], 1, "no backend 'abacus'"),
        (["--max-error", "-1"], 1, "max_error is -1"),
        (["--max-error", "0.1", "--accuracy", "fine"], 2, "leave out --accuracy"),
    ],
)
def test_what_is_wrong_is_one_line(
    plate: str, capsys: pytest.CaptureFixture[str], options: list[str], code: int, told: str
) -> None:
    out = Path(plate).with_name("maps.npz")
    assert main(["render", plate, "--out", str(out), *options]) == code
    shown = capsys.readouterr().err.strip()
    assert told in shown
    assert len(shown.splitlines()) == 1
    assert not out.exists()
