import csv
import logging
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from nlos_calibration import ObjectBox, load_rig
from trimesh.exchange.ply import export_ply

from nlos_cam.errors import NlosCamError, SceneError
from nlos_cam.objects import find_category, load_object
from nlos_cam.objects import meshes as files
from nlos_cam.objects.depth_map import cell_centers_m, object_box, orthographic_depth
from nlos_cam.objects.meshes import (
    POSES,
    MeshFile,
    check_visible,
    folder_objects,
    mesh_depth,
    plain,
    read_depth_map,
    read_mesh,
)
from nlos_cam.objects.placement import Pose, category_triangles, place, random_pose
from nlos_cam.objects.surface_mesh import JUMP_M, SurfaceMesh, mesh_from_depth

SOLID = trimesh.creation.torus(0.3, 0.1, major_sections=9, minor_sections=5)
EXPORTS = {
    "text.obj": SOLID.export(file_type="obj").encode(),
    "binary.stl": SOLID.export(file_type="stl"),
    "text.stl": SOLID.export(file_type="stl_ascii").encode(),
    "binary.ply": export_ply(SOLID, "binary"),
    "text.ply": export_ply(SOLID, "ascii"),
}
VERTICES = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
SQUARE = np.array(
    [
        [0, 0, 0],
        [1, 0, 0],
        [1, 1, 0],
        [0, 1, 0],
    ],
    float,
)
PLY = (
    b"ply\nformat ascii 1.0\ncomment TextureFile none.png\nelement vertex 4\n"
    b"property float x\nproperty float y\nproperty float z\nproperty float s\nproperty float t\n"
    b"element face 2\nproperty list uchar int vertex_indices\n"
    b"element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n"
    b"0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n0 1 0 0 1\n3 0 1 2\n3 0 2 3\n0 1\n"
)
UNREADABLE = "string or file could not be read to its end due to unmatched data"
WITHOUT_EXTRAS = """
import sys
from importlib.machinery import PathFinder
blocked = {"PIL", "networkx", "scipy", "lxml", "charset_normalizer", "chardet", "shapely", "rtree"}
find = PathFinder.find_spec
PathFinder.find_spec = lambda name, *rest: None if name.split(".")[0] in blocked else find(name, *rest)
from pathlib import Path
from nlos_cam.objects.meshes import read_mesh
print(*(len(read_mesh(Path(name)).triangles) for name in sys.argv[1:]))
assert not blocked & set(sys.modules)
"""


def _write(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def _assert_refused(
    path: Path,
    word: str,
    read: Callable[[Path], object] = read_mesh,
) -> None:
    """The error is one line that begins with the path and holds the word."""
    with pytest.raises(SceneError) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))
    assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def _read(folder: Path, name: str, content: bytes) -> MeshFile:
    return read_mesh(_write(folder, name, content))


@pytest.mark.parametrize("name", EXPORTS)
@pytest.mark.parametrize("letters", ["lower", "upper"])
def test_read_mesh_gives_the_same_triangles_for_every_format(
    tmp_path: Path, name: str, letters: str
) -> None:
    mesh = _read(tmp_path, getattr(name, letters)(), EXPORTS[name])
    np.testing.assert_allclose(mesh.triangles, SOLID.triangles, atol=1e-6)


