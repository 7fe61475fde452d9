"""Someone brings a shape from another program: what is hidden is what the file says."""

import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_calibration import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.objects import load_object, object_box, read_depth_map, read_mesh, triangulate

Run = Callable[..., Any]
BOX = object_box(load_rig("paper-rig"))

ANGLES = np.pi / 2 + np.arange(10) * np.pi / 5
RADII = np.where(np.arange(10) % 2, 0.4, 1.0)
STAR = np.stack([RADII * np.cos(ANGLES), RADII * np.sin(ANGLES)], 1)
# A frame as one face: around the outside, over a bridge to the hole and around that backwards.
SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]], float)
RING = np.concatenate([SQUARE, 0.6 * SQUARE[::-1]])
ARROW = np.array([[0, 1], [-0.8, -1], [0, -0.4], [0.8, -1]], float)


def area(corners: np.ndarray) -> float:
    (x, y), (next_x, next_y) = corners.T, np.roll(corners, -1, axis=0).T
    return abs(float((x * next_y - y * next_x).sum())) / 2


def as_obj(corners: np.ndarray) -> bytes:
    lines = [f"v {x} {y} 0" for x, y in corners]
    lines.append("f " + " ".join(str(k + 1) for k in range(len(corners))))
    return "\n".join(lines).encode() + b"\n"


