from typing import Any

import numba
import numpy as np
import pytest
from nlos_calibration import ObjectBox, Occluder, load_rig

from nlos_cam.errors import SceneError
from nlos_cam.objects import cell_centers_m, object_box, object_depth
from nlos_cam.render import (
    Accuracy,
    Scene,
    Surface,
    TransportJob,
    interreflection,
    prepare,
    three_bounce,
)
from nlos_cam.render.backend_numba import NumbaJob
from nlos_cam.render.legs import DARK, FREE, NumbaOptics, NumbaSurface, judge
from nlos_cam.render.line_of_sight import first_hits
from nlos_cam.render.material import retroreflective
from nlos_cam.render.scene_facts import SceneFacts
from nlos_cam.render.visibility import (
    FACES,
    HeightField,
    blocked,
    height_field,
    horizon_table,
    occluded,
    visible,
)
from nlos_cam.render.visibility import segment_blocked as between

RIG = load_rig("paper-rig")
BOX = object_box(RIG)
X_M, Y_M = cell_centers_m(BOX)
ROW = 32


def _field(depth: np.ndarray, *, shades: bool = True) -> HeightField:
    return height_field(depth, BOX, shades=shades)


def _ridge(front_m: float = 0.15) -> np.ndarray:
    """A surface at 0.35 m with a ridge of one column at `front_m`."""
    depth = np.full((64, 64), 0.35)
    depth[:, 40] = front_m
    return depth


def _seen(
    field: HeightField,
    column: int,
    x: float,
    y: float,
    row: int = ROW,
) -> bool:
    point = np.array(
        [
            X_M[column],
            Y_M[row],
            field.depth_m[row, column],
        ]
    )
    return visible(field, row, column, point, x, y)


def test_ridge_shades_up_to_the_line_over_its_top() -> None:
    """By similar triangles the line over the top of the ridge, less the bias, meets the wall at
    `reach`.
    """
    field = _field(_ridge())
    reach = (X_M[40] - X_M[10]) * 0.35 / (0.35 - 0.15 - 0.25 * field.pitch_x_m)

    assert _seen(field, 10, X_M[10] + 0.999 * reach, Y_M[ROW])
    assert not _seen(field, 10, X_M[10] + 1.001 * reach, Y_M[ROW])
    assert _seen(
        _field(_ridge(), shades=False),
        10,
        X_M[10] + 1.001 * reach,
        Y_M[ROW],
    )

    for x, y in (
        (X_M[10] - 2, Y_M[ROW]),
        (X_M[10], Y_M[ROW] + 2),
        (X_M[10], Y_M[ROW]),
    ):
        assert _seen(field, 10, x, y)  # other directions
    for angle in np.linspace(0, 2 * np.pi, 33):  # from the ridge itself
        assert _seen(
            field,
            40,
            X_M[40] + 3 * np.cos(angle),
            Y_M[ROW] + 3 * np.sin(angle),
        )


@pytest.mark.parametrize("slope", [0.0, 1.0, -1.0])
def test_plane_does_not_shade_its_lit_side(slope: float) -> None:
    columns, rows = np.meshgrid(X_M - X_M[32], Y_M - Y_M[32])
    field = _field(0.4 + slope * (columns + 0.5 * rows))
    for row, column in [
        (0, 0),
        (32, 32),
        (63, 10),
    ]:
        for angle in np.linspace(0, 2 * np.pi, 33):
            dx = np.cos(angle)
            dy = np.sin(angle)
            lit = slope * (dx + 0.5 * dy) * 10 + field.depth_m[row, column] > 0
            assert (
                _seen(
                    field,
                    column,
                    X_M[column] + 10 * dx,
                    Y_M[row] + 10 * dy,
                    row,
                )
                or not lit
            )


def test_background_neither_shades_nor_ends_the_walk() -> None:
    depth = _ridge()
    far = X_M[10] + 3
    depth[:, 11:40] = np.nan

    assert not _seen(_field(depth), 10, far, Y_M[ROW])

    depth[:, 40] = np.nan

    assert _seen(_field(depth), 10, far, Y_M[ROW])