def test_read_mesh_needs_no_optional_package(tmp_path: Path) -> None:
    """Reads materials, textures, edges and non-ASCII names without any optional package."""
    names = [
        str(
            _write(
                tmp_path,
                name,
                content,
            )
        )
        for name, content in EXPORTS.items()
    ]
    faces = (
        b"mtllib none.mtl\nusemtl fa\xe7ade\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf 1//1 3//1"
        b" 4//1\n"
    )
    names += [
        str(_write(tmp_path, "square.obj", VERTICES + faces)),
        str(_write(tmp_path, "square.ply", PLY)),
    ]
    command = [sys.executable, "-c", WITHOUT_EXTRAS, *names]
    done = subprocess.run(command, capture_output=True, text=True, check=False)

    assert done.stdout.split() == [str(len(SOLID.faces))] * 5 + ["2", "2"]
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("warning", "is_damage"),
    [(UNREADABLE, True), ("old fashioned", False)],
)
def test_read_mesh_is_silent_and_refuses_unreadable_numbers(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    warning: str,
    is_damage: bool,
) -> None:
    """An older numpy only warns about unreadable numbers and returns those before them."""
    before = logging.getLogger("trimesh").level
    load = trimesh.load_scene

    def wordy(*arguments: object, **named: object) -> object:
        logging.getLogger("trimesh").error("look at me")
        warnings.warn(warning, DeprecationWarning, stacklevel=1)
        return load(*arguments, **named)

    monkeypatch.setattr(trimesh, "load_scene", wordy)
    if is_damage:
        _assert_refused(_write(tmp_path, "thing.stl", EXPORTS["text.stl"]), "")
    else:
        assert len(
            _read(
                tmp_path,
                "thing.stl",
                EXPORTS["text.stl"],
            ).triangles
        ) == len(SOLID.faces)

    assert not caplog.records
    assert logging.getLogger("trimesh").level == before


@pytest.mark.parametrize(
    ("faces", "corners"),
    [
        (b"f 1 2 3 4\n", [[0, 1, 2], [0, 2, 3]]),
        (
            b"f 1 2 3\nf 1 2 3 4\n",
            [
                [0, 1, 2],
                [0, 1, 2],
                [0, 2, 3],
            ],
        ),
        (b"f -4 -3 -2\n", [[0, 1, 2]]),
        (b"o a\nf 1 2 3\no b\nusemtl c\nf 1 3 4\n", [[0, 1, 2], [0, 2, 3]]),
        (b"v nan inf 1e300\nf 1 2 3\n", [[0, 1, 2]]),  # a vertex of no face
    ],
)
def test_read_mesh_joins_faces_of_every_kind(
    tmp_path: Path, faces: bytes, corners: list[list[int]]
) -> None:
    triangles = {
        t.tobytes()
        for t in np.sort(
            _read(tmp_path, "thing.obj", VERTICES + faces).triangles,
            axis=1,
        )
    }
    assert triangles == {
        t.tobytes()
        for t in np.sort(
            SQUARE[np.array(corners)],
            axis=1,
        )
    }


def test_read_mesh_joins_parts_and_equals_by_path_and_content(tmp_path: Path) -> None:
    other = b"v 5 0 0\nv 6 0 0\nv 6 1 0\nf -3 -2 -1\n"
    mesh = _read(tmp_path, "thing.obj", VERTICES + b"f -4 -3 -2\n" + other)

    assert sorted(mesh.triangles[..., 0].max(1)) == [1, 6]
    assert len(
        _read(
            tmp_path,
            "two.stl",
            EXPORTS["text.stl"] * 2,
        ).triangles
    ) == 2 * len(SOLID.faces)

    mesh = _read(tmp_path, "thing.stl", EXPORTS["binary.stl"])

    assert _read(tmp_path, "thing.stl", EXPORTS["binary.stl"]) == mesh
    assert _read(tmp_path, "other.stl", EXPORTS["binary.stl"]).sha256 == mesh.sha256
    assert _read(tmp_path, "thing.stl", EXPORTS["text.stl"]) != mesh


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("thing.glb", b"glTF", ".ply"),
        ("points.ply", trimesh.PointCloud(SQUARE).export(file_type="ply"), "faces"),
        ("short.stl", EXPORTS["text.stl"][:900], "faces"),
        ("short.ply", PLY[: PLY.rindex(b"3 ")], ""),
        ("shorter.ply", PLY[: PLY.rindex(b"0 2 3")], ""),
        *[
            (name, content, "faces")
            for name, content in (
                ("a.obj", VERTICES),
                ("a.obj", b""),
                ("a.stl", b""),
            )
        ],
        ("none.stl", bytes(84), "faces"),
        ("empty.ply", b"", ".ply"),
        ("cut.stl", EXPORTS["binary.stl"][:900], "900"),
        ("odd.stl", bytes(80) + b"\2\0\0\0" + bytes(60), "184"),
        ("cut.ply", EXPORTS["binary.ply"][:900], ""),
        ("word.obj", VERTICES.replace(b"v 1", b"v one") + b"f 1 2 3\n", ""),
        ("wide.obj", "v 0 0 0".encode("utf-16"), ""),
        ("word.stl", EXPORTS["text.stl"].replace(b"vertex ", b"vertex x", 1), ""),
        *[
            ("face.obj", VERTICES + b"f " + face, "")
            for face in (b"1 2 9", b"1 2 -5", b"1/1 0/2 3/3", b"1 00 2")
        ],
        *[
            (
                "face.ply",
                PLY.replace(b"3 0 2 3", face),
                "",
            )
            for face in (b"3 0 2 4", b"3 0 2 -1")
        ],
        *[
            ("far.obj", VERTICES + b"v " + x + b" 0 0\nf 1 2 5\n", "NaN")
            for x in (b"nan", b"1e200")
        ],
        ("inf.ply", PLY.replace(b"1 1 0 1", b"1 inf 0 1"), "NaN"),
        *[
            ("flat.obj", VERTICES + b"v 2 0 0\nf " + face, "area")
            for face in (b"1 2 5\n", b"2 2 2\n")
        ],
    ],
)
def test_read_mesh_refuses_damaged_files(
    tmp_path: Path, name: str, content: bytes, word: str
) -> None:
    _assert_refused(_write(tmp_path, name, content), word)


