"""The study of doubt: its figures are right where the answer is known."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from fake_doubter import FakeDoubter
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import load_rig

from nlos_cam.dataset.doubt_samples import EMPTY, DoubtSamples
from nlos_cam.dataset.outliers import TO_JUDGE, TO_LEARN
from nlos_cam.objects.depth_map import depth_from_image, object_box
from nlos_cam.reconstruct.verdict import Verdict

RIG = load_rig("paper-rig")


@pytest.fixture
def study(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("doubt_study")


def half(*_: object) -> Float32:
    return np.full((1, 64, 64), 0.5, np.float32)


def test_a_share_lies_in_its_interval_which_narrows_with_the_number(study: ModuleType) -> None:
    few, many = study.wilson(1, 10), study.wilson(100, 1000)
    assert few["low"] < few["share"] == many["share"] < few["high"]
    assert few["high"] - few["low"] > 3 * (many["high"] - many["low"])
    assert study.wilson(0, 50)["low"] == 0.0 < study.wilson(0, 50)["high"] < 0.1


def test_uncertainty_that_is_laplaces_is_reliable_and_covers_what_it_states(study: ModuleType) -> None:
    generator = np.random.default_rng(0)
    expected = generator.uniform(0.005, 0.05, 100_000)
    observed = np.abs(generator.laplace(0.0, expected))
    for row in study.reliability(expected, observed):
        assert row["observed_mm"] == pytest.approx(row["expected_mm"], rel=0.05)
    for row in study.coverage(expected, observed):
        assert row["observed"] == pytest.approx(row["level"], abs=0.01)
    assert study.coverage(expected, 3 * observed)[0]["observed"] < 0.3


def test_rank_correlation_is_of_ranks(study: ModuleType) -> None:
    values = np.arange(10.0)
    assert study.rank_correlation(values, np.exp(values)) == pytest.approx(1.0)
    assert study.rank_correlation(values, -(values**3)) == pytest.approx(-1.0)


def test_errors_are_of_pixels_that_both_have(study: ModuleType) -> None:
    pipeline = study.Pipeline(RIG, half, FakeDoubter(error_v=0.2))
    told = pipeline.tell(np.full((64, 80), 0.3, np.float32), np.ones((64, 80), np.float32))
    truth = np.zeros((1, 64, 64), np.float32)
    truth[0, 0, :3] = 0.6
    expected, observed = study.errors_of([told], depth_from_image(truth, object_box(RIG)))
    np.testing.assert_allclose(expected, 0.2 * 0.28 / 0.9 * np.ones(3), rtol=1e-5)
    np.testing.assert_allclose(observed, 0.1 * 0.28 / 0.9 * np.ones(3), rtol=1e-4)


def test_only_outliers_that_can_be_seen_count_as_missed(study: ModuleType) -> None:
    pipeline = study.Pipeline(RIG, half, FakeDoubter(lambda depth_m, *_: (0.0, float(depth_m[0, 0, 0]))))
    told = [pipeline.tell(np.full((64, 80), p, np.float32), np.ones((64, 80), np.float32)) for p in (0.9, 0.1, 0.1)]
    found = study.of_outliers(told, np.array([100, 100, 0]))
    assert (found["flagged"]["count"], found["flagged"]["of"]) == (1, 2)
    assert (found["believed"], found["cannot_be_seen"]) == (2, 1)
    assert found["verdicts"] == {Verdict.SEEN.value: 2, Verdict.OUTSIDE.value: 1}


def test_kinds_are_counted_by_what_is_unlike_in_them(study: ModuleType) -> None:
    def kind(count: int, of: int) -> dict[str, object]:
        return {"flagged": study.wilson(count, of)}

    found = study.flagged_by_sort(
        {"small": kind(9, 10), "posts": kind(1, 10)}, {"two tone": kind(3, 10), "rings": {"flagged": None}}
    )
    counts = {name: (one["count"], one["of"]) for name, one in found.items()}
    assert counts == {
        "learnt_flagged": (10, 20),
        "never_learnt_flagged": (3, 10),
        "learnt_out_of_range_flagged": (9, 10),
        "out_of_range_flagged": (12, 20),
        "unlike_in_shape_flagged": (1, 10),
    }


def test_the_plot_is_a_picture(tool: Callable[[str], ModuleType], tmp_path: Path) -> None:
    rows = {
        "reliability": [{"expected_mm": 1.0, "observed_mm": 2.0}],
        "coverage": [{"level": 0.5, "observed": 0.4}],
        "surface": [{"expected": 0.5, "observed": 0.6}],
    }
    path = tmp_path / "images" / "reliability.png"
    tool("doubt_pictures").draw_reliability(path, {"test_objects": rows, "held_out_objects": rows})
    assert path.read_bytes().startswith(b"\x89PNG")


def test_kinds_are_told_apart_and_an_empty_bench_that_shows_is_a_false_object(
    study: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    def samples(_: Path, wanted: dict[str, int], *__: object, **___: object) -> DoubtSamples:
        ((kind, count),) = wanted.items()
        level = 0.9 if kind in TO_LEARN else 0.1
        depth_m = np.full((count, 64, 80), 0.0 if kind == EMPTY else level, np.float32)
        depth_m[: count // 2] *= kind != EMPTY
        depth_m[0] += 0.01 * (kind == EMPTY)
        truth = np.full((count, 64, 64), 0.5, np.float16)
        return DoubtSamples(depth_m, depth_m, truth, np.full(count, 99, np.int32), np.array([kind] * count))

    def says(depth_m: np.ndarray, *_: np.ndarray) -> tuple[float, float]:
        level = float(depth_m[0, 0, 0])
        return (1.0 if level == 0 else 0.0), level

    usual = samples(Path(), {"ordinary": 6})
    monkeypatch.setattr(study, "samples_on_disk", samples)
    monkeypatch.setattr(study.dataset, "open_dataset", lambda _: type("Data", (), {"arrays": lambda _: usual})())
    monkeypatch.setattr(study, "test_set", lambda _: [])
    monkeypatch.setattr(study, "echoes_of", lambda *_: [])
    monkeypatch.setattr(study, "sense", lambda *_: [usual_maps() for _ in range(3)])
    monkeypatch.setattr(study, "truth_of", lambda *_: np.full((3, 64, 64), 0.6, np.float32))
    pipeline = study.Pipeline(RIG, half, FakeDoubter(says))
    result = study.study(pipeline, Path(), Path(), 4, 10, 2)
    assert result["empty"]["false_objects"]["count"] == 1
    assert result["learnt_flagged"]["share"] == 1.0
    assert result["never_learnt_flagged"]["share"] == 0.0
    assert set(result["never_learnt"]) == set(TO_JUDGE)
    assert result["held_out_objects"]["told_outside"]["of"] == 4


def usual_maps() -> object:
    from nlos_cam.frames import LidarMaps

    level = np.full((64, 80), 0.1, np.float32)
    return LidarMaps(level, level, np.ones((64, 80), np.bool_))
