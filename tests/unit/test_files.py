"""Meshes from files: every flavour reads the same, and what is wrong has one line (depth maps: test_files_depth)."""

import logging
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from trimesh.exchange.ply import export_ply

from nlos_cam.errors import SceneError
from nlos_cam.objects import meshes
from nlos_cam.objects.meshes import MeshFile, read_mesh, upright

SOLID = trimesh.creation.torus(0.3, 0.1, major_sections=9, minor_sections=5)
EXPORTS = {
    "text.obj": SOLID.export(file_type="obj").encode(),
    "binary.stl": SOLID.export(file_type="stl"),
    "text.stl": SOLID.export(file_type="stl_ascii").encode(),
    "binary.ply": export_ply(SOLID, "binary"),
    "text.ply": export_ply(SOLID, "ascii"),
}
VERTICES = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
PLY = b"""ply
format ascii 1.0
comment TextureFile none.png
element vertex 4
property float x
property float y
property float z
property float s
property float t
element face 2
property list uchar int vertex_indices
element edge 1
property int vertex1
property int vertex2
end_header
0 0 0 0 0
1 0 0 1 0
1 1 0 1 1
0 1 0 0 1
3 0 1 2
3 0 2 3
0 1
"""
UNREADABLE = "string or file could not be read to its end due to unmatched data"
WITHOUT_EXTRAS = """
import sys
from importlib.machinery import PathFinder
blocked = {"PIL", "networkx", "scipy", "lxml", "charset_normalizer", "chardet", "shapely", "rtree"}
find = PathFinder.find_spec
PathFinder.find_spec = lambda name, *rest: None if name.split(".")[0] in blocked else find(name, *rest)
from pathlib import Path
from nlos_cam.objects.files import read_mesh
print(*(len(read_mesh(Path(name)).triangles) for name in sys.argv[1:]))
assert not blocked & set(sys.modules)
"""


def _write(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def _read(folder: Path, name: str, content: bytes) -> MeshFile:
    return read_mesh(_write(folder, name, content))


def _refused(folder: Path, name: str, content: bytes) -> str:
    path = _write(folder, name, content)
    with pytest.raises(SceneError) as caught:
        read_mesh(path)
    told = str(caught.value)
    assert told.startswith(str(path))
    assert "\n" not in told
    return told


@pytest.mark.parametrize("name", EXPORTS)
@pytest.mark.parametrize("letters", ["lower", "upper"])
def test_every_flavour_of_mesh_reads_as_the_same_triangles(tmp_path: Path, name: str, letters: str) -> None:
    mesh = _read(tmp_path, getattr(name, letters)(), EXPORTS[name])
    np.testing.assert_allclose(mesh.triangles, SOLID.triangles, atol=1e-6)


def test_what_the_files_lean_on_may_be_missing(tmp_path: Path) -> None:
    """Materials, textures, edges and letters of other alphabets, on a machine without any optional package."""
    names = [str(_write(tmp_path, name, content)) for name, content in EXPORTS.items()]
    faces = b"mtllib none.mtl\nusemtl fa\xe7ade\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf 1//1 3//1 4//1\n"
    names += [str(_write(tmp_path, "square.obj", VERTICES + faces)), str(_write(tmp_path, "square.ply", PLY))]
    command = [sys.executable, "-c", WITHOUT_EXTRAS, *names]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.stdout.split(), done.stderr) == ([str(len(SOLID.faces))] * 5 + ["2", "2"], "")


def test_the_parsers_log_stays_with_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, load = logging.getLogger("trimesh").level, trimesh.load_scene

    def wordy(*arguments: object, **named: object) -> object:
        logging.getLogger("trimesh").error("look at me")
        return load(*arguments, **named)

    monkeypatch.setattr(trimesh, "load_scene", wordy)
    _read(tmp_path, "thing.stl", EXPORTS["binary.stl"])
    assert not caplog.records
    assert logging.getLogger("trimesh").level == before


@pytest.mark.parametrize(("warning", "is_damage"), [(UNREADABLE, True), ("old fashioned", False)])
def test_of_warnings_only_that_of_unreadable_numbers_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, warning: str, is_damage: bool
) -> None:
    """A newer numpy raises what an older one warns of, and then it goes on with the numbers before."""
    load = trimesh.load_scene

    def warns(*arguments: object, **named: object) -> object:
        warnings.warn(warning, DeprecationWarning, stacklevel=1)
        return load(*arguments, **named)

    monkeypatch.setattr(trimesh, "load_scene", warns)
    if is_damage:
        assert "damaged" in _refused(tmp_path, "thing.stl", EXPORTS["text.stl"])
    else:
        assert len(_read(tmp_path, "thing.stl", EXPORTS["text.stl"]).triangles) == len(SOLID.faces)


@pytest.mark.parametrize(
    ("faces", "corners"),
    [
        (b"f 1 2 3 4\n", [[0, 1, 2], [0, 2, 3]]),
        (b"f 1 2 3\nf 1 2 3 4\n", [[0, 1, 2], [0, 1, 2], [0, 2, 3]]),
        (b"f -4 -3 -2\n", [[0, 1, 2]]),
        (b"o a\nf 1 2 3\no b\nusemtl c\nf 1 3 4\n", [[0, 1, 2], [0, 2, 3]]),
    ],
)
def test_faces_of_every_kind_and_part_are_joined(tmp_path: Path, faces: bytes, corners: list[list[int]]) -> None:
    triangles = {t.tobytes() for t in np.sort(_read(tmp_path, "thing.obj", VERTICES + faces).triangles, axis=1)}
    assert triangles == {t.tobytes() for t in np.sort(SQUARE[np.array(corners)], axis=1)}