@pytest.mark.parametrize("name", ["none.obj", "none.stl", "none.ply", "none.npy"])
def test_reader_names_a_missing_file_and_a_folder(tmp_path: Path, name: str) -> None:
    read = read_depth_map if name.endswith("npy") else read_mesh

    _assert_refused(tmp_path / name, "No such file", read)

    (tmp_path / name).mkdir()

    _assert_refused(tmp_path / name, "directory", read)


@pytest.mark.parametrize(
    ("limit", "value", "word"),
    [
        ("MAX_FACES", 89, "89"),
        ("MAX_BYTES", 99, "MiB"),
    ],
)
def test_read_mesh_refuses_too_large_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, value: int, word: str
) -> None:
    monkeypatch.setattr(files, limit, value)
    _assert_refused(_write(tmp_path, "thing.stl", EXPORTS["binary.stl"]), word)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(sorted(EXPORTS)), st.data())
def test_read_mesh_raises_scene_errors_only_on_damage(
    tmp_path: Path, name: str, data: st.DataObject
) -> None:
    content = bytearray(EXPORTS[name])
    place = data.draw(st.integers(0, len(content) - 1))
    content[place : place + data.draw(st.integers(0, 40))] = data.draw(st.binary(max_size=40))
    try:
        mesh = _read(tmp_path, name, bytes(content))
    except SceneError as error:
        assert "\n" not in str(error)  # noqa: PT017  damage that leaves a mesh is none
    else:
        assert np.isfinite(mesh.triangles).all()


@pytest.mark.parametrize(
    ("odd", "usual"),
    [
        (b"\xef\xbb\xbfv 0 0 0\n", b"v 0 0 0\n"),
        (b"v\t0\t0 0\r\nf 1 2 3\r\n", b"v 0 0 0\nf 1 2 3\n"),
        (b"o fa\xe7ade\nv 0 0 0\n", b"o fa?ade\nv 0 0 0\n"),
        (b"v 0 0 0# the first\n# a line\n", b"v 0 0 0\n\n"),
        (b"f 1 2 \\\n3\n", b"f 1 2  3\n"),
        *[(text, text) for text in (b"v -1e-5 0 -2\nf 10 20 30\n", b"f 1/0 2/0 3/0", b"f 1 2 05")],
        (
            2 * (VERTICES + b"f -4 -3/-1 -2/-1/-1\n"),
            VERTICES + b"f 1 2/-1 3/-1/-1\n" + VERTICES + b"f 5 6/-1 7/-1/-1\n",
        ),
    ],
)
def test_plain_makes_odd_obj_text_usual(odd: bytes, usual: bytes) -> None:
    assert plain(odd, ".obj") == usual


@pytest.mark.parametrize("odd", [b"0", b"1 0", b"2 0 1"])
def test_face_without_three_corners_takes_no_other_with_it(tmp_path: Path, odd: bytes) -> None:
    content = PLY.replace(b"element face 2", b"element face 3").replace(
        b"3 0 2 3\n", odd + b"\n3 0 2 3\n"
    )

    assert len(_read(tmp_path, "odd.ply", content).triangles) == 2


