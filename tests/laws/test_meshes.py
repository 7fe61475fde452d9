"""Laws of meshes: format, unit, axes and order of faces do not change the depth map, which is
itself a mesh.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration.rig import ObjectBox, load_rig
from trimesh.exchange.ply import export_ply
from trimesh.transformations import rotation_matrix

from nlos_cam.objects.depth_map import cell_centers_m, orthographic_depth
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.meshes import read_mesh, turn_upright
from nlos_cam.objects.placement import Pose, category_triangles, object_depth, place

BOX: ObjectBox = load_rig("paper-rig").object_box
POSE = Pose(
    tilt_x_rad=0.2,
    tilt_y_rad=-0.3,
    turn_z_rad=0.4,
    size_m=0.19,
    x_m=0.01,
    y_m=-0.02,
)
EXPORTS: dict[str, Callable[[trimesh.Trimesh], bytes]] = {
    "text.obj": lambda mesh: mesh.export(file_type="obj", digits=12).encode(),
    "binary.stl": lambda mesh: mesh.export(file_type="stl"),
    "text.stl": lambda mesh: mesh.export(file_type="stl_ascii").encode(),
    "binary.ply": lambda mesh: export_ply(mesh, "binary"),
    "text.ply": lambda mesh: export_ply(mesh, "ascii"),
}
SINGLE_M = 2e-6
"""Depth that single precision of a file's vertices may move, on a surface as steep as 10."""
Triangles = np.ndarray


def _mesh(triangles: Triangles) -> trimesh.Trimesh:
    return trimesh.Trimesh(
        triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), process=False
    )


def _depth(triangles: Triangles, pose: Pose = POSE) -> np.ndarray:
    return orthographic_depth(place(triangles, pose, BOX), BOX)


def _assert_same(depth: np.ndarray, other: np.ndarray) -> None:
    """The same but for rounding: it may decide a few cells that an edge runs through, and no
    others.
    """
    differs = ~np.isclose(
        depth,
        other,
        rtol=0,
        atol=SINGLE_M,
        equal_nan=True,
    )
    assert differs.sum() <= 3
    assert np.isfinite(depth).sum() > 100
    padded = np.pad(
        np.nan_to_num(depth, nan=1.0),
        1,
        mode="edge",
    )
    around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    assert (np.ptp(around, axis=(2, 3))[differs] > 0.001).all()


@pytest.mark.parametrize("category", CATEGORIES)
def test_mesh_written_and_read_back_keeps_its_depth_map(tmp_path: Path, category: str) -> None:
    triangles = category_triangles(category, 3)
    for name, export in EXPORTS.items():
        (tmp_path / name).write_bytes(export(_mesh(triangles)))
        _assert_same(_depth(read_mesh(tmp_path / name).triangles), _depth(triangles))


@pytest.mark.parametrize("name", ["text.obj", "binary.stl", "binary.ply"])
@pytest.mark.parametrize("unit", [1e-3, 0.0254, 1000.0, 1e12])
def test_unit_of_a_file_does_not_matter(tmp_path: Path, name: str, unit: float) -> None:
    triangles = category_triangles("cup", 1)
    (tmp_path / name).write_bytes(EXPORTS[name](_mesh(triangles * unit)))

    _assert_same(_depth(read_mesh(tmp_path / name).triangles), _depth(triangles))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    st.floats(-6, 6), st.tuples(*[st.floats(-1e3, 1e3)] * 3), st.sampled_from(sorted(CATEGORIES))
)
def test_scale_and_origin_of_a_mesh_do_not_matter(
    exponent: float, origin: tuple[float, ...], category: str
) -> None:
    triangles = category_triangles(category, 5)
    _assert_same(_depth((triangles + origin) * 10.0**exponent), _depth(triangles))


@pytest.mark.parametrize("category", CATEGORIES)
def test_quarter_turn_about_z_turns_the_depth_map(category: str) -> None:
    """Counter-clockwise, as the map shows x to the right and y up."""
    triangles = category_triangles(category, 2)
    quarter = triangles @ rotation_matrix(np.pi / 2, (0, 0, 1))[:3, :3].T
    still = Pose(size_m=0.2)
    turned = Pose(size_m=0.2, turn_z_rad=np.pi / 2)

    _assert_same(_depth(triangles, turned), np.rot90(_depth(triangles, still)))
    _assert_same(_depth(quarter, still), np.rot90(_depth(triangles, still)))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    st.integers(0, 2**31),
    st.sampled_from(sorted(CATEGORIES)),
)
def test_winding_order_and_repetition_of_faces_do_not_matter(seed: int, category: str) -> None:
    generator = np.random.default_rng(seed)
    triangles = category_triangles(category, 4)
    corners = generator.permuted(
        np.tile(np.arange(3), (len(triangles), 1)),
        axis=1,
    )
    shuffled = np.take_along_axis(triangles, corners[..., None], axis=1)[
        generator.permutation(len(triangles))
    ]

    _assert_same(
        _depth(np.concatenate([shuffled, shuffled[:50]])),
        _depth(triangles),
    )


