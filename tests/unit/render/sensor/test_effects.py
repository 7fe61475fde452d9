from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration import load_rig

from nlos_cam.render import QUIET, MultiBounce, SensedImages, Sensor, included, sensor_effects
from nlos_cam.render.sensor.bias import BIASES
from nlos_cam.render.sensor.model import DEPTH_UNIT_M, SensorModel, WarmUp

WIDTH = 160
HEIGHT = 128
FULL = load_rig("bare-wall")
SMALL = FULL.intrinsics.model_copy(update=vars(FULL.pinhole.scaled(WIDTH, HEIGHT)))
BARE = FULL.model_copy(update={"intrinsics": SMALL})
CHAIN = (
    *("wall texture", "gain", "ambient light", "shot noise", "read noise", "saturation"),
    *(
        "range offset",
        "ripples",
        "patchy drift",
        "drift",
        "range noise",
        "quantisation",
        "dead pixels",
    ),
)
FORMAT = {"gain", "saturation", "quantisation"}
WARM_UP = WarmUp(from_celsius=25, to_celsius=45, time_constant_s=600)
COLD = 25.0
HAS = {
    "wall texture": {"wall_texture": 0.2},
    "ambient light": {"ambient_counts": 60.0, "shot_noise": 0.3},
    "shot noise": {"shot_noise": 0.3},
    "read noise": {"read_noise_counts": 0.7},
    "range offset": {"range_offset_m": -0.0045},
    "ripples": {"ripple_m": 0.002},
    "patchy drift": {"patch_drift_m": 0.001},
    "drift": {"drift_m_per_celsius": -0.0002, "warm_up": WARM_UP},
    "range noise": {"range_noise_m": 0.001},
    "dead pixels": {"dead_share": 0.05},
}
WORST_AT = {"drift": COLD}
"""Temperature of the worst case; the warm device for all others."""
LACKS = {
    name: {
        field: 0.0
        for field in fields
        if field not in {"warm_up", "shot_noise"} or name == "shot noise"
    }
    for name, fields in HAS.items()
} | {"range noise": {"range_noise_m": 0.0, "range_noise_per_m": 0.0}}
BIASED = SensorModel(
    range_offset_m=0.0045,
    ripple_m=0.001,
    patch_drift_m=0.0005,
    drift_m_per_celsius=0.0001,
    warm_up=WARM_UP,
)
RICH = BIASED.model_copy(update={"ambient_counts": 60.0, "dead_share": 0.05, "wall_texture": 0.3})


def _flat(counts: float) -> MultiBounce:
    gain = Sensor(BARE, QUIET)._chain.gain
    peak = np.full((64, 80), counts / gain, np.float32)
    return MultiBounce(
        peak,
        np.zeros_like(peak),
        np.ones_like(peak),
        direct_included=True,
    )


def _seen(model: SensorModel, counts: float, celsius: float | None = None) -> SensedImages:
    return Sensor(BARE, model).expose(
        _flat(counts),
        np.random.default_rng(4),
        celsius=celsius,
    )


def _turned(
    model: SensorModel,
    name: str,
    counts: float,
    monkeypatch: pytest.MonkeyPatch,
    celsius: float | None = None,
) -> SensedImages:
    """The images with one stage switched the other way."""
    turned = tuple(
        replace(
            e,
            included=not e.included,
        )
        if e.name == name
        else e
        for e in sensor_effects(model)
    )
    with monkeypatch.context() as patch:
        patch.setattr("nlos_cam.render.sensor.sensor.sensor_effects", lambda _: turned)
        return _seen(model, counts, celsius)


def _same(one: SensedImages, other: SensedImages) -> bool:
    return all(
        np.array_equal(getattr(one, n), getattr(other, n))
        for n in ("depth_z16", "ir", "confidence")
    )


@pytest.mark.parametrize("name", HAS)
def test_stage_is_included_exactly_when_the_model_has_it(name: str) -> None:
    bare = sensor_effects(QUIET.model_copy(update=HAS[name]))
    rich = sensor_effects(RICH.model_copy(update=LACKS[name]))

    assert included(bare, name)

    if name == "range noise":
        assert included(sensor_effects(QUIET.model_copy(update={"range_noise_per_m": 0.001})), name)
    if name == "drift":  # at a steady temperature there is none
        steady = sensor_effects(QUIET.model_copy(update={"drift_m_per_celsius": 0.001}))
        assert [(e.included, e.bound) for e in steady if e.name == name] == [(False, 0.0)]

    assert {e.name for e in rich if not e.included} == {name}
    assert next(e.bound for e in rich if e.name == name) == 0


