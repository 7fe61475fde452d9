"""The command `adapt`: up to where its work begins, and what it does with the result."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from made_adaptations import finish_network, job_in
from made_benches import make_bench
from nlos_calibration import load_rig

from nlos_cam import adapt as adaptation
from nlos_cam import bench as benches
from nlos_cam.adapt.plan import Locked, load_plan
from nlos_cam.cli.adapt import MAX_FRAMES, _is_worth_keeping
from nlos_cam.evaluate import TARGETS


@pytest.mark.parametrize(
    ("bench", "why", "code"),
    [
        ("no-such-rig", "no-such-rig", 2),
        ("folder", "folder", 4),
        ("empty.toml", "empty.toml", 4),
        ("record.toml", "record.toml", 4),
    ],
)
def test_what_is_no_bench_is_said_in_one_line(run: Any, bench: str, why: str, code: int) -> None:
    Path("folder").mkdir()
    Path("empty.toml").touch()
    Path("record.toml").write_text("schema_version = 3\n")

    err = run("adapt", bench, code=code).err

    assert why in err
    assert "Traceback" not in err


def test_recording_of_an_unknown_object_is_refused_first(
    run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_bench(Path("bench"))
    recordings = Path("bench/recordings")
    recordings.mkdir()
    for label in ("airplane-1", "bowl-1", "cup"):
        (recordings / f"{label}.bag").touch()
    monkeypatch.setattr(
        "nlos_cam.adapt.recordings.load_sidecar",
        lambda path: SimpleNamespace(label=path.stem, rig=None),
    )
    monkeypatch.setattr(adaptation, "adapt", Mock(side_effect=AssertionError))

    assert "add cup.truth.toml" in run("adapt", "bench", code=4).err


def test_weights_from_elsewhere_are_not_replaced_unasked(run: Any, out: Path) -> None:
    (out / "weights").mkdir(parents=True)
    (out / "weights" / "SHA256SUMS").write_text("somebody's\n")

    assert "--overwrite" in run("adapt", "paper-rig", "--out", out, code=1).err


def test_frames_beyond_those_of_a_plan_are_refused(shown: Any) -> None:
    Locked(frames=MAX_FRAMES)

    assert "--frames" in shown("adapt", "paper-rig", "--frames", MAX_FRAMES + 1, code=2).err


@pytest.mark.parametrize(("after_iou", "kept"), [(0.508, False), (0.677, True), (0.7, True)])
def test_weights_that_are_worse_do_not_replace_those_in_use(
    run: Any, out: Path, monkeypatch: pytest.MonkeyPatch, after_iou: float, kept: bool
) -> None:
    job = job_in(out.with_name("work"), load_rig("paper-rig"))
    finish_network(job.folder)
    plan = load_plan(job.folder)
    assert plan is not None
    before, after = (dict.fromkeys(TARGETS, figure(iou)) for iou in (0.677, after_iou))
    network = job.folder / "stage-1" / "network"
    result = adaptation.AdaptResult(network, plan, [network.parent], before, after, was_there=False)
    monkeypatch.setattr(adaptation, "adapt", Mock(return_value=result))
    monkeypatch.setattr(adaptation, "write_page", Mock())
    out.mkdir()

    answer = run("adapt", "paper-rig", "--out", out)

    assert answer["kept"] == kept
    assert (out / "weights").exists() == kept


@pytest.mark.parametrize(("after_iou", "kept"), [(0.58, False), (0.6, True), (0.62, True)])
def test_a_bench_keeps_the_better_of_two_adaptations(
    monkeypatch: pytest.MonkeyPatch, after_iou: float, kept: bool
) -> None:
    monkeypatch.setattr(benches, "iou_in_use", lambda _: 0.6)
    before, after = (dict.fromkeys(TARGETS, figure(iou)) for iou in (0.55, after_iou))
    result = adaptation.AdaptResult(Path(), Mock(), [], before, after, was_there=False)

    assert _is_worth_keeping(result, Path("bench")) is kept
    assert _is_worth_keeping(result, None)


def test_weights_worse_than_the_shipped_ones_are_not_kept() -> None:
    before, after = (dict.fromkeys(TARGETS, figure(iou)) for iou in (0.5, 0.55))
    result = adaptation.AdaptResult(
        Path(), Mock(), [], before, after, was_there=False, shipped_iou=0.6
    )

    assert not _is_worth_keeping(result, None)
    assert result.shipped_are_better


@pytest.mark.parametrize(("after_iou", "kept"), [(0.45, False), (0.52, True)])
def test_a_fit_to_recordings_may_cost_little_in_simulation(
    monkeypatch: pytest.MonkeyPatch, after_iou: float, kept: bool
) -> None:
    monkeypatch.setattr(benches, "iou_in_use", lambda _: 0.6)
    before, after = (dict.fromkeys(TARGETS, figure(iou)) for iou in (0.55, after_iou))
    judged = [{"silhouette_iou": {"value": iou}} for iou in (0.3, 0.4, 0.5)]
    fit = adaptation.Transfer(Path(), {}, 3, *judged)
    result = adaptation.AdaptResult(
        Path(), Mock(), [], before, after, was_there=False, transfer=fit
    )

    assert _is_worth_keeping(result, Path("bench")) is kept


def figure(value: float) -> dict[str, float]:
    """Return a figure as a report has it."""
    return {"value": value, "low": value, "high": value}