def test_plain_renames_ply_edges_and_keeps_binary_bodies() -> None:
    body = b"\n\0element edge 7"

    assert (
        plain(b"ply\nelement edge 2\nend_header" + body, ".ply")
        == b"ply\nelement wire 2\nend_header" + body
    )

    stl = bytes(80) + (1).to_bytes(4, "little") + b"\t#\xe7\r\n" * 10

    assert plain(stl, ".stl") == stl


@pytest.mark.parametrize(
    "dtype",
    [
        "f2",
        "f4",
        "f8",
        "g",
        ">f4",
        "i1",
        "u1",
        "i2",
        ">i4",
        "i8",
        "u8",
    ],
)
@pytest.mark.parametrize("size", [8, 64, 256])
def test_read_depth_map_takes_every_real_type_and_size(
    tmp_path: Path, dtype: str, size: int
) -> None:
    depth = (
        np.arange(size * size).reshape(size, size) % 4 / (1 if np.dtype(dtype).kind in "iu" else 8)
    )
    if dtype == "f2":
        depth[:] = np.nan  # an empty object
    np.save(
        tmp_path / "map.npy",
        depth.astype(dtype, order="F" if dtype == "f8" else "C"),
    )
    read = read_depth_map(tmp_path / "map.npy")

    np.testing.assert_array_equal(read, depth)
    assert read.dtype == np.float32
    assert type(read) is np.ndarray
    assert read.flags.c_contiguous or dtype == "f8"


def _map(
    value: complex,
    shape: tuple[int, ...] = (16, 16),
    dtype: str = "f8",
) -> np.ndarray:
    depth = np.full(shape, 0.3, dtype)
    depth.reshape(-1)[:1] = value
    return depth


@pytest.mark.parametrize(
    ("depth", "word"),
    [
        (_map(-0.01), "-0.01 m"),
        (_map(300), "300 m"),
        (_map(300, dtype="u2"), "300 m"),
        (_map(np.inf), "inf m"),
        (_map(-np.inf, dtype="f2"), "-inf m"),
        *[
            (_map(0.3, s), str(s))
            for s in (
                (16,),
                (16, 16, 1),
                (16, 17),
                (7, 7),
                (257, 257),
                (),
            )
        ],
        (_map(0.3, (0, 0)), ""),
        (_map(0.3, dtype="c8"), "complex64"),
        (_map(True, dtype="?"), "bool"),
        (np.full((16, 16), "a"), "U1"),
        (np.full((16, 16), None), ""),
        (np.zeros((16, 16), "M8[s]"), "datetime"),
        (
            np.zeros((16, 16), [("depth_m", "f4")]),
            "depth_m",
        ),
    ],
)
def test_read_depth_map_refuses_other_arrays(tmp_path: Path, depth: np.ndarray, word: str) -> None:
    np.save(tmp_path / "map.npy", depth, allow_pickle=True)
    _assert_refused(tmp_path / "map.npy", word, read_depth_map)


def test_read_depth_map_refuses_damaged_files_and_archives(tmp_path: Path) -> None:
    np.save(path := tmp_path / "map.npy", _map(0.3))
    content = path.read_bytes()
    claims_too_much = content.replace(b"(16, 16), }            ", b"(1600000, 1600000), }  ")

    assert claims_too_much != content

    for damaged in (
        claims_too_much,
        *(content[:cut] + junk for cut in (0, 5, 60, 128, 400) for junk in (b"", b"hello")),
    ):
        _assert_refused(_write(tmp_path, "map.npy", damaged), "", read_depth_map)
    np.savez(tmp_path / "maps.npz", depth_m=_map(0.3))

    _assert_refused(tmp_path / "maps.npz", "", read_depth_map)


BOX = object_box(load_rig("paper-rig"))
TORUS = trimesh.creation.torus(30, 10, major_sections=16, minor_sections=8)


def _save(path: Path, mesh: trimesh.Trimesh = TORUS) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path, file_type=path.suffix[1:].lower())
    return path