def test_segment_is_blocked_by_what_stands_between() -> None:
    field = _field(_ridge())

    assert between(field, ROW, 10, 0.35, ROW, 60, 0.35)
    assert not between(field, ROW, 10, 0.35, ROW, 30, 0.35)
    assert not between(field, ROW, 10, 0.35, 10, 10, 0.35)
    assert not between(field, ROW, 10, 0.35, ROW, 40, 0.15)

    for one, other in (
        (10, 60),
        (60, 10),
        (10, 39),
    ):
        assert between(field, ROW, one, 0.35, 40, other, 0.35) == between(
            field, 40, other, 0.35, ROW, one, 0.35
        )


@pytest.mark.parametrize("sectors", [1, 8, 13])
@pytest.mark.parametrize("seed", [0, 5])
def test_horizon_table_bounds_the_walk_on_every_leg(seed: int, sectors: int) -> None:
    field = _field(object_depth(seed, BOX)[1])
    rows, columns = np.nonzero(~np.isnan(field.depth_m))
    rows = rows[::40]
    columns = columns[::40]
    z = field.depth_m[rows, columns]
    low, high, walk = horizon_table(
        field,
        rows,
        columns,
        z,
        np.full(len(rows), 400.0),
        sectors,
    )

    assert low.shape == high.shape == (len(rows), FACES * sectors)

    generator = np.random.default_rng(seed)
    sure = 0
    walked = 0
    for s, row in enumerate(rows):
        for u, v in generator.uniform(-300, 300, (60, 2)):
            along = abs(u) >= abs(v)
            major, minor = (u, v) if along else (v, u)
            face = (0 if along else 2) + (0 if major >= 0 else 1)
            k = face * sectors + min(
                int((minor / abs(major) + 1) * sectors / 2),
                sectors - 1,
            )
            shaded = blocked(field, row, columns[s], z[s], u, v)
            if z[s] >= abs(major) * high[s, k]:
                assert not shaded
                sure += 1
            elif z[s] < abs(major) * low[s, k]:
                assert shaded
                sure += 1
            else:
                first, last = walk[s, k].tolist()
                assert (
                    blocked(
                        field,
                        row,
                        columns[s],
                        z[s],
                        u,
                        v,
                        first,
                        last,
                    )
                    == shaded
                )
                walked += 1

    assert sure > 0 < walked


OPEN = load_rig("bare-wall").model_copy(update={"object_box": RIG.object_box})
COARSE = Accuracy("coarse", relay_columns=8, relay_rows=6)
UNIT_BOX = ObjectBox(
    x_min_m=0,
    x_max_m=1,
    y_min_m=0,
    y_max_m=1,
    z_near_m=0.1,
    z_far_m=1,
)


def _hit(
    depth: np.ndarray, start: list[float], towards: list[float]
) -> tuple[float, float, int, int]:
    ray = np.array(towards) - start
    field = height_field(depth, UNIT_BOX, shades=True)
    length = float(np.linalg.norm(ray))
    slope = np.zeros((2, *depth.shape))
    found = first_hits(
        field,
        slope,
        np.array(start),
        ray[None] / length,
        np.array([length]),
    )
    return float(found[0][0]) / length, float(found[1][0]), int(found[2][0]), int(found[3][0])


COLUMN = np.full((4, 4), np.nan)
COLUMN[1, 2] = 0.5  # x in 0.5 to 0.75, y in 0.5 to 0.75


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ([0.6, 0.6, 0.0], [0.6, 0.6, 1.0]),
        ([0.0, 0.6, 0.8], [1.0, 0.6, 0.8]),
    ],
    ids=["front", "side"],
)
def test_first_hits_meet_a_column(start: list[float], end: list[float]) -> None:
    assert _hit(COLUMN, start, end) == pytest.approx((0.5, 1.0, 1, 2))


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ([0.0, 0.6, 0.3], [1.0, 0.6, 0.3]),
        ([0.0, 0.2, 0.8], [1.0, 0.2, 0.8]),
        ([0.0, 0.6, 0.8], [0.4, 0.6, 0.8]),
    ],
    ids=["between object and wall", "past it", "not so far"],
)
def test_first_hits_miss_a_column(start: list[float], end: list[float]) -> None:
    assert _hit(COLUMN, start, end)[0] == np.inf


def test_sight_is_empty_in_the_paper_rig_and_refused_inside() -> None:
    assert (
        SceneFacts(
            Scene(RIG, np.full((8, 8), 0.12, np.float32)),
            COARSE,
        ).line_of_sight
        is None
    )

    box = ObjectBox(
        x_min_m=-0.1, x_max_m=0.1, y_min_m=-0.1, y_max_m=0.1, z_near_m=0.05, z_far_m=0.4
    )
    around = OPEN.model_copy(update={"object_box": box})
    with pytest.raises(SceneError, match=r"0\.2 m"):
        _ = SceneFacts(
            Scene(around, np.full((8, 8), 0.1, np.float32)),
            COARSE,
        ).line_of_sight