def ply_header(vertices: int, faces: int, form: str) -> bytes:
    return (
        f"ply\nformat {form} 1.0\nelement vertex {vertices}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()


def as_text_ply(corners: np.ndarray) -> bytes:
    lines = [f"{x} {y} 0" for x, y in corners]
    lines.append(f"{len(corners)} " + " ".join(map(str, range(len(corners)))))
    return ply_header(len(corners), 1, "ascii") + "\n".join(lines).encode() + b"\n"


def as_binary_ply(corners: np.ndarray) -> bytes:
    points = np.column_stack([corners, np.zeros(len(corners))]).astype("<f4").tobytes()
    face = struct.pack(f"<B{len(corners)}i", len(corners), *range(len(corners)))
    return ply_header(len(corners), 1, "binary_little_endian") + points + face


@pytest.mark.parametrize("corners", [STAR, RING, ARROW], ids=["star", "ring", "arrow"])
@pytest.mark.parametrize(
    ("name", "write"),
    [("a.obj", as_obj), ("a.ply", as_text_ply), ("b.ply", as_binary_ply)],
    ids=["obj", "text ply", "binary ply"],
)
def test_polygon_covers_its_own_area(
    tmp_path: Path, name: str, write: Callable[[np.ndarray], bytes], corners: np.ndarray
) -> None:
    path = tmp_path / name
    path.write_bytes(write(corners))

    covered = np.isfinite(load_object(str(path), BOX).depth_m)
    rows = covered.any(1).sum()
    columns = covered.any(0).sum()

    share_of_square = area(corners) / np.prod(np.ptp(corners, axis=0))

    assert covered.sum() / (rows * columns) == pytest.approx(share_of_square, abs=0.04)


def test_zero_in_a_depth_map_is_background(tmp_path: Path) -> None:
    row, column = np.mgrid[:64, :64]
    disc = np.hypot(row - 31.5, column - 31.5) < 20
    np.save(tmp_path / "disc.npy", np.where(disc, 0.16, 0.0))

    loaded = load_object(str(tmp_path / "disc.npy"), BOX)

    np.testing.assert_array_equal(np.isfinite(loaded.depth_m), disc)
    assert f"{(~disc).sum()} cells" in loaded.warnings[0]


def test_depth_map_nearer_than_the_box_is_refused(tmp_path: Path) -> None:
    depth_m = np.full((64, 64), 0.2)
    depth_m[:2] = 0.01
    np.save(tmp_path / "near.npy", depth_m)

    with pytest.raises(SceneError, match="128 of 4096 cells"):
        load_object(str(tmp_path / "near.npy"), BOX)


def test_depth_map_behind_the_box_is_named(tmp_path: Path) -> None:
    depth_m = np.full((64, 64), BOX.z_far_m, np.float32)
    np.save(tmp_path / "back.npy", depth_m)
    depth_m[:2] = 0.5
    np.save(tmp_path / "behind.npy", depth_m)

    assert load_object(str(tmp_path / "back.npy"), BOX).warnings == ()
    assert "128 of its 4096 cells" in load_object(str(tmp_path / "behind.npy"), BOX).warnings[0]


@pytest.mark.parametrize("line_end", ["\n   ", "\n\t", "\r"], ids=["blanks", "tab", "old Mac"])
def test_obj_laid_out_otherwise_is_read(tmp_path: Path, line_end: str) -> None:
    lines = ["v 0 0 0", "v 1 0 0", "v 1 1 0", "v 0 1 0", "f -4 -3 -2 -1", ""]
    path = tmp_path / "square.obj"
    path.write_bytes(line_end.join(lines).encode())

    assert read_mesh(path).triangles.shape == (2, 3, 3)


def test_face_without_corners_is_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "star.ply"
    path.write_bytes(as_text_ply(STAR).replace(b"element face 1", b"element face 2") + b"0\n")
    alone = tmp_path / "alone.ply"
    alone.write_bytes(as_text_ply(STAR))

    assert len(triangulate(np.empty((0, 3)))) == 0
    np.testing.assert_array_equal(read_mesh(path).triangles, read_mesh(alone).triangles)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes")
@pytest.mark.parametrize("name", ["pipe.obj", "pipe.npy"])
def test_pipe_in_place_of_a_shape_is_refused(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    read = read_depth_map if name.endswith("npy") else read_mesh

    with pytest.raises(SceneError, match="not a file"):
        read(tmp_path / name)


def test_stray_face_far_away_is_named(tmp_path: Path) -> None:
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += ["v 30 0 0", "v 30.001 0 0", "v 30 0.001 0"]
    lines += ["f 1 3 4 2", "f 5 6 8 7", "f 1 2 6 5", "f 3 7 8 4", "f 1 5 7 3", "f 2 4 8 6"]
    lines.append("f 9 10 11")
    (tmp_path / "cube.obj").write_text("\n".join(lines), encoding="utf-8")

    warnings = " ".join(load_object(str(tmp_path / "cube.obj"), BOX).warnings)

    assert "cells of the object box" in warnings
    assert "1 of its 13 faces" in warnings


def test_whole_shape_has_no_warning(tmp_path: Path) -> None:
    (tmp_path / "star.obj").write_bytes(as_obj(STAR))

    assert load_object(str(tmp_path / "star.obj"), BOX).warnings == ()


def stl(count: int, faces: int, tail: bytes = b"") -> bytes:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
    face = bytes(12) + corners.tobytes() + bytes(2)
    return bytes(80) + count.to_bytes(4, "little") + face * faces + tail


@pytest.mark.parametrize("content", [stl(0, 2), stl(2, 2, b"made by a program\0\0")])
def test_stl_with_a_wrong_count_or_a_tail_is_read(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "part.stl").write_bytes(content)

    assert np.isfinite(load_object(str(tmp_path / "part.stl"), BOX).depth_m).any()


def test_triangle_strips_are_read(tmp_path: Path) -> None:
    header = (
        "ply\nformat ascii 1.0\nelement vertex 4\n"
        "property float x\nproperty float y\nproperty float z\n"
        "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    )
    body = "0 0 0\n1 0 0\n0 1 0\n1 1 0\n4 0 1 2 3\n"
    (tmp_path / "strip.ply").write_text(header + body, encoding="utf-8")

    covered = np.isfinite(load_object(str(tmp_path / "strip.ply"), BOX).depth_m)

    assert covered.sum() == covered.any(1).sum() * covered.any(0).sum()


def test_decimal_commas_are_named(tmp_path: Path) -> None:
    lines = "v 0,0 0,0 0,0\nv 1,5 0,0 0,0\nv 0,0 1,5 0,0\nf 1 2 3\n"
    (tmp_path / "comma.obj").write_text(lines, encoding="utf-8")

    with pytest.raises(SceneError, match="comma"):
        load_object(str(tmp_path / "comma.obj"), BOX)


def test_every_broken_mesh_of_a_folder_is_named_at_once(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "meshes"
    folder.mkdir()
    (folder / "good.obj").write_bytes(as_obj(STAR))
    for name in ("one.obj", "two.stl"):
        (folder / name).write_bytes(b"not a mesh")

    answer = run(
        "dataset", "build", "--objects", folder, "--count", 2, "--out", tmp_path / "maps", code=4
    )

    assert "one.obj" in answer.err
    assert "two.stl" in answer.err
