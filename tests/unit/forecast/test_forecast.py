"""Laws of a forecast: what more light, less noise and no light at all do to it."""

from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration import Rig, load_rig

from nlos_cam.errors import SceneError
from nlos_cam.forecast import (
    Change,
    Forecast,
    LidarView,
    Shape,
    change_words,
    forecast,
    network_iou,
    shipped_prior,
    words_of,
)
from nlos_cam.forecast.advice import ALONG_M, _candidates
from nlos_cam.forecast.lidar_view import SURE
from nlos_cam.objects import benchmark_objects, object_box
from nlos_cam.render import SensorModel

HOME = load_rig("paper-rig")


@pytest.fixture(scope="module")
def home() -> Forecast:
    return forecast(HOME, quick=True, cached=False)


def with_gap(gap_m: float) -> Rig:
    assert HOME.occluder
    occluder = HOME.occluder.model_copy(update={"z_min_m": gap_m})
    return HOME.model_copy(update={"occluder": occluder})


def disc() -> Shape:
    row, column = np.mgrid[:64, :64]
    depth_m = np.where(np.hypot(row - 32, column - 32) < 16, 0.2, np.nan)
    return Shape.of(depth_m.astype(np.float32), object_box(HOME))


def test_more_frames_never_lower_the_expectation(home: Forecast) -> None:
    once, often = home.at(1), home.at(100)
    assert often.linear_iou >= once.linear_iou
    assert often.depth_rmse_m <= once.depth_rmse_m
    assert often.outline_numbers > once.outline_numbers
    assert (home.outline_std[100] <= home.outline_std[1]).all()


def test_closed_gap_gives_the_priors_guess() -> None:
    found = forecast(with_gap(1e-6), quick=True, cached=False)
    assert found.sees_nothing
    assert found.at(100).linear_iou == found.guess_iou
    assert found.at(100).outline_numbers == pytest.approx(0, abs=1e-6)
    assert found.hidden_share == 1.0
    # The words have the scale of the table: that of networks.
    assert f"IoU {found.expected_iou:.2f}, which is a guess" in words_of(found)[1]


def test_narrower_gap_never_hides_fewer_objects(home: Forecast) -> None:
    narrow = [forecast(with_gap(gap_m), quick=True, cached=False) for gap_m in (0.05, 0.04)]
    shares = [home.hidden_share, *(found.hidden_share for found in narrow)]

    assert shares == sorted(shares)
    assert home.hidden_share == 0.0
    assert "nothing there" not in " ".join(words_of(home))
    assert 0 < shares[-1] < 1
    assert f"{shares[-1]:.0%} of the test objects" in words_of(narrow[-1])[1]


def test_hidden_object_alone_is_said_to_be_hidden() -> None:
    seen = forecast(HOME, quick=True, shape=disc())
    hidden = forecast(with_gap(0.01), quick=True, shape=disc())

    assert (seen.hidden_share, hidden.hidden_share) == (0.0, 1.0)
    assert hidden.sees_nothing
    assert "sees nothing of the disc" in words_of(hidden, "the disc")[0]


def test_words_of_one_object_speak_of_no_others() -> None:
    seen = forecast(HOME, quick=True, shape=disc())
    hidden = replace(seen, hidden_share=1.0)

    words = " ".join(words_of(hidden, "disc"))

    assert "hides disc" in words
    assert "Without disc the maps would be the same" in words
    assert "most objects" not in words
    assert "test objects" not in words
    assert "typical" not in " ".join(words_of(seen))


def test_verdict_on_a_round_object_agrees_with_its_figures() -> None:
    # The figures of the cup on the wide rig: a guess is good, and the maps gain half of the rest.
    own = forecast(HOME, quick=True, shape=disc())
    rows = tuple(replace(row, linear_iou=0.88) for row in own.expectations)

    first = words_of(replace(own, guess_iou=0.79, expectations=rows), "disc")[0]

    assert "shows the shape of disc" in first
    assert f"IoU {network_iou(0.88):.2f}" in first
    assert f"a guess has {network_iou(0.79):.2f}" in first


