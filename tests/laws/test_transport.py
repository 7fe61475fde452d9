"""Laws of the renderer: fast == reference, energy, causality, symmetry, convergence, hard cases."""

import numpy as np
import pytest
from nlos_calibration.rig import LidarPose, Rig, load_rig

from nlos_cam.errors import SceneError
from nlos_cam.objects.hidden import object_depth
from nlos_cam.render.beams import SPEED_OF_LIGHT_M_PER_S, cast
from nlos_cam.render.renderer import reference_transient, render, transient
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")
FEW = 40
"""Beams that the brute force is asked for: it needs milliseconds for each."""


def _object(seed: int) -> np.ndarray:
    assert RIG.object_box is not None
    return object_depth(seed, RIG.object_box)[1]


def _beams_on_wall(rig: Rig) -> np.ndarray:
    lit = np.flatnonzero(cast(rig, Scene(rig).cell_intrinsics).on_wall)
    return lit[:: len(lit) // FEW]


def _plate(z_m: float = 0.25) -> np.ndarray:
    depth = np.full((64, 64), np.nan, np.float32)
    depth[20:40, 15:45] = z_m
    return depth


Pair = tuple[Scene, np.ndarray, np.ndarray]
"""A scene, some beams, and their brute-force histograms."""


@pytest.fixture(scope="module", params=[3, 20_000_001, 20_000_009])
def pair(request: pytest.FixtureRequest) -> tuple[Scene, np.ndarray, np.ndarray]:
    scene, chosen = Scene(RIG, _object(request.param)), _beams_on_wall(RIG)
    return scene, chosen, reference_transient(scene, chosen)


@pytest.mark.parametrize(
    ("stop", "median", "worst", "total"), [("standard", 3e-3, 1e-2, 1e-2), ("fine", 1.5e-3, 6e-3, 3e-3)]
)
def test_fast_matches_the_reference(pair: Pair, stop: str, median: float, worst: float, total: float) -> None:
    scene, chosen, slow = pair
    fast = transient(scene, stop).reshape(-1, slow.shape[1])[chosen]
    error = np.abs(fast.max(1) - slow.max(1)) / slow.max(1)
    assert np.median(error) < median
    assert error.max() < worst
    assert np.abs(fast - slow).sum() < total * slow.sum()
    assert (np.abs(fast.argmax(1) - slow.argmax(1)) <= 1).mean() > 0.95


def test_a_finer_stop_is_nearer_to_the_reference(pair: Pair) -> None:
    scene, chosen, slow = pair
    errors = [
        np.abs(transient(scene, s).reshape(-1, slow.shape[1])[chosen] - slow).sum()
        for s in ("draft", "standard", "fine")
    ]
    assert errors == sorted(errors, reverse=True)


def test_no_echo_before_the_shortest_path(pair: Pair) -> None:
    scene, chosen, _ = pair
    histogram = transient(scene).reshape(5120, -1)[chosen]
    beams = cast(RIG, scene.cell_intrinsics)
    shortest = beams.length_m[chosen] + 2 * np.nanmin(scene.object_depth_m) + RIG.lidar.distance_m
    first = (histogram > 0).argmax(1) * RIG.device.bin_m
    assert (first >= shortest - RIG.device.bin_m).all()


def test_a_mirrored_object_is_seen_as_mirrored_maps() -> None:
    depth = _plate()  # level: the forward differences of S3 are not symmetric on a slope
    one, other = render(Scene(RIG, depth)), render(Scene(RIG, depth[::-1].copy()))
    np.testing.assert_allclose(one.multi.peak[::-1], other.multi.peak, rtol=2e-3)


def test_two_plates_return_what_each_returns() -> None:
    left, right = _plate(), _plate()
    left[:, 30:], right[:, :30] = np.nan, np.nan
    both = transient(Scene(RIG, _plate()))
    bins = both.shape[-1]
    parts = np.zeros_like(both)
    for part in (transient(Scene(RIG, left)), transient(Scene(RIG, right))):
        shared = min(bins, part.shape[-1])
        parts[..., :shared] += part[..., :shared]
    np.testing.assert_allclose(both, parts, rtol=1e-4, atol=1e-5 * both.max())


def test_less_comes_back_than_was_sent() -> None:
    assert transient(Scene(RIG, _plate(0.13))).sum(-1).max() < 1


def test_a_front_part_shades_the_part_behind_it() -> None:
    behind = np.full((64, 64), np.nan, np.float32)
    behind[20:40, 40:60] = 0.35
    with_front = behind.copy()
    with_front[15:45, 20:36] = 0.14
    front = np.where(with_front == np.float32(0.14), with_front, np.nan).astype(np.float32)
    chosen = _beams_on_wall(RIG)
    apart = reference_transient(Scene(RIG, behind), chosen).sum() + reference_transient(Scene(RIG, front), chosen).sum()
    together = reference_transient(Scene(RIG, with_front), chosen).sum()
    assert together < 0.98 * apart


def test_threads_do_not_change_a_bit() -> None:
    import numba

    scene, before = Scene(RIG, _object(11)), numba.get_num_threads()
    many = transient(scene)
    try:
        numba.set_num_threads(1)
        assert np.array_equal(transient(scene), many)
    finally:
        numba.set_num_threads(before)


def test_the_direct_return_follows_s1() -> None:
    rig = load_rig("bare-wall")
    beams = cast(rig, Scene(rig).cell_intrinsics)
    expected = beams.lidar_m[2] / beams.length_m * rig.device.receiver_cell_m2 / (2 * np.pi * beams.length_m**2)
    np.testing.assert_allclose(beams.direct, expected)
    np.testing.assert_allclose(render(Scene(rig)).intensity.ravel(), expected, rtol=1e-6)


def test_the_bare_wall_is_a_plane_where_the_rig_says() -> None:
    rig = load_rig("bare-wall")
    scene = Scene(rig)
    points = render(scene).depth_m[..., None] * scene.cell_intrinsics.rays()
    in_wall = points @ rig.wall_from_lidar[:3, :3].T + rig.wall_from_lidar[:3, 3]
    np.testing.assert_allclose(in_wall[..., 2], 0, atol=1e-6)


def test_beams_that_miss_the_wall_return_nothing() -> None:
    rig = RIG.model_copy(update={"lidar": LidarPose(distance_m=0.2, yaw_deg=75), "occluder": None, "object_box": None})
    rendering = render(Scene(rig))
    lost = np.isnan(rendering.depth_m)
    assert lost.any()
    assert (rendering.intensity[lost] == 0).all()
    assert (rendering.margin[lost] == 0).all()


@pytest.mark.parametrize("name", ["one pixel", "full grid", "cliff", "spike", "empty"])
def test_hard_objects_stay_finite(name: str) -> None:
    depth = np.full((64, 64), np.nan, np.float32)
    if name == "one pixel":
        depth[30, 30] = 0.3
    elif name != "empty":
        depth[:] = 0.38
    if name == "cliff":
        depth[:, :32] = 0.13
    if name == "spike":
        depth[32, 32] = 0.121
    rendering = render(Scene(RIG, depth))
    assert np.isfinite(rendering.intensity).all()
    assert (rendering.intensity >= 0).all()
    assert ((rendering.margin >= 0) & (rendering.margin <= 1)).all()


def test_a_gate_shorter_than_every_path_leaves_nothing() -> None:
    device = RIG.device.model_copy(update={"gate_s": 0.1 / SPEED_OF_LIGHT_M_PER_S})
    rendering = render(Scene(RIG.model_copy(update={"device": device}), _plate()))
    assert np.isnan(rendering.depth_m).all()
    assert (rendering.intensity == 0).all()


@pytest.mark.parametrize(("z_m", "word"), [(0.001, "off the wall"), (np.inf, "finite"), (-0.2, "off the wall")])
def test_depths_that_cannot_be_are_refused(z_m: float, word: str) -> None:
    with pytest.raises(SceneError, match=word):
        Scene(RIG, _plate(z_m))


def test_an_object_in_sight_is_refused_rather_than_rendered_without_its_return() -> None:
    with pytest.raises(SceneError, match="in the lidar's own sight"):
        render(Scene(RIG.model_copy(update={"occluder": None}), _plate(0.13)))


def test_a_step_is_not_joined_by_a_curtain() -> None:
    depth = _plate(0.2)
    depth[20:40, 30:45] = 0.3
    patches = Scene(RIG, depth).patches
    assert patches is not None
    np.testing.assert_allclose(patches.beta, 1)


def test_a_plane_has_the_normal_and_area_of_a_plane() -> None:
    depth = np.full((64, 64), np.nan, np.float32)
    pitch = 0.25 / 64
    depth[10:50, 10:50] = 0.2 + 0.5 * pitch * np.arange(40)
    patches = Scene(RIG, depth).patches
    assert patches is not None
    np.testing.assert_allclose(patches.beta, np.sqrt(1.25), rtol=1e-5)
    np.testing.assert_allclose(patches.normal, np.tile(np.array([0.5, 0, -1]) / np.sqrt(1.25), (1600, 1)), atol=1e-5)