@pytest.mark.parametrize(
    "model",
    [SensorModel(), QUIET, RICH],
    ids=["default", "quiet", "rich"],
)
def test_stages_have_their_order_and_reasons(model: SensorModel) -> None:
    verdicts = sensor_effects(model)

    assert tuple(effect.name for effect in verdicts) == CHAIN

    for effect in verdicts:
        assert effect.included == (effect.bound > 0)

    assert {e.name for e in verdicts if e.included} >= FORMAT


@pytest.mark.parametrize("name", HAS)
def test_stage_changes_the_images_only_if_the_model_has_it(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = QUIET.model_copy(update=HAS[name])
    celsius = WORST_AT.get(name)

    assert not _same(
        _seen(model, 30.0, celsius),
        _turned(model, name, 30.0, monkeypatch, celsius),
    )
    assert _same(_seen(QUIET, 30.0), _turned(QUIET, name, 30.0, monkeypatch))


@pytest.mark.parametrize(
    ("name", "deviates"),
    [
        ("shot noise", 1),
        ("read noise", 1),
        ("range noise", 1),
        ("dead pixels", 0),
        ("none", 0),
    ],
)
def test_noise_left_out_is_not_drawn(name: str, deviates: int) -> None:
    drawn, counted = map(np.random.default_rng, (7, 7))
    Sensor(
        BARE,
        QUIET.model_copy(update=HAS.get(name, {})),
    ).expose(_flat(30.0), drawn)
    counted.standard_normal((deviates, WIDTH * HEIGHT), np.float32)

    assert drawn.bit_generator.state == counted.bit_generator.state


def _ir_change(
    model: SensorModel, name: str, counts: float, monkeypatch: pytest.MonkeyPatch
) -> tuple[float, float]:
    """Mean change of the IR without a stage, in counts, and the stage's bound."""
    with_it = _seen(model, counts).ir.astype(float)
    without = _turned(model, name, counts, monkeypatch).ir.astype(float)
    return float(np.abs(with_it - without).mean()), next(
        e.bound for e in sensor_effects(model) if e.name == name
    )


@pytest.mark.parametrize("name", ["wall texture", "ambient light", "shot noise", "read noise"])
@pytest.mark.parametrize(
    "counts",
    [1.0, 5.0, 30.0, 120.0, 195.0, 250.0],
)
def test_ir_changes_by_at_most_the_bound(
    name: str, counts: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    change, bound = _ir_change(RICH, name, counts, monkeypatch)
    assert change <= bound * counts


def test_ir_bound_is_near_the_worst_case(monkeypatch: pytest.MonkeyPatch) -> None:
    noisy = QUIET.model_copy(update={"read_noise_counts": 2.0})
    # The same at 1 count, were it not cut at 0.
    change, bound = _ir_change(noisy, "read noise", 30.0, monkeypatch)

    assert bound / 2 < change <= bound

    rough = QUIET.model_copy(update={"wall_texture": 0.2})
    change, bound = _ir_change(rough, "wall texture", 100.0, monkeypatch)

    assert 100 * bound / 2 < change <= 100 * bound

    lit = QUIET.model_copy(update={"ambient_counts": 60.0})
    change, bound = _ir_change(lit, "ambient light", 300.0, monkeypatch)

    assert change == pytest.approx(255 * bound)


def test_depth_changes_by_at_most_the_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    bounds = {e.name: e.bound for e in sensor_effects(RICH)}
    seen = _seen(RICH, 30.0).depth_z16.astype(float)
    still = _turned(RICH, "range noise", 30.0, monkeypatch).depth_z16.astype(float)

    assert 0 < np.abs(seen - still).mean() * DEPTH_UNIT_M <= bounds["range noise"]

    whole = _turned(RICH, "dead pixels", 30.0, monkeypatch).depth_z16.astype(float)

    assert np.abs(seen - whole).sum() / whole.sum() == pytest.approx(
        bounds["dead pixels"], rel=0.05
    )


@pytest.mark.parametrize("name", BIASES)
@pytest.mark.parametrize("celsius", [25.0, 35.0, 45.0])
def test_bias_moves_depth_by_half_to_all_its_bound(
    name: str, celsius: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = BIASED.model_copy(
        update={"range_noise_m": 0.0, "range_noise_per_m": 0.0, "dead_share": 0.0}
    )
    bound = next(e.bound for e in sensor_effects(model) if e.name == name)

    def change_m(celsius: float) -> float:
        seen = _seen(model, 30.0, celsius)
        without = _turned(model, name, 30.0, monkeypatch, celsius)
        return float(np.abs(seen.depth_z16.astype(float) - without.depth_z16).mean() * DEPTH_UNIT_M)

    # Rounding to units adds to a mean of moduli.
    assert change_m(celsius) <= bound + DEPTH_UNIT_M / 20
    assert change_m(WORST_AT.get(name, 45.0)) > bound / 2