def test_folder_objects_sorts_meshes_and_refuses_other_paths(
    tmp_path: Path,
) -> None:
    tmp_path /= ".cache"  # a hidden folder named on purpose is searched
    names = ["b.obj", "a/z.STL", "a/deep/er/y.ply", "c/x.stl"]
    for name in names:
        _save(tmp_path / name)
    for other in ("readme.txt", ".hidden/w.stl", "._b.obj", "a/picture.png"):
        (tmp_path / other).parent.mkdir(exist_ok=True)
        (tmp_path / other).write_bytes(b"no mesh")
    (tmp_path / "folder.obj").mkdir()
    found = [path.relative_to(tmp_path).as_posix() for path in folder_objects(tmp_path)]

    assert found == ["a/deep/er/y.ply", "a/z.STL", "b.obj", "c/x.stl"]

    (tmp_path / "empty" / "sub").mkdir(parents=True)
    for path in (tmp_path / "gone", _save(tmp_path / "a.stl"), tmp_path / "empty"):
        with pytest.raises(SceneError, match=str(path)):
            folder_objects(path)


def test_mesh_depth_reads_one_mesh_at_one_pose_per_seed(tmp_path: Path) -> None:
    meshes = [
        _save(tmp_path / "a.stl"),
        _save(tmp_path / "b.ply", trimesh.creation.box((3, 2, 1))),
    ]
    read = Mock(wraps=read_mesh)
    made = [
        mesh_depth(
            seed,
            meshes,
            BOX,
            read=read,
        )
        for seed in range(12)
    ]

    assert [path for path, _ in made] == [call.args[0] for call in read.call_args_list]
    assert {path for path, _ in made} == set(meshes)
    assert len({depth.tobytes() for _, depth in made}) == 12

    for seed, (path, depth) in enumerate(made):
        again = mesh_depth(seed, meshes, BOX, read=read_mesh)
        assert again[0] == path
        np.testing.assert_array_equal(again[1], depth)
        assert depth.shape == (64, 64)
        assert BOX.z_near_m - 1e-6 <= np.nanmin(depth) <= np.nanmax(depth) <= BOX.z_far_m + 1e-6
        assert 0.03 < np.isfinite(depth).mean() < 0.85
        lying = mesh_depth(seed, meshes, BOX, up="z", read=read_mesh)[1]
        assert not np.array_equal(lying, depth, equal_nan=True)


def test_mesh_depth_names_a_broken_or_invisible_mesh(tmp_path: Path) -> None:
    (tmp_path / "broken.ply").write_bytes(b"ply\nnothing")
    with pytest.raises(SceneError, match=r"broken\.ply"):
        mesh_depth(0, folder_objects(tmp_path), BOX, read=read_mesh)
    needle = trimesh.Trimesh(
        [
            [0, 0, 0],
            [0, 1, 0],
            [1e-5, 0.5, 0],
        ],
        [[0, 1, 2]],
        process=False,
    )
    path = _save(tmp_path / "needle.ply", needle)
    with pytest.raises(SceneError, match=r"needle\.ply"):
        mesh_depth(0, [path], BOX, read=read_mesh)
    with pytest.raises(SceneError, match=r"needle\.ply"):
        check_visible(read_mesh(path), BOX)


