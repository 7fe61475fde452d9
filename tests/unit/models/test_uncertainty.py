"""Uncertainty network: features, training, calibration, predicted quality, and files
beside the weights.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from fake_uncertainty import RECIPE, FakeUncertainty
from nlos_models import load_uncertainty_model, quality, records, uncertainty_network
from nlos_models.errors import CheckpointError
from nlos_models.inference import UncertaintyEstimate
from nlos_models.quality import QualityEstimate, QualityModel, QualityRecord, quality_features
from nlos_models.records import UncertaintyRecord
from nlos_models.training import quality as quality_training
from nlos_models.training import uncertainty
from nlos_models.training.quality import (
    QualitySet,
    can_leave_out,
    families,
    fit_quality,
    left_out_folds,
    trusted_above,
)
from nlos_models.uncertainty_network import (
    MAX_ERROR_V,
    MIN_ERROR_V,
    CalibratedUncertainty,
    UncertaintyNetwork,
    UncertaintyOutput,
)
from pydantic import ValidationError
from small_maps import HARD_MAPS, hard_maps, noise_maps
from small_uncertainty import DARK_V, small_uncertainty_set, untrained_uncertainty, watched_weights

from nlos_cam.files import TEXT_LIMIT, checksums_of, read_checked

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def network() -> UncertaintyNetwork:
    torch.manual_seed(0)
    return UncertaintyNetwork().eval().requires_grad_(requires_grad=False)


def test_features_are_zero_at_the_median_bare_wall(
    network: UncertaintyNetwork,
) -> None:
    generator = torch.Generator().manual_seed(0)
    bare_m = torch.rand(64, 80, generator=generator)
    counts = 40 * torch.rand(64, 80, generator=generator)
    depth_m = bare_m.repeat(5, 1, 1)
    depth_m[0] = bare_m + 0.3
    depth_m[1, 0, 0] = torch.nan
    network.learn_bare(depth_m, counts.repeat(5, 1, 1))

    assert float(network.features(bare_m[None], counts[None]).abs().max()) == 0.0
    assert float(network.features(bare_m[None] + 0.05, counts[None] + 5)[:, :4].min()) > 0.4


def test_bare_light_of_a_cell_is_that_of_the_benches_that_see_it(
    network: UncertaintyNetwork,
) -> None:
    depth_m = torch.ones(5, 64, 80)
    counts = torch.full((5, 64, 80), 20.0)
    depth_m[:3, 2, 7] = torch.nan  # as on the wall grid: three benches of five do not see the cell
    counts[:3, 2, 7] = 0.0
    network.learn_bare(depth_m, counts)

    assert float(network.bare_intensity[2, 7]) == 20.0


def test_features_mark_a_cell_without_return(network: UncertaintyNetwork) -> None:
    depth_m = torch.ones(1, 64, 80)
    depth_m[0, 3, 4] = torch.nan
    features = network.features(depth_m, torch.full((1, 64, 80), 9.0))

    assert features[0, :, 3, 4].tolist() == [0, 0, 0, 0, 1]


@pytest.mark.parametrize("name", HARD_MAPS)
@pytest.mark.parametrize("v", [0.0, 1.0])
def test_uncertainty_of_hard_maps_is_finite_and_in_range(
    network: UncertaintyNetwork, name: str, v: float
) -> None:
    calibrated = CalibratedUncertainty(network, (1.0, 2.0), 3.0).eval()
    nothing, outside, error_v, surface = calibrated(*hard_maps(name), torch.full((1, 64, 64), v))
    for probability in (nothing, outside, surface):
        assert bool(((probability >= 0) & (probability <= 1)).all())

    assert float(error_v.min()) >= MIN_ERROR_V
    assert float(error_v.max()) <= MAX_ERROR_V
    assert error_v.shape == surface.shape == (1, 64, 64)


def test_calibration_scales_error_and_divides_logits(network: UncertaintyNetwork) -> None:
    maps = hard_maps("saturated")
    image = torch.full((1, 64, 64), 0.5)
    plain, scaled = (
        CalibratedUncertainty(network, t, s).eval()(*maps, image)
        for t, s in (((1, 1), 1), ((2, 4), 1.5))
    )

    torch.testing.assert_close(scaled[2], 1.5 * plain[2])

    for one, other, divisor in zip(plain[:2], scaled[:2], (2.0, 4.0), strict=True):
        torch.testing.assert_close(torch.logit(other) * divisor, torch.logit(one))


QUICK = RECIPE.model_copy(
    update={
        "objects": 128,
        "epochs": 8,
        "batch": 16,
        "learning_rate": 5e-3,
        "schedule": "one-cycle",
    }
)


def _train(folder: Path) -> UncertaintyNetwork:
    return uncertainty.train_uncertainty(
        QUICK, small_uncertainty_set(128, 0), small_uncertainty_set(32, 1), folder
    )[0]


@pytest.mark.slow
def test_uncertainty_run_learns_what_is_empty_or_unusual(tmp_path: Path) -> None:
    trained = _train(tmp_path)
    fresh = small_uncertainty_set(64, 2)
    said = uncertainty.predict(trained, fresh)

    assert ((said.nothing.numpy() > 0) == fresh.nothing).mean() > 0.9

    there = ~fresh.nothing

    assert np.corrcoef(said.outside.numpy()[there], fresh.outside[there])[0, 1] > 0.8

    dark, bright = (
        said.log_error.numpy()[fresh.truth == value].mean() for value in np.float16([DARK_V, 0.8])
    )

    assert dark > bright + 0.3


@pytest.mark.slow
def test_calibration_keeps_to_its_shares_of_false_alarms(tmp_path: Path) -> None:
    trained = _train(tmp_path)
    some = small_uncertainty_set(200, 3)
    fitted = uncertainty.calibrate(trained, some)
    said = uncertainty.predict(trained, some)
    nothing, outside = (
        torch.sigmoid(part / t).numpy()
        for part, t in zip(said[:2], fitted.temperatures, strict=True)
    )
    usual = ~some.nothing & ~some.outside

    assert (
        outside[usual] > fitted.outside_above + 1e-6
    ).mean() <= uncertainty.MAX_FALSE_ALARMS + 1 / usual.sum()
    assert (nothing[some.nothing] < fitted.nothing_above).mean() <= 1 / some.nothing.sum()
    assert fitted.nothing_above <= 0.5
    assert fitted.error_scale > 0


def test_loss_is_least_at_the_mean_error_of_shared_pixels() -> None:
    some = small_uncertainty_set(64, 0)
    there, empty = (
        uncertainty.as_uncertainty_batch(some.where(rows)) for rows in (~some.nothing, some.nothing)
    )

    def loss(batch: uncertainty.UncertaintyBatch, log_error: float) -> float:
        flat = torch.zeros(len(batch.made))
        pixels = torch.zeros_like(batch.made)
        return float(
            uncertainty.uncertainty_loss(
                UncertaintyOutput(flat, flat, pixels + log_error, pixels), batch
            )
        )

    shared = (there.truth > 0) & (there.made > 0)
    mean = float((there.made - there.truth).abs()[shared].mean().log())

    assert loss(there, mean) < min(loss(there, mean - 0.2), loss(there, mean + 0.2))
    assert loss(empty, -3.0) == loss(empty, 1.0)

    made = np.array([[[0.5, 0.5], [0.0, 0.0]]])
    truth = np.array([[[0.25, 0.0], [0.5, 0.0]]])
    known, error = uncertainty.shared_errors(made, truth)

    assert known.tolist() == [[[True, False], [False, False]]]
    assert error.tolist() == [0.25]


def test_uncertainty_batches_mirror_maps_with_their_images() -> None:
    some = small_uncertainty_set(32, 0)
    batch = next(iter(uncertainty.uncertainty_batches(some, 32, torch.Generator().manual_seed(0))))

    assert sorted(batch.nothing.tolist()) == sorted(some.nothing.astype(float).tolist())

    bright = (batch.intensity[:, :, 8:72] > 12).float()

    torch.testing.assert_close(bright, (batch.truth > 0).float())
    torch.testing.assert_close((batch.made > 0).float(), bright)


@pytest.mark.parametrize(("factor", "unit"), [(0.25, 1.0), (1.0, 1.0), (8.0, 1.0), (1.0, 1000.0)])
def test_error_scale_undoes_factor_in_any_unit(factor: float, unit: float) -> None:
    expected = np.random.default_rng(1).uniform(0.01, 0.2, 20_000)
    error = np.abs(np.random.default_rng(0).laplace(0.0, expected))
    scale = uncertainty.error_scale(expected, error)

    assert factor * uncertainty.error_scale(
        factor * unit * expected, unit * error
    ) == pytest.approx(scale)
    assert scale == pytest.approx(1.0, rel=0.03)


def test_error_scale_without_an_error_is_one() -> None:
    """That of weights whose images miss every truth: NaN would make a record that nothing reads."""
    assert uncertainty.error_scale(np.zeros(0), np.zeros(0)) == 1.0


@pytest.mark.parametrize("true", [1.0, 2.0, 3.0])
def test_temperature_finds_overconfidence(true: float) -> None:
    generator = np.random.default_rng(3)
    logits = generator.normal(0.0, 2.0, 50_000)
    truth = generator.random(50_000) < 1 / (1 + np.exp(-logits))

    assert uncertainty.temperature(true * logits, truth) == pytest.approx(true, rel=0.1)
    assert uncertainty.temperature(np.where(truth, 9.0, -9.0), truth) == 1.0  # separable


@pytest.fixture
def watched(tmp_path: Path) -> Path:
    return watched_weights(tmp_path / "watched")


@pytest.fixture
def record(tmp_path: Path, watched: Path) -> UncertaintyRecord:
    return untrained_uncertainty(tmp_path / "run", watched)


def test_uncertainty_network_is_restored_with_its_weights(
    tmp_path: Path, watched: Path, record: UncertaintyRecord
) -> None:
    network, found = uncertainty_network.load_uncertainty_network(tmp_path / "run")

    assert found == record
    assert not network.training
    assert network.temperature.tolist() == [0.5, 2.0]
    assert float(network.error_scale) == 1.5
    assert (tmp_path / "run" / "doubt.safetensors").stat().st_size < 700_000

    for name in (*records.WATCHED, "checkpoint.json"):
        assert (tmp_path / "run" / name).read_bytes() == (watched / name).read_bytes()

    assert uncertainty_network.load_uncertainty_network(watched) is None
    assert load_uncertainty_model(watched, tmp_path) is None

    with pytest.raises(CheckpointError, match="compressor"):
        records.checksum_of_watched(tmp_path)


@pytest.mark.parametrize("temperature", [0.0, -1.0, np.nan])
def test_temperature_that_is_not_positive_is_refused(temperature: float) -> None:
    facts = FakeUncertainty().record.model_dump()
    with pytest.raises(ValidationError, match="temperatures"):
        UncertaintyRecord.model_validate(facts | {"temperatures": (temperature, 1.0)})


@pytest.mark.usefixtures("record")
@pytest.mark.parametrize(
    ("name", "content"),
    [
        *((name, b"another") for name in records.WATCHED),
        *((records.UNCERTAINTY_RECORD, text) for text in (b"{", b'{"watches": "x"}', b"\xff")),
    ],
)
def test_uncertainty_network_refuses_other_weights_or_record(
    tmp_path: Path, name: str, content: bytes
) -> None:
    (tmp_path / "run" / name).write_bytes(content)
    with pytest.raises(CheckpointError, match=records.UNCERTAINTY_RECORD):
        uncertainty_network.load_uncertainty_network(tmp_path / "run")


def test_saved_bare_wall_is_exact_and_watched_weights_stay(
    tmp_path: Path, watched: Path, record: UncertaintyRecord
) -> None:
    network = uncertainty_network.load_uncertainty_network(tmp_path / "run")[0].network
    wall_m = 0.3 + 1e-4 * torch.rand(5, 64, 80)
    network.learn_bare(wall_m, wall_m)
    uncertainty_network.save_uncertainty_network(tmp_path / "second", network, record, watched)
    again = uncertainty_network.load_uncertainty_network(tmp_path / "second")[0].network

    torch.testing.assert_close(again.bare_depth_m, wall_m.median(0).values, rtol=0, atol=0)

    (watched / records.WATCHED[0]).write_bytes(b"another network")

    with pytest.raises(CheckpointError, match="watched"):
        uncertainty_network.save_uncertainty_network(tmp_path / "other", network, record, watched)


@pytest.mark.usefixtures("record")
def test_copies_of_watched_weights_have_checksums(tmp_path: Path, watched: Path) -> None:
    sums = checksums_of(tmp_path / "run")

    for name in (*records.WATCHED, records.RECORD):
        content = read_checked(tmp_path / "run" / name, TEXT_LIMIT)
        assert content == (watched / name).read_bytes()
        assert name in sums


@pytest.mark.slow
def test_uncertainty_onnx_equals_torch_and_is_exported_once(
    tmp_path: Path, record: UncertaintyRecord
) -> None:
    folder = tmp_path / "run"
    cache = tmp_path / "cache"
    uncertainty_model = load_uncertainty_model(folder, cache)
    (model,) = cache.glob("doubt-*.onnx")
    written_ns = model.stat().st_mtime_ns
    again = load_uncertainty_model(folder, cache)

    assert again.record == uncertainty_model.record == record
    assert model.stat().st_mtime_ns == written_ns

    for count in (1, 5):
        seen = *noise_maps(count), np.random.default_rng(count).random((count, 64, 64), np.float32)
        with torch.inference_mode():
            theirs = uncertainty_network.load_uncertainty_network(folder)[0](
                *(torch.from_numpy(part) for part in seen)
            )
        for mine, its in zip(again(*seen), theirs, strict=True):
            assert mine.shape == tuple(its.shape)
            np.testing.assert_allclose(mine, its, rtol=1e-3, atol=1e-5)


KINDS = ("cup", "bowl", "rods", "blobs", "carved rods", "blobs and rods")


def frames(count: int, seed: int = 0) -> tuple[np.ndarray, UncertaintyEstimate]:
    """Return images of rectangles, and an uncertainty that knows little of them."""
    generator = np.random.default_rng(seed)
    images = np.zeros((count, 64, 64), np.float32)
    for image in images:
        row, column = generator.integers(5, 30, 2)
        image[row : row + 20, column : column + generator.integers(8, 30)] = generator.uniform(
            0.2, 0.9
        )
    p, error = (generator.random(images.shape).astype(np.float32) for _ in range(2))
    return images, UncertaintyEstimate(
        *(generator.random(count).astype(np.float32) for _ in range(2)), error, p
    )


def known_objects(count: int, best: float = 1.0) -> QualitySet:
    """Return objects whose IoU, up to `best`, is their first figure's, and whose error falls with
    it.
    """
    generator = np.random.default_rng(1)
    figures = generator.standard_normal((count, quality.FEATURES)).astype(np.float32)
    iou = best / (1 + np.exp(-2 * figures[:, 0]))
    kind = np.array([KINDS[k % len(KINDS)] for k in range(count)])
    return QualitySet(
        figures, iou, (0.2 - 0.1 * iou).astype(np.float32), kind, np.arange(count) % len(KINDS) > 1
    )


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quality_training, "MIN_STEPS", 150)
    monkeypatch.setattr(quality_training, "FOLDS", 2)


def test_figures_are_those_of_the_mirrored_frame() -> None:
    images, said = frames(4)
    turned = said._replace(error_v=said.error_v[:, ::-1], p_surface=said.p_surface[:, ::-1])
    figures = quality_features(images, said)

    assert figures.shape == (4, quality.FEATURES)
    np.testing.assert_allclose(
        quality_features(images[:, ::-1], turned), figures, rtol=1e-4, atol=1e-4
    )


def test_figures_of_a_frame_are_those_of_the_frame_alone() -> None:
    images, said = frames(4)
    figures = quality_features(images, said)
    alone = quality_features(images[1:2], UncertaintyEstimate(*(part[1:2] for part in said)))

    np.testing.assert_allclose(alone[0], figures[1], rtol=1e-4, atol=1e-5)


def test_figures_with_the_network_s_own_surface_come_last() -> None:
    images, said = frames(4)
    figures = quality_features(images, said)
    with_own = quality_features(images, said, said.p_surface)

    assert with_own.shape == (4, quality.WITH_SURFACE)
    np.testing.assert_array_equal(with_own[:, : quality.FEATURES], figures)


def test_figures_are_finite_without_a_surface() -> None:
    images, said = frames(4)
    nothing = np.zeros_like(images)

    assert np.isfinite(quality_features(nothing, said)).all()
    assert np.isfinite(quality_features(nothing, said, nothing)).all()


def test_model_fitted_with_the_networks_surface_takes_it() -> None:
    """Without one it takes the uncertainty network's, and a model that was fitted without one
    leaves it out.
    """
    images, said = frames(3)
    own = np.full((3, 64, 64), 0.5, np.float32)
    models = list[QualityModel]()
    for count in (
        quality.FEATURES,
        quality.WITH_SURFACE,
    ):  # whose outputs are the sum of small figures
        layers = np.vstack([np.full((count, 5), 0.1), np.zeros((1, 5))])[None].tolist()
        models.append(
            QualityModel(record_of(means=[0.0] * count, spreads=[10.0] * count, layers=layers))
        )
    plain, wide = models

    np.testing.assert_array_equal(plain(images, said, own).iou, plain(images, said).iou)
    np.testing.assert_array_equal(wide(images, said, said.p_surface).iou, wide(images, said).iou)
    assert (wide(images, said, own).iou != wide(images, said).iou).any()


def test_left_out_families_are_judged_once_and_never_fitted() -> None:
    kinds = [*KINDS, "carved blobs", "cup"]
    judged = list[int]()
    for fitted, rows in left_out_folds(kinds):
        judged += rows.tolist()
        seen = set[str]().union(*(families(kinds[row]) for row in fitted))
        assert not any(min(families(kinds[row])) in seen for row in rows)

    assert sorted(judged) == list(range(len(kinds)))


@pytest.mark.parametrize(
    ("kinds", "enough"),
    [
        (["cup", "cup"], False),
        (["cup", "cup and hat"], False),
        (["cup", "hat"], True),
    ],
)
def test_a_fit_needs_objects_without_any_group_of_kinds(kinds: list[str], enough: bool) -> None:
    assert can_leave_out(kinds) == enough


def test_fit_predicts_the_quality_of_kinds_that_it_never_saw() -> None:
    samples = known_objects(600)
    samples.figures[:, 5] = 1.0
    record = QualityRecord.model_validate_json(fit_quality(samples, "0" * 12).model_dump_json())

    assert min(record.spreads) > 0
    assert record.figures["all_correlation"] > 0.8

    found = QualityEstimate.of(QualityModel(record).outputs(samples.figures), record.trusted_above)

    assert (np.diff(found.iou, axis=1) >= 0).all()
    assert np.corrcoef(found.error_v, samples.error_v)[0, 1] > 0.3
    assert record.figures["all_trusted_good"] >= quality.PRECISION
    assert found.trusted.any()
    assert (samples.iou[found.trusted] >= quality.GOOD_IOU).mean() >= quality.PRECISION


def test_trust_needs_good_outlines_in_both_shares() -> None:
    good = np.linspace(0, 1, 1000).astype(np.float32)
    generic = np.arange(1000) % 2 == 0
    above = trusted_above(good, good >= 0.5, generic)

    assert 0.44 < above <= 0.5
    assert trusted_above(good[-10:], good[-10:] > 0, generic[-10:]) is None
    assert trusted_above(good, (good >= 0.5) & ~generic, generic) is None


def test_model_of_poor_reconstructions_trusts_none() -> None:
    record = fit_quality(samples := known_objects(200, best=0.7), "0" * 12)

    assert record.trusted_above is None
    assert not QualityEstimate.of(QualityModel(record).outputs(samples.figures), None).trusted.any()


def test_good_outline_of_a_kind_counts_where_the_kind_is_sure() -> None:
    outputs = np.zeros((3, quality.OUTPUTS), np.float32)
    outputs[:, 3:6] = [(-9, 9, known) for known in (12, 0, -9)]

    assert QualityEstimate.of(outputs, 0.9).trusted.tolist() == [True, False, False]
    assert QualityEstimate.of(outputs, None).good[1] == pytest.approx(quality.KINDS_ODDS, rel=0.05)


def test_older_quality_records_know_no_kinds() -> None:
    outputs = np.zeros((3, quality.OUTPUTS), np.float32)
    outputs[:, 3:6] = [(-9, 9, known) for known in (12, 0, -9)]
    older = QualityEstimate.of(outputs[:, [0, 1, 2, 4, 6]], 0.9)

    assert older.trusted.all()


def test_shape_that_looks_like_a_kind_is_not_trusted() -> None:
    samples = known_objects(4000)
    samples.iou[samples.generic] *= 0.7  # the same first figure, and never a good outline
    samples.figures[:, 1] = np.where(samples.generic, -1, 1) + 0.3 * samples.figures[:, 1]
    record = fit_quality(samples, "0" * 12)
    found = QualityEstimate.of(QualityModel(record).outputs(samples.figures), record.trusted_above)

    assert found.trusted[~samples.generic].sum() > 100
    assert not found.trusted[samples.generic].any()


def record_of(**values: object) -> QualityRecord:
    plain = {
        "means": [0.0] * quality.FEATURES,
        "spreads": [1.0] * quality.FEATURES,
        "objects": 1,
        "watches": "?",
    }
    layers = np.zeros((1, quality.FEATURES + 1, 5)).tolist()
    return QualityRecord.model_validate({**plain, "layers": layers, **values})


def test_model_is_bound_to_its_uncertainty_network(tmp_path: Path) -> None:
    untrained_uncertainty(folder := tmp_path / "run", watched_weights(tmp_path / "watched"))

    assert quality.load_quality_model(folder) is None

    record = record_of(watches=records.checksum_of_watched(folder, quality.UNCERTAINTY_FILES))
    quality_training.write_quality(folder, record)
    loaded = load_uncertainty_model(folder, tmp_path)

    assert loaded.quality.record == record
    assert loaded.quality(*frames(2)).iou == pytest.approx(np.full((2, 3), 0.5))

    text = (folder / quality.QUALITY).read_text()
    for spoiled, reason in (
        (text[:-9], "damaged"),
        (text.replace(record.watches, "0" * 12), "damaged"),
    ):
        (folder / quality.QUALITY).write_text(spoiled)
        with pytest.raises(CheckpointError, match=reason):
            load_uncertainty_model(folder, tmp_path)
        assert (
            load_uncertainty_model(folder, tmp_path, quality=False).quality is None
        )  # to fit it again


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
def test_file_that_does_not_fit_is_refused(
    tmp_path: Path, values: dict[str, object], reason: str
) -> None:
    untrained_uncertainty(folder := tmp_path / "run", watched_weights(tmp_path / "watched"))
    quality_training.write_quality(
        folder,
        record_of(
            **{"watches": records.checksum_of_watched(folder, quality.UNCERTAINTY_FILES), **values}
        ),
    )

    with pytest.raises(CheckpointError, match=reason):
        quality.load_quality_model(folder)