def test_relative_vertices_mean_the_part_they_stand_in(tmp_path: Path) -> None:
    other = b"v 5 0 0\nv 6 0 0\nv 6 1 0\nf -3 -2 -1\n"
    mesh = _read(tmp_path, "thing.obj", VERTICES + b"f -4 -3 -2\n" + other)
    assert sorted(mesh.triangles[..., 0].max(1)) == [1, 6]


def test_the_solids_of_a_text_file_are_joined(tmp_path: Path) -> None:
    assert len(_read(tmp_path, "two.stl", EXPORTS["text.stl"] * 2).triangles) == 2 * len(SOLID.faces)


def test_a_mesh_is_its_path_and_content(tmp_path: Path) -> None:
    mesh = _read(tmp_path, "thing.stl", EXPORTS["binary.stl"])
    assert _read(tmp_path, "thing.stl", EXPORTS["binary.stl"]) == mesh
    assert _read(tmp_path, "other.stl", EXPORTS["binary.stl"]).sha256 == mesh.sha256
    assert _read(tmp_path, "thing.stl", EXPORTS["text.stl"]) != mesh


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("thing.glb", b"glTF", r"no mesh.*\.obj, \.stl, \.ply"),
        ("points.obj", VERTICES, "no faces.*point cloud"),
        ("points.ply", trimesh.PointCloud(SQUARE).export(file_type="ply"), "no faces.*point cloud"),
        ("empty.obj", b"", "no faces"),
        ("empty.stl", b"", "no faces"),
        ("none.stl", bytes(84), "no faces"),
        ("short.stl", EXPORTS["text.stl"][:900], "no faces"),
        ("empty.ply", b"", "damaged or no .ply file"),
        ("cut.stl", EXPORTS["binary.stl"][:900], "damaged.*900 bytes.*export it again"),
        ("cut.ply", EXPORTS["binary.ply"][:900], "damaged"),
        ("word.obj", VERTICES.replace(b"v 1", b"v one") + b"f 1 2 3\n", "damaged"),
        ("word.stl", EXPORTS["text.stl"].replace(b"vertex ", b"vertex x", 1), "damaged"),
        ("far.obj", VERTICES + b"f 1 2 9\n", "damaged"),
        ("back.obj", VERTICES + b"f 1 2 -5\n", "damaged.*vertices count from 1"),
        ("far.ply", PLY.replace(b"3 0 2 3", b"3 0 2 4"), "damaged"),
        ("back.ply", PLY.replace(b"3 0 2 3", b"3 0 2 -1"), "damaged"),
        ("nan.obj", VERTICES + b"v nan 0 0\nf 1 2 5\n", "NaN, infinite or beyond 1e"),
        ("inf.ply", PLY.replace(b"1 1 0 1", b"1 inf 0 1"), "NaN, infinite or beyond 1e"),
        ("huge.obj", VERTICES + b"v 1e200 0 0\nf 1 2 5\n", "NaN, infinite or beyond 1e"),
        ("line.obj", VERTICES + b"v 2 0 0\nf 1 2 5\n", "no face with an area"),
        ("point.obj", VERTICES + b"f 2 2 2\n", "no face with an area"),
    ],
)
def test_what_is_no_mesh_has_one_line(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    assert re.search(words, _refused(tmp_path, name, content))


def test_a_vertex_that_no_face_uses_may_be_anything(tmp_path: Path) -> None:
    assert len(_read(tmp_path, "thing.obj", VERTICES + b"v nan inf 1e300\nf 1 2 3\n").triangles) == 1


@pytest.mark.parametrize(("limit", "value", "words"), [("MAX_FACES", 89, "has 90 faces.*89"), ("MAX_BYTES", 99, "MiB")])
def test_too_large_a_file_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, value: int, words: str
) -> None:
    monkeypatch.setattr(meshes, limit, value)
    assert re.search(words, _refused(tmp_path, "thing.stl", EXPORTS["binary.stl"]))


@pytest.mark.parametrize("name", ["none.obj", "none.stl", "none.ply"])
def test_a_missing_file_or_a_folder_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(SceneError, match=rf"{name} cannot be read.*No such file"):
        read_mesh(tmp_path / name)
    (tmp_path / name).mkdir()
    with pytest.raises(SceneError, match=rf"{name} cannot be read.*directory"):
        read_mesh(tmp_path / name)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(sorted(EXPORTS)), st.data())
def test_damage_is_an_error_that_we_foresaw_or_none(tmp_path: Path, name: str, data: st.DataObject) -> None:
    content = bytearray(EXPORTS[name])
    place = data.draw(st.integers(0, len(content) - 1))
    content[place : place + data.draw(st.integers(0, 40))] = data.draw(st.binary(max_size=40))
    try:
        mesh = _read(tmp_path, name, bytes(content))
    except SceneError as error:
        assert "\n" not in str(error)  # noqa: PT017  damage that leaves a mesh is none
    else:
        assert np.isfinite(mesh.triangles).all()


def test_z_up_is_y_up_turned_about_x() -> None:
    turned = SOLID.copy().apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    np.testing.assert_allclose(upright(np.asarray(turned.triangles), "z"), SOLID.triangles, atol=1e-12)
    np.testing.assert_array_equal(upright(np.asarray(turned.triangles), "y"), turned.triangles)