def test_mesh_depth_draws_another_pose_for_an_edge_on_sheet(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    along_the_sight = Pose()
    others = (
        random_pose(
            np.random.default_rng(seed),
            BOX,
        )
        for seed in range(POSES)
    )
    monkeypatch.setattr(files, "random_pose", drawn := Mock(side_effect=[along_the_sight, *others]))
    lying = np.array(
        [
            [
                [0, 0, 0],
                [1, 0, 0],
                [0, 0, 1],
            ],
            [
                [1, 0, 0],
                [1, 0, 1],
                [0, 0, 1],
            ],
        ],
        np.float64,
    )
    _, depth_m = mesh_depth(
        3,
        ["sheet"],
        BOX,
        read=lambda name: MeshFile(Path(name), "", lying),
    )

    assert 1 < drawn.call_count <= POSES
    assert np.isfinite(depth_m).any()


POSE = Pose(size_m=0.15, tilt_y_rad=0.3)


def test_load_object_places_a_category_and_a_mesh_alike(tmp_path: Path) -> None:
    triangles = category_triangles("cup", 4)
    corners = triangles.reshape(-1, 3)
    mesh = trimesh.Trimesh(
        corners,
        np.arange(len(corners)).reshape(-1, 3),
        process=False,
    )
    mesh.export(tmp_path / "cup.stl")
    expected = orthographic_depth(place(triangles, POSE, BOX), BOX)
    loaded = load_object("cup", BOX, POSE, seed=4)

    np.testing.assert_array_equal(loaded.depth_m, expected)
    assert loaded.warnings == ()
    np.testing.assert_allclose(
        load_object(str(tmp_path / "cup.stl"), BOX, POSE).depth_m, expected, atol=1e-4
    )


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("cupp", "Did you mean 'cup'?"),
        ("teapot", "tower"),
        ("cup.glb", ".stl"),
    ],
)
def test_load_object_suggests_the_nearest_category(name: str, hint: str) -> None:
    with pytest.raises(SceneError) as caught:
        load_object(name, BOX)

    assert name in str(caught.value)
    assert hint in str(caught.value)

    with pytest.raises(SceneError, match="Did you mean 'airplane'"):
        find_category("aeroplane")


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("cup", {"up": "z"}),
        ("a.stl", {"seed": 1}),
        ("a.npy", {"pose": POSE}),
    ],
)
def test_load_object_refuses_arguments_that_do_not_apply(
    name: str, arguments: dict[str, object]
) -> None:
    with pytest.raises(SceneError, match="seed is for categories"):
        load_object(name, BOX, **arguments)  # type: ignore[arg-type]


def test_load_object_refuses_a_plate_seen_edge_on(tmp_path: Path) -> None:
    plate = tmp_path / "plate.obj"
    plate.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n", encoding="utf-8")
    with pytest.raises(SceneError, match=r"plate\.obj"):
        load_object(str(plate), BOX, Pose(tilt_y_rad=np.pi / 2))


SMALL_BOX = ObjectBox(
    x_min_m=0.0, x_max_m=0.16, y_min_m=-0.1, y_max_m=0.06, z_near_m=0.1, z_far_m=0.6
)
NAN = np.float32(np.nan)
DEPTHS = arrays(
    np.float32,
    (8, 8),
    elements=st.one_of(
        st.just(NAN),
        st.floats(0.125, 0.25, width=32),
    ),
)
ERROR_M = np.linspace(
    0.001,
    0.05,
    64,
    dtype=np.float32,
).reshape(8, 8)


def slope() -> np.ndarray:
    """Return a tilted plane with a hole, a line one cell wide and a single cell."""
    depth_m = np.full((8, 8), NAN)
    depth_m[:4, :5] = 0.2 + 0.004 * np.arange(20, dtype=np.float32).reshape(4, 5)
    depth_m[1, 1] = NAN
    depth_m[6, :4] = 0.3
    depth_m[7, 7] = 0.15
    return depth_m


def sampled(mesh: SurfaceMesh) -> np.ndarray:
    """Return the mesh's depth at the cells' centres; triangles grow by 1e-7 so that a centre on an
    edge is inside.
    """
    triangles_m = mesh.vertices_m[mesh.faces]
    middle_m = triangles_m.mean(axis=1, keepdims=True)
    return orthographic_depth(middle_m + (1 + 1e-7) * (triangles_m - middle_m), SMALL_BOX, 8)


@given(depth_m=DEPTHS, jump_m=st.sampled_from([0.0, JUMP_M, 1.0]))
def test_mesh_sampled_at_cell_centers_is_the_depth_map(depth_m: np.ndarray, jump_m: float) -> None:
    mesh = mesh_from_depth(depth_m, SMALL_BOX, ERROR_M, jump_m)

    np.testing.assert_allclose(sampled(mesh), depth_m, atol=1e-6)

    corners_m = mesh.vertices_m[mesh.faces]

    assert (
        not len(corners_m)
        or np.ptp(
            corners_m[..., 2],
            axis=1,
        ).max()
        <= jump_m + 1e-7
    )

    normal = np.cross(
        corners_m[:, 1] - corners_m[:, 0],
        corners_m[:, 2] - corners_m[:, 0],
    )

    assert (normal[:, 2] < 0).all(), "the lit side faces the wall"


