"""Report of an adaptation: learning curves, and what more minutes would bring."""

import re
from pathlib import Path
from typing import Any

import pytest
from made_adaptations import job_in
from nlos_calibration import load_rig

from nlos_cam.adapt import AdaptResult, Tables, Transfer, write_page
from nlos_cam.adapt.plan import load_plan
from nlos_cam.adapt.report import MIN_EPOCHS, Curve, gain_by_doubling, outlook, read_curves
from nlos_cam.evaluate import TARGETS
from nlos_cam.report import figure_of, png

GAIN = 0.02
"""Rise of the IoU at twice the samples."""


def curve_of(doublings: list[float], iou: float = 0.5) -> Curve:
    """Return a curve that rises by GAIN with each doubling of 1,000 samples."""
    samples = [round(1000 * 2**each) for each in doublings]
    return Curve(samples, [iou + GAIN * each for each in doublings])


def test_a_curve_has_the_samples_of_the_stages_before(tmp_path: Path) -> None:
    job_in(tmp_path / "work", load_rig("paper-rig"))
    plan = load_plan(tmp_path / "work")
    assert plan is not None
    two = plan.model_copy(update={"stages": (*plan.stages, *plan.stages)})
    log = tmp_path / "log.csv"
    log.write_text("epoch,held_out_iou\n0,0.5\n1,0.6\n", encoding="utf-8")

    first, second = read_curves(two, [log, log])

    assert first.samples[-1] == plan.stages[0].samples
    assert second.samples == [first.samples[-1] + each for each in first.samples]
    assert second.iou == [0.5, 0.6]


@pytest.mark.parametrize(
    "content",
    ["", "epoch,held_out", "epoch,held_out_iou\n0,0.5\n", "epoch,held_out_iou\n0,0.5\n1,0."],
)
def test_a_damaged_log_has_no_curve_and_is_named(tmp_path: Path, content: str) -> None:
    """Its last row would pass for the end of the stage."""
    result = result_in(tmp_path / "work")
    (result.folders[0] / "network" / "log.csv").write_text(content, encoding="utf-8")

    write_page(result, Tables([]), [], tmp_path / "page.html", kept=True)

    text = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert "log.csv is damaged: stage 1" in text
    assert f"{result.plan.stages[0].samples}" in text
    assert "Too few epochs" in text


def test_the_gain_of_one_stage_is_its_late_slope() -> None:
    doublings = [k / 4 for k in range(MIN_EPOCHS)]

    assert gain_by_doubling([curve_of(doublings)]) == pytest.approx(GAIN, rel=0.01)
    assert gain_by_doubling([curve_of(doublings[1:])]) is None
    assert gain_by_doubling([]) is None


def test_the_gain_of_two_stages_is_between_their_ends() -> None:
    assert gain_by_doubling([curve_of([0, 1]), curve_of([2, 3])]) == pytest.approx(GAIN)


def test_a_stage_of_few_samples_says_nothing_of_the_gain() -> None:
    """One minute after ten: its chance would count seven times."""
    first = curve_of([k / 4 for k in range(MIN_EPOCHS)])
    few = Curve([round(1.1 * first.samples[-1])], [first.iou[-1] - 0.01])

    assert gain_by_doubling([first, few]) == pytest.approx(GAIN, rel=0.01)


@pytest.mark.parametrize(
    ("expected_iou", "forecast"),
    [(None, ""), (0.52, ""), (0.9, "The forecast for this bench is 0.90. ")],
)
def test_the_outlook_is_the_curve_after_a_far_forecast(
    tmp_path: Path, expected_iou: float | None, forecast: str
) -> None:
    job_in(tmp_path / "work", load_rig("paper-rig"))
    plan = load_plan(tmp_path / "work")
    assert plan is not None
    curves = [curve_of([0, 1]), curve_of([2, 3])]

    advice = outlook(plan, curves, 0.5, expected_iou)

    by_curve = "2 minutes in all would bring about +0.020 of IoU, by the learning curve."
    assert advice == forecast + by_curve


def figures_of(iou: float) -> dict[str, Any]:
    """Return figures as a report of weights has them."""
    return {name: {"value": iou, "low": iou, "high": iou} for name in TARGETS}


def result_in(folder: Path) -> AdaptResult:
    """Return the result of an adaptation with a fit to recordings, and what its page shows."""
    job_in(folder, load_rig("paper-rig"))
    plan = load_plan(folder)
    assert plan is not None
    stage = folder / "stage-1"
    fitted = stage / "recordings-0"
    for part in (stage / "network", fitted / "report", fitted / "after"):
        part.mkdir(parents=True)
        (part / "sheet.png").write_bytes(png(figure_of(1.0, 1.0)))
    log = stage / "network" / "log.csv"
    log.write_text("epoch,held_out_iou\n0,0.5\n1,0.6\n", encoding="utf-8")
    parts = {"adaptation": ["bowl"], "validation": ["hat"], "judged": ["cup"]}
    fit = Transfer(fitted, parts, 3, *map(figures_of, (0.3, 0.4, 0.5)))
    return AdaptResult(
        fitted / "weights",
        plan,
        [stage],
        figures_of(0.55),
        figures_of(0.6),
        was_there=False,
        transfer=fit,
    )


@pytest.mark.parametrize("kept", [True, False])
def test_the_page_says_which_weights_are_in_use(tmp_path: Path, kept: bool) -> None:
    result = result_in(tmp_path / "work")
    rows = [("silhouette IoU", "0.550", "0.600")]

    write_page(result, Tables(rows, rows), ["nlos-cam live"], tmp_path / "page.html", kept=kept)

    text = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert "0.550 -> 0.600" in text
    assert ("the weights in use stay" in text) is not kept
    assert "fitted to recordings of 1 objects: silhouette IoU 0.400 -> 0.500" in text
    pictures = re.findall(r"\]\((.*png)\)", text)
    assert len(pictures) == 2
    assert all((tmp_path / picture).is_file() for picture in pictures)