def test_sight_stops_beams_and_hides_relay_cells() -> None:
    depth = np.full((8, 8), 0.06, np.float32)
    stage = SceneFacts(Scene(OPEN, depth, Surface(0.5)), COARSE)
    sight = stage.line_of_sight
    beams = stage.beams()

    assert sight.beam.size
    assert sight.hidden.any()

    free = np.nan_to_num(beams.length_m[sight.beam], nan=np.inf)

    assert (sight.length_m < free).all()

    point = beams.lidar_m + sight.length_m[:, None] * beams.direction[sight.beam]

    assert (point[:, 2] >= 0.06 - 1e-9).all()
    assert (stage.relay.x_m[sight.hidden] > 0.3).all()

    ready = prepare(stage.scene, COARSE, "auto")

    np.testing.assert_allclose(ready.beams.length_m[sight.beam], sight.length_m)
    assert not ready.beams.on_wall[sight.beam].any()
    assert len(ready.job.relay.x_m) == (~sight.hidden).sum()

    white = prepare(
        Scene(OPEN, depth),
        COARSE,
        "auto",
    ).beams.direct[sight.beam]

    np.testing.assert_allclose(ready.beams.direct[sight.beam], 0.5 * white)


def test_retroreflector_in_sight_returns_its_lobe() -> None:
    depth = np.full((8, 8), 0.06, np.float32)
    coat = retroreflective(0.5, 0.5, 20)
    matt, bright, plain = (
        prepare(Scene(OPEN, depth, Surface(0.5, brdf)), COARSE, effects).beams.direct
        for brdf, effects in (
            (None, "auto"),
            (coat, "auto"),
            (coat, ["direct", "three-bounce", "line-of-sight"]),
        )
    )
    seen = SceneFacts(Scene(OPEN, depth), COARSE).line_of_sight.beam

    # 0.5 + 0.5 (n + 2) / 2 straight back, whatever the incidence
    np.testing.assert_allclose(bright[seen], 6.0 * matt[seen])
    # without the BRDF: a matt surface that gives back as much
    np.testing.assert_allclose(plain[seen], (0.5 + 0.5) * matt[seen])
    others = np.setdiff1d(np.arange(len(matt)), seen)
    np.testing.assert_array_equal(bright[others], matt[others])


UP = np.array([0.0, 0.0, 1.0])
DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def job() -> TransportJob:
    at = np.linspace(-1, 1, 6)
    depth = (0.2 - 0.06 * (at[:, None] ** 2 + at**2)).astype(np.float32)
    scene = Scene(RIG, depth, radiometry="lambertian", jump_m=0.5)
    return prepare(
        scene, Accuracy("coarse", 8, 6), ["three-bounce", "tilt", "inter-reflection"]
    ).job


@pytest.mark.parametrize("lambertian", [True, False])
def test_form_factor_of_two_squares_follows_s2(lambertian: bool) -> None:
    a = np.zeros(3)
    b = np.array([0.3, 0.0, 0.4])
    found = interreflection.form_factor(a, UP, b, DOWN, 1e-4, 1.0, 0.1, lambertian)
    expected = 1e-4 * 0.8 / 0.25 / ((np.pi / 0.8) if lambertian else 2 * np.pi)

    assert found == pytest.approx(expected)

    for back in (
        (a, DOWN, b, DOWN),
        (a, UP, b, UP),
    ):
        assert interreflection.form_factor(*back, 1e-4, 1.0, 0.1, lambertian) == 0


def test_patch_to_patch_is_reciprocal_and_loses_energy(job: TransportJob) -> None:
    # Beyond near contact.
    table = interreflection.patch_to_patch(job.patch_arrays, job.field, 1e-9, True)

    assert (table > 0).any()
    assert not np.diag(table).any()

    given = table / job.strength

    np.testing.assert_allclose(given, given.T, atol=1e-9 * given.max())

    near = interreflection.patch_to_patch(job.patch_arrays, job.field, job.near_m, True)

    assert near.sum(1).max() <= 1