def test_map_of_one_cell_becomes_a_square_over_the_box() -> None:
    mesh = mesh_from_depth(np.full((1, 1), 0.2, np.float32), SMALL_BOX)
    sides_m = np.ptp(mesh.vertices_m[:, :2], axis=0)

    assert len(mesh.faces) == 2
    np.testing.assert_allclose(
        sides_m, [SMALL_BOX.x_max_m - SMALL_BOX.x_min_m, SMALL_BOX.y_max_m - SMALL_BOX.y_min_m]
    )


def test_vertices_lie_at_cell_centers_with_their_uncertainty() -> None:
    x_m, y_m = cell_centers_m(SMALL_BOX, 8)
    mesh = mesh_from_depth(
        np.full((8, 8), 0.2, np.float32),
        SMALL_BOX,
        ERROR_M,
    )

    np.testing.assert_allclose(
        mesh.vertices_m[9],
        [x_m[1], y_m[1], 0.2],
        atol=1e-8,
    )
    np.testing.assert_array_equal(mesh.uncertainty_m, ERROR_M.ravel())


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_opencv_reads_the_saved_mesh(tmp_path: Path, suffix: str) -> None:
    mesh = mesh_from_depth(slope(), SMALL_BOX, ERROR_M)
    mesh.save(tmp_path / f"mesh{suffix}")
    vertices_m, faces, *_ = cv2.loadMesh(str(tmp_path / f"mesh{suffix}"))
    read = SurfaceMesh(
        np.float64(vertices_m[0]),
        np.array(faces, np.int64).reshape(-1, 3),
    )

    np.testing.assert_allclose(read.vertices_m, mesh.vertices_m, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    assert [path.name for path in tmp_path.iterdir()] == [f"mesh{suffix}"]


def test_glb_holds_the_mesh_and_its_uncertainty(tmp_path: Path) -> None:
    mesh = mesh_from_depth(slope(), SMALL_BOX, ERROR_M)
    mesh.save(tmp_path / "mesh.glb")
    (read,) = trimesh.load_scene(
        tmp_path / "mesh.glb",
        process=False,
    ).geometry.values()

    np.testing.assert_allclose(read.vertices, mesh.vertices_m, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    np.testing.assert_array_equal(
        read.vertex_attributes["_uncertainty_m"].ravel(), mesh.uncertainty_m
    )
    assert read.visual.material.doubleSided


def test_points_are_saved_without_faces(tmp_path: Path) -> None:
    mesh = mesh_from_depth(slope(), SMALL_BOX)
    mesh.points_only.save(tmp_path / "points.ply")
    read, *_ = cv2.loadPointCloud(str(tmp_path / "points.ply"))

    np.testing.assert_allclose(read[:, 0], mesh.vertices_m, atol=1e-6)

    mesh.save(str(tmp_path / "points.csv"))
    rows = [*csv.DictReader((tmp_path / "points.csv").read_text(encoding="utf-8").splitlines())]

    np.testing.assert_allclose(
        [float(row["z_m"]) for row in rows], mesh.vertices_m[:, 2], atol=1e-5
    )
    assert {row["uncertainty_m"] for row in rows} == {""}

    mesh_from_depth(slope(), SMALL_BOX, ERROR_M).save(tmp_path / "mesh.npz")
    with np.load(tmp_path / "mesh.npz") as arrays_read:
        np.testing.assert_array_equal(arrays_read["vertices_m"], mesh.vertices_m)
        assert len(arrays_read["uncertainty_m"]) == len(mesh.vertices_m)


@pytest.mark.parametrize(
    ("name", "depth_m", "word"),
    [
        ("a.fbx", 0.2, ".glb"),
        ("a.ply", NAN, "no surface"),
    ],
)
def test_mesh_that_cannot_be_saved_is_refused(
    tmp_path: Path, name: str, depth_m: float, word: str
) -> None:
    with pytest.raises(NlosCamError, match=word):
        mesh_from_depth(
            np.full((8, 8), depth_m, np.float32),
            SMALL_BOX,
        ).save(tmp_path / name)
    assert not any(tmp_path.iterdir())
