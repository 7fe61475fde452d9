"""Predicted quality: figures of a frame, fit on known objects, threshold of trust, and the file beside the weights."""

from pathlib import Path

import numpy as np
import pytest
from nlos_models import doubt_training, quality
from nlos_models.doubt_training import QualitySet, families, fit_quality, left_out_folds, trusted_above
from nlos_models.errors import CheckpointError
from nlos_models.inference import UncertaintyEstimate, load_uncertainty_model
from nlos_models.quality import QualityEstimate, QualityModel, QualityRecord, quality_features
from small_doubt import untrained_doubt, watched_weights

pytestmark = pytest.mark.usefixtures("one_thread")
KINDS = ("cup", "bowl", "rods", "blobs", "carved rods", "blobs and rods")


def frames(count: int, seed: int = 0) -> tuple[np.ndarray, UncertaintyEstimate]:
    """Return images of rectangles, and an uncertainty that knows little of them."""
    generator = np.random.default_rng(seed)
    images = np.zeros((count, 64, 64), np.float32)
    for image in images:
        row, column = generator.integers(5, 30, 2)
        image[row : row + 20, column : column + generator.integers(8, 30)] = generator.uniform(0.2, 0.9)
    p, error = (generator.random(images.shape).astype(np.float32) for _ in range(2))
    return images, UncertaintyEstimate(*(generator.random(count).astype(np.float32) for _ in range(2)), error, p)


def known_objects(count: int, best: float = 1.0) -> QualitySet:
    """Return objects whose IoU, up to `best`, is their first figure's, and whose error falls with it."""
    generator = np.random.default_rng(1)
    figures = generator.standard_normal((count, quality.FEATURES)).astype(np.float32)
    iou = best / (1 + np.exp(-2 * figures[:, 0]))
    kind = np.array([KINDS[k % len(KINDS)] for k in range(count)])
    return QualitySet(figures, iou, (0.2 - 0.1 * iou).astype(np.float32), kind, np.arange(count) % len(KINDS) > 1)


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doubt_training, "STEPS", 150)
    monkeypatch.setattr(doubt_training, "FOLDS", 2)


def test_figures_are_those_of_the_mirrored_frame_and_finite_without_a_surface() -> None:
    images, said = frames(4)
    turned = said._replace(error_v=said.error_v[:, ::-1], p_surface=said.p_surface[:, ::-1])
    figures = quality_features(images, said)
    assert figures.shape == (4, quality.FEATURES)
    np.testing.assert_allclose(quality_features(images[:, ::-1], turned), figures, rtol=1e-4, atol=1e-4)
    assert np.isfinite(quality_features(np.zeros_like(images), said)).all()


def test_one_frame_has_the_figures_that_it_has_among_others() -> None:
    images, said = frames(3)
    alone = quality_features(images[1:2], UncertaintyEstimate(*(part[1:2] for part in said)))
    np.testing.assert_allclose(alone[0], quality_features(images, said)[1], rtol=1e-4, atol=1e-5)


def test_figure_that_never_differs_leaves_a_model_that_loads() -> None:
    samples = known_objects(60)
    samples.figures[:, 5] = 1.0
    record = QualityRecord.model_validate_json(fit_quality(samples, "0" * 12).model_dump_json())
    assert min(record.spreads) > 0
    assert np.isfinite(QualityModel(record).outputs(samples.figures)).all()


def test_no_family_is_both_fitted_and_judged_and_every_row_is_judged_once() -> None:
    kinds = [*KINDS, "carved blobs", "cup"]
    judged = list[int]()
    for fitted, rows in left_out_folds(kinds):
        judged += rows.tolist()
        seen = set[str]().union(*(families(kinds[row]) for row in fitted))
        assert not any(min(families(kinds[row])) in seen for row in rows)
    assert sorted(judged) == list(range(len(kinds)))


def test_fit_predicts_the_quality_of_kinds_that_it_never_saw() -> None:
    record = fit_quality(samples := known_objects(600), "0" * 12)
    assert record.figures["all_correlation"] > 0.8
    found = QualityEstimate.of(QualityModel(record).outputs(samples.figures), record.trusted_above)
    assert (np.diff(found.iou, axis=1) >= 0).all()
    assert np.corrcoef(found.error_v, samples.error_v)[0, 1] > 0.3
    assert record.figures["all_trusted_good"] >= quality.PRECISION
    assert found.trusted.any()
    assert (samples.iou[found.trusted] >= quality.GOOD_IOU).mean() >= quality.PRECISION


def test_nothing_is_trusted_where_no_outline_is_good() -> None:
    record = fit_quality(samples := known_objects(200, best=0.7), "0" * 12)
    assert record.trusted_above is None
    assert not QualityEstimate.of(QualityModel(record).outputs(samples.figures), None).trusted.any()


def test_trust_needs_enough_frames_and_precision_in_both_shares() -> None:
    good = np.linspace(0, 1, 1000).astype(np.float32)
    generic = np.arange(1000) % 2 == 0
    above = trusted_above(good, good >= 0.5, generic)
    assert 0.44 < above <= 0.5
    assert trusted_above(good[-10:], good[-10:] > 0, generic[-10:]) is None
    assert trusted_above(good, (good >= 0.5) & ~generic, generic) is None


def record_of(**values: object) -> QualityRecord:
    plain = {"means": [0.0] * quality.FEATURES, "spreads": [1.0] * quality.FEATURES, "objects": 1, "watches": "?"}
    layers = np.zeros((1, quality.FEATURES + 1, 5)).tolist()
    return QualityRecord.model_validate({**plain, "layers": layers, **values})


def test_model_is_bound_to_its_uncertainty_network(tmp_path: Path) -> None:
    untrained_doubt(folder := tmp_path / "run", watched_weights(tmp_path / "watched"))
    assert quality.load_quality_model(folder) is None
    record = record_of(watches=quality.quality_watches(folder))
    quality.write_quality(folder, record)
    loaded = load_uncertainty_model(folder, tmp_path)
    assert loaded.quality.record == record
    assert loaded.quality(*frames(2)).iou == pytest.approx(np.full((2, 3), 0.5))
    text = (folder / quality.QUALITY).read_text()
    for spoiled, reason in ((text[:-9], "damaged"), (text.replace(record.watches, "0" * 12), "damaged")):
        (folder / quality.QUALITY).write_text(spoiled)
        with pytest.raises(CheckpointError, match=reason):
            load_uncertainty_model(folder, tmp_path)
        assert load_uncertainty_model(folder, tmp_path, quality=False).quality is None  # to fit it again


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"watches": "0" * 12}, "another uncertainty network"),
        ({"layers": [[[0.0] * 5] * 3]}, "do not fit"),
        ({"layers": []}, "do not fit"),
        ({"layers": [[[0.0], [0.0, 1.0]]]}, "do not fit"),
        ({"spreads": [0.0] * quality.FEATURES}, "do not fit"),
    ],
)
def test_file_that_does_not_fit_is_refused(tmp_path: Path, values: dict[str, object], reason: str) -> None:
    untrained_doubt(folder := tmp_path / "run", watched_weights(tmp_path / "watched"))
    quality.write_quality(folder, record_of(**{"watches": quality.quality_watches(folder), **values}))
    with pytest.raises(CheckpointError, match=reason):
        quality.load_quality_model(folder)