def test_mesh_with_z_up_equals_the_same_with_y_up(tmp_path: Path) -> None:
    triangles = category_triangles("airplane", 1)
    z_up = triangles @ rotation_matrix(np.pi / 2, (1, 0, 0))[:3, :3].T
    (tmp_path / "thing.stl").write_bytes(EXPORTS["binary.stl"](_mesh(z_up)))
    read = read_mesh(tmp_path / "thing.stl").triangles

    _assert_same(_depth(turn_upright(read, "z")), _depth(triangles))
    assert not np.allclose(
        _depth(turn_upright(read, "y")), _depth(triangles), atol=1e-3, equal_nan=True
    )


def _plates(depth_m: np.ndarray) -> Triangles:
    """A level plate over each cell of a depth map that is surface."""
    pixels = len(depth_m)
    x, y = cell_centers_m(BOX, pixels)
    half_x = (x[1] - x[0]) / 2
    half_y = (y[0] - y[1]) / 2
    row, column = np.nonzero(~np.isnan(depth_m))
    signs = np.array(
        [
            [
                (-1, -1),
                (1, -1),
                (1, 1),
            ],
            [
                (-1, -1),
                (1, 1),
                (-1, 1),
            ],
        ]
    )
    corners = np.empty((len(row), 2, 3, 3))
    corners[..., 0] = x[column][:, None, None] + signs[..., 0] * half_x
    corners[..., 1] = y[row][:, None, None] + signs[..., 1] * half_y
    corners[..., 2] = depth_m[row, column][:, None, None]
    return corners.reshape(-1, 3, 3)


def _sheet(depth_m: np.ndarray) -> Triangles:
    """The surface through the centres of the cells: two triangles for every four neighbours that
    are surface.
    """
    x, y = np.meshgrid(*cell_centers_m(BOX, len(depth_m)))
    point = np.stack([x, y, depth_m], axis=-1)
    a = point[:-1, :-1]
    b = point[:-1, 1:]
    c = point[1:, 1:]
    d = point[1:, :-1]
    both = np.stack(
        [
            np.stack([a, b, c], axis=2),
            np.stack([a, c, d], axis=2),
        ],
        axis=2,
    ).reshape(-1, 3, 3)
    return both[~np.isnan(both).any(axis=(1, 2))]


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [8, 64, 256])
@pytest.mark.parametrize("name", [None, *EXPORTS])
def test_plates_of_a_depth_map_rasterize_back_to_it(
    tmp_path: Path, pixels: int, name: str | None
) -> None:
    """Within single precision, cell by cell: no map is too ragged."""
    generator = np.random.default_rng(pixels)
    depth = generator.uniform(
        BOX.z_near_m,
        BOX.z_far_m,
        (pixels, pixels),
    ).astype(np.float32)
    depth[generator.uniform(size=depth.shape) < 0.5] = np.nan
    triangles = _plates(depth)
    if name:
        (tmp_path / name).write_bytes(EXPORTS[name](_mesh(triangles)))
        triangles = read_mesh(tmp_path / name).triangles

    np.testing.assert_allclose(
        orthographic_depth(triangles, BOX, pixels),
        depth,
        rtol=0,
        atol=1e-7,
    )


def test_sheet_through_a_depth_map_rasterizes_back_to_it() -> None:
    """In every cell that has three neighbours of a square; the others are in no triangle."""
    for seed in range(20):
        depth = object_depth(seed, BOX)[1]
        sheet = orthographic_depth(_sheet(depth), BOX)
        drawn = ~np.isnan(sheet)
        np.testing.assert_allclose(
            sheet[drawn],
            depth[drawn],
            rtol=0,
            atol=1e-7,
        )
        lost = ~drawn & ~np.isnan(depth)
        assert lost.sum() < 0.1 * drawn.sum()


def test_placing_a_placed_mesh_moves_nothing() -> None:
    placed = place(category_triangles("hat", 2), POSE, BOX)
    again = place(
        placed,
        Pose(
            size_m=POSE.size_m,
            x_m=POSE.x_m,
            y_m=POSE.y_m,
            front_m=POSE.front_m,
        ),
        BOX,
    )

    np.testing.assert_allclose(again, placed, atol=1e-12)
