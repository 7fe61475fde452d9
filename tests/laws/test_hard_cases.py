"""Hard cases on every backend: finite and bounded results."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from depth_maps import depth_map
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration import LidarPose, Rig, load_rig

from nlos_cam.errors import SceneError
from nlos_cam.render import EFFECTS, Accuracy, Rendering, Scene, Surface, prepare
from nlos_cam.render.geometry import SPEED_OF_LIGHT_M_PER_S

pytestmark = pytest.mark.slow
RIG = load_rig("paper-rig")
OPEN = load_rig("bare-wall").model_copy(update={"object_box": RIG.object_box})
FEW = Accuracy("few", relay_columns=4, relay_rows=4)
MAX_EFFECTS = sorted(set(EFFECTS) - {"inter-reflection", "pulse"})


CLIFF = depth_map(8, 0.38, (np.s_[:, :4], 0.13))
ONE_PIXEL = depth_map(8, np.nan, ((3, 5), 0.2))
OBJECTS = {
    **{
        f"touching from {z_m} m": depth_map(8, z_m)
        for z_m in (
            0.0,
            1e-30,
            1e-9,
            1e-4,
            0.01,
        )
    },
    "half touching": np.linspace(
        0,
        0.2,
        64,
        dtype=np.float32,
    ).reshape(8, 8),
    "one pixel": ONE_PIXEL,
    "one cell is the whole grid": depth_map(1, 0.2),
    "empty": depth_map(8),
    "spike": depth_map(8, 0.38, ((4, 4), 1e-3)),
    "cliff": CLIFF,
    "full": depth_map(8, 0.25),
    "tiny and huge": np.geomspace(
        1e-38,
        1e3,
        64,
        dtype=np.float32,
    ).reshape(8, 8),
}


def _check(rendering: Rendering) -> None:
    assert np.isfinite(rendering.intensity).all()
    assert ((rendering.intensity >= 0) & (rendering.intensity <= 1)).all()
    assert ((rendering.margin >= 0) & (rendering.margin <= 1)).all()
    assert ((rendering.depth_m > 0) | np.isnan(rendering.depth_m)).all()
    np.testing.assert_array_equal(np.isnan(rendering.depth_m), rendering.intensity == 0)


def _lidar(distance_m: float, yaw_deg: float, rig: Rig = RIG) -> Rig:
    return rig.model_copy(update={"lidar": LidarPose(distance_m=distance_m, yaw_deg=yaw_deg)})


@pytest.mark.parametrize("radiometry", ["paper", "lambertian"])
@pytest.mark.parametrize("name", OBJECTS)
def test_hard_objects_give_bounded_maps(implementation: Any, name: str, radiometry: Any) -> None:
    for jump_m in (0.02, 10.0):
        scene = Scene(RIG, OBJECTS[name], radiometry=radiometry, jump_m=jump_m)
        _check(rendering := implementation.render(scene, MAX_EFFECTS, FEW))
        assert rendering.near_legs > 0 or "touching" not in name


@pytest.mark.parametrize("distance_m", [0.15, 0.3])
@pytest.mark.parametrize("yaw_deg", [15.0, 75.0, 89.9, -75.0, 54.999])
def test_grazing_lidars_give_bounded_maps(
    implementation: Any, distance_m: float, yaw_deg: float
) -> None:
    """At 55 degrees the outermost beams go along the wall; beyond it some never meet it."""
    for rig in (RIG, OPEN):
        rendering = implementation.render(
            Scene(_lidar(distance_m, yaw_deg, rig), ONE_PIXEL), accuracy=FEW
        )
        _check(rendering)
    lost = np.isnan(rendering.depth_m)

    assert lost.any() or abs(yaw_deg) < 60


def test_beam_along_the_wall_has_no_return(implementation: Any) -> None:
    """An axis turned by 90 degrees less half a pixel: a column of beams runs exactly along the
    wall.
    """
    pinhole = OPEN.pinhole.scaled(80, 64)
    angle = np.degrees(np.arctan((79 - pinhole.ppx) / pinhole.fx))
    rendering = implementation.render(
        Scene(_lidar(0.2, 90 - angle, OPEN), ONE_PIXEL),
        accuracy=FEW,
    )
    _check(rendering)

    assert np.isnan(rendering.depth_m[:, 79]).all()


@pytest.mark.parametrize("gate_m", [1e-9, 0.1, 0.9, 1.2034])
def test_gate_ends_the_histogram(implementation: Any, gate_m: float) -> None:
    device = RIG.device.model_copy(update={"gate_s": gate_m / SPEED_OF_LIGHT_M_PER_S})
    scene = Scene(
        RIG.model_copy(update={"device": device}),
        depth_map(8, 0.2),
    )
    rendering = implementation.render(scene, accuracy=FEW)
    whole = implementation.transient(scene, accuracy=FEW)
    _check(rendering)
    if gate_m < 0.2:
        assert not whole.any()
        assert np.isnan(rendering.depth_m).all()

    assert whole.shape[2] * RIG.device.bin_m < gate_m + 2 * RIG.device.bin_m

    heard = np.isfinite(rendering.multi.path_m)

    assert (rendering.multi.path_m[heard] < gate_m + RIG.device.bin_m).all()
    # transient and render keep the same last bin; the transient holds the direct return too
    wins = heard & (rendering.multi.peak == rendering.intensity)

    assert wins.any() == (gate_m > 1)
    np.testing.assert_allclose(rendering.multi.peak[wins], whole[wins].max(-1), rtol=1e-6)


def test_path_on_the_edge_of_a_bin_is_kept(implementation: Any) -> None:
    """The longest path of all beams ends exactly at the last bin."""
    depth = depth_map(8, np.nan, ((3, 3), 0.25))
    one = replace(FEW, relay_columns=1, relay_rows=1)
    job = prepare(Scene(OPEN, depth), one, ["three-bounce"]).job
    cell = np.array(
        [
            job.relay.x_m[0],
            job.relay.y_m[0],
            0,
        ]
    )
    point = job.patches.point_m[0]
    path = (
        job.length_m
        + np.linalg.norm(job.laser_spot_m - point, axis=1)
        + np.linalg.norm(cell - point)
    )
    longest = float((path + job.relay.length_m[0]).max())
    for bins in (50, 64, 100):
        device = OPEN.device.model_copy(update={"bin_m": longest / bins})
        rig = OPEN.model_copy(update={"device": device})
        found = implementation.three_bounce(
            Scene(rig, depth), effects=["three-bounce"], accuracy=one
        )
        assert (found > 0).any(1).sum() == len(job.laser_spot_m)


def test_histogram_holds_a_ratio_of_a_million_to_one(implementation: Any) -> None:
    """A patch with an albedo of 1e-6 stays as bright as alone beside a white one."""
    alone = depth_map(8, np.nan, ((6, 6), 0.4))
    albedo = np.full((8, 8), 1e-6)
    depth = depth_map(
        8,
        np.nan,
        ((6, 6), 0.4),
        ((1, 1), 0.14),
    )
    albedo[1, 1] = 1.0
    effects = ["three-bounce", "occluder"]
    some = np.arange(5120)[::61]
    both = implementation.three_bounce(
        Scene(RIG, depth, Surface(albedo)),
        some,
        effects,
        FEW,
    )
    dim = implementation.three_bounce(
        Scene(RIG, alone, Surface(albedo)),
        some,
        effects,
        FEW,
    )
    only = implementation.three_bounce(
        Scene(
            RIG,
            depth,
            Surface(np.where(albedo < 1, 0, 1.0)),
        ),
        some,
        effects,
        FEW,
    )
    own = (dim > 0) & (only[:, : dim.shape[1]] == 0)

    assert own.sum() > 100
    assert both.max() > 1e6 * both[:, : dim.shape[1]][own].max()
    np.testing.assert_allclose(
        both[:, : dim.shape[1]][own],
        dim[own],
        rtol=1e-4,
    )


@pytest.mark.parametrize(
    "dtype",
    [np.float16, np.float32, np.float64, ">f4", np.longdouble],
)
@pytest.mark.parametrize("layout", ["C", "F", "strided", "read-only"])
def test_dtype_and_layout_do_not_change_the_result(
    implementation: Any, dtype: Any, layout: str
) -> None:
    plain = CLIFF.astype(np.float16)
    depth = plain.astype(dtype, order="F" if layout == "F" else "C")
    if layout == "strided":
        depth = np.repeat(
            np.repeat(depth, 2, 0),
            3,
            1,
        )[::2, ::3]
    depth.flags.writeable = layout != "read-only"
    expected = implementation.three_bounce(
        Scene(
            RIG,
            plain.astype(np.float32),
        ),
        np.arange(5120)[::401],
        accuracy=FEW,
    )
    found = implementation.three_bounce(
        Scene(RIG, depth),
        np.arange(5120)[::401],
        accuracy=FEW,
    )

    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    "bad",
    [np.inf, -np.inf, -0.1, -1e-6, -1e-9],
)
def test_scene_refuses_depths_that_cannot_be(bad: float) -> None:
    with pytest.raises(SceneError, match="depth"):
        Scene(RIG, depth_map(8, 0.2, ((3, 3), bad)))


values = st.one_of(
    st.just(np.nan), st.floats(0, 0.5, width=32), st.sampled_from([0.0, 1e-38, 1e-9, 5.0])
)
grids = st.integers(1, 6).flatmap(
    lambda n: st.lists(
        values,
        min_size=n * n,
        max_size=n * n,
    )
)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    cells=grids,
    albedo=st.sampled_from([0.0, 1e-6, 1.0]),
    radiometry=st.sampled_from(["paper", "lambertian"]),
    rig=st.sampled_from(
        [
            RIG,
            OPEN,
            _lidar(0.15, 15.0),
            _lidar(0.15, 75.0, OPEN),
        ]
    ),
    jump_m=st.sampled_from([0.0, 0.02, 10.0]),
)
def test_any_depths_give_bounded_maps(
    implementation: Any, cells: list[float], albedo: float, radiometry: Any, rig: Rig, jump_m: Any
) -> None:
    size = int(np.sqrt(len(cells)))
    depth = np.array(cells, np.float32).reshape(size, size)
    scene = Scene(rig, depth, Surface(albedo), radiometry, jump_m)
    try:
        rendering = implementation.render(scene, MAX_EFFECTS, FEW)
    except SceneError as error:
        assert "lidar" in str(error)  # noqa: PT017
        return
    _check(rendering)
    if albedo == 0:
        assert not rendering.multi.peak.any()
        assert np.isnan(rendering.multi.path_m).all()