def test_verdict_where_maps_add_little_to_a_guess(home: Forecast) -> None:
    little = [replace(row, linear_iou=home.guess_iou + 0.05) for row in home.expectations]

    assert "shows shapes" in words_of(home)[0]
    assert "hardly shows more than" in words_of(replace(home, expectations=tuple(little)))[0]


def test_changes_below_the_scatter_are_no_advice() -> None:
    large = Change("gap wider", HOME, 0.11, None)
    small = Change("lidar nearer", HOME, 0.04, 0.03)

    assert change_words([large]) == ["gap wider: IoU +0.11"]
    words = " ".join(change_words([large, small]))
    assert "lidar nearer" not in words
    assert "second place beside this one: none" in words
    assert "No change tried gains 0.05" in change_words([small])[0]


def test_no_change_leads_the_other_way() -> None:
    """A rig beyond a range is not told to step into it by a word for stepping out."""
    lidar = HOME.lidar.model_copy(update={"distance_m": 0.12})
    words = [text for text, *_ in _candidates(HOME.model_copy(update={"lidar": lidar}))]

    assert any("farther" in text for text in words)
    assert not any("nearer" in text for text in words)


def test_no_change_moves_the_lidar_past_the_occluder() -> None:
    """From beyond the sheet the object is in plain sight: another task."""
    near = HOME.seen_from(np.array([0.11, 0.0, HOME.lidar.distance_m]))
    changes = {text: rig for text, rig, _ in _candidates(near)}

    assert near.occluder
    assert 0 < near.occluder.x_m < ALONG_M
    assert any("away from the object" in text for text in changes)
    assert all(rig.occluder and rig.occluder.x_m > 0 for rig in changes.values())


def test_less_noise_determines_more() -> None:
    noisy = SensorModel(read_noise_counts=7, shot_noise=3)
    quiet = SensorModel(read_noise_counts=0, shot_noise=0)
    rows = [
        forecast(HOME, quick=True, shape=disc(), sensor=sensor).at()
        for sensor in (noisy, SensorModel(), quiet)
    ]
    numbers = [row.outline_numbers for row in rows]
    assert numbers == sorted(numbers)
    assert rows[2].linear_iou > rows[0].linear_iou


def test_expected_iou_of_home_is_near_the_networks(home: Forecast) -> None:
    # docs/direct.md: 0.790 (0.760 to 0.818) on the kinds of training.
    assert home.expected_iou == pytest.approx(0.79, abs=0.08)
    assert home.guess_iou < home.at().linear_iou


def test_stored_forecast_is_the_same(home: Forecast) -> None:
    again = Forecast.load(home.dump())
    assert again == home
    assert again.as_json() == home.as_json()


def test_forecast_is_the_same_in_every_run() -> None:
    one, other = (forecast(HOME, quick=True, shape=disc()) for _ in range(2))
    assert one == other


def test_network_curve_is_monotone() -> None:
    values = [network_iou(x) for x in np.linspace(0, 1, 21)]
    assert values == sorted(values)
    assert 0 <= values[0] <= values[-1] <= 1


def test_shipped_prior_is_small_and_positive() -> None:
    prior = shipped_prior()
    assert np.linalg.eigvalsh(prior.covariance).min() > 0
    assert len(prior.dump()) < 100_000
    assert prior.outline.min() >= 0
    assert prior.outline.max() <= 1


def test_rig_without_object_box_is_refused() -> None:
    with pytest.raises(SceneError, match="object_box"):
        forecast(HOME.model_copy(update={"object_box": None}))


def test_lidar_shows_an_object_farther_than_the_wall_alone() -> None:
    view = LidarView.of(HOME, benchmark_objects(object_box(HOME))[0].depth_m)
    shown = np.abs(view.depth_change) >= SURE

    assert view.cells >= shown.sum() > 500
    assert (
        view.depth_change[shown] > 0
    ).all()  # three bounces are a longer way than the wall's own
    assert view.typical_margin > SURE
    assert "behind the wall" in view.words()


def test_lidar_shows_nothing_of_nothing() -> None:
    nothing = LidarView.of(HOME, np.full((64, 64), np.nan, np.float32))

    assert nothing.cells == 0
    assert nothing.typical_margin == 0
    assert "nothing of it" in nothing.words()