@pytest.mark.parametrize(("shift", "place"), [(-8, 2), (0, 10), (5, 15), (-12, 0), (30, None)])
def test_carried_light_lands_where_its_path_says(shift: int, place: int | None) -> None:
    """Histograms begin at different bins, so a shift may be negative."""
    spike = np.zeros((1, 20), np.float32)
    spike[0, 10] = 1

    found = interreflection._carry(np.full((1, 1), 0.5), np.array([[shift]]), spike, 24)

    expected = np.zeros((1, 24), np.float32)
    if place is not None:
        expected[0, place] = 0.5
    np.testing.assert_array_equal(found, expected)


def test_wall_factors_sum_to_at_most_1(job: TransportJob) -> None:
    cells = interreflection.wall_cells(job)
    side = interreflection.WALL_CELLS

    assert len(cells) == side**2

    extent = np.ptp(cells[:, :2], axis=0) * side / (side - 1)

    assert interreflection.wall_cell_m2(job) * len(cells) == pytest.approx(extent.prod())

    there, back = interreflection.wall_factors(job, cells)

    assert 0.5 < there.sum(1).max() <= 1
    assert back.sum(0).max() <= 1


def test_brute_force_refuses_too_many_interreflections() -> None:
    scene = Scene(
        RIG,
        np.full((32, 32), 0.2, np.float32),
        radiometry="lambertian",
    )
    effects = ["three-bounce", "occluder", "tilt", "self-occlusion", "inter-reflection"]
    with pytest.raises(SceneError, match="inter-reflection"):
        three_bounce(
            scene,
            Accuracy(
                "own",
                3,
                3,
                sub_bins=0,
            ),
            effects=effects,
            chosen=np.arange(5120)[::151],
        )


@numba.njit(cache=True)
def _verdicts(surface: NumbaSurface, bounds_m: Any, optics: NumbaOptics, field: HeightField) -> Any:
    return judge(0, len(surface.x_m), surface, bounds_m, optics, field)


@pytest.mark.parametrize("surface", ["wave", "rough", "object"])
@pytest.mark.parametrize(
    "edge",
    [None, Occluder(x_m=0.43, z_min_m=0.1)],
)
def test_verdict_on_a_tile_holds_for_each_leg(surface: str, edge: Occluder | None) -> None:
    """No leg to a free tile is blocked, and no leg to a dark one carries light; either verdict is
    common.
    """
    generator = np.random.default_rng(3)
    (y, x) = np.mgrid[0:32, 0:32] / 32
    depth = {
        "wave": 0.25 + 0.06 * np.sin(20 * x) * np.cos(9 * y),
        "rough": generator.uniform(0.2, 0.3, (32, 32)),
        "object": object_depth(0, BOX, ("airplane",))[1],
    }[surface]
    rig = RIG.model_copy(update={"occluder": edge})
    effects = "direct", "three-bounce", "line-of-sight", "occluder", "self-occlusion", "tilt"
    job = prepare(
        Scene(rig, depth.astype(np.float32)),
        Accuracy("some", 40, 32),
        effects,
    ).job

    assert job is not None

    single = NumbaJob(job)
    where = job.patches
    for points in (
        single.relay,
        single.feet(np.ones(len(job.laser_spot_m))),
    ):
        verdicts = _verdicts(single.surface, points.bounds_m, *single.sites[3:])
        each = points.tile
        for s in range(0, len(where.row), 41):
            point = where.point_m[s]
            normal = where.normal[s]
            place = np.repeat(
                np.arange(len(points.bounds_m)),
                each,
            )[: len(points.x_m)]
            for tile in np.flatnonzero((verdicts[s] == FREE) | (verdicts[s] == DARK)):
                for px, py in np.stack(
                    [points.x_m, points.y_m],
                    1,
                )[place == tile][::7].astype(float):
                    facing = normal @ (np.array([px, py, 0.0]) - point)
                    seen = visible(
                        job.field,
                        where.row[s],
                        where.column[s],
                        point,
                        px,
                        py,
                    )
                    passes = seen and not occluded(
                        point[0],
                        point[2],
                        px,
                        0.0,
                        *job.edge_m,
                    )
                    if (
                        facing > 1e-5
                    ):  # legs to the back of a patch carry no light in a free tile either
                        assert passes == (verdicts[s, tile] == FREE)
        assert (verdicts == DARK).mean() > 0.02
        if surface != "rough" and edge is None:
            assert (verdicts == FREE).mean() > 0.05
