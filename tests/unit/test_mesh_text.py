"""Mesh files made plain: what changes is what no triangle depends on."""

import pytest

from nlos_cam.objects.meshes import plain

VERTICES = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    "content",
    [VERTICES + b"f 1 2 3\n", b"o thing\n" + VERTICES + b"f 1/1/1 2/2/1 3/3/1\n", b"v -1e-5 0 -2\nf 10 20 30\n"],
)
def test_plain_text_stays_as_it_is(content: bytes) -> None:
    assert plain(content, ".obj") == content


@pytest.mark.parametrize(
    ("odd", "usual"),
    [
        (b"\xef\xbb\xbfv 0 0 0\n", b"v 0 0 0\n"),
        (b"v\t0\t0 0\r\nf 1 2 3\r\n", b"v 0 0 0\nf 1 2 3\n"),
        (b"o fa\xe7ade\nv 0 0 0\n", b"o fa?ade\nv 0 0 0\n"),
        (b"v 0 0 0# the first\n# a line\n", b"v 0 0 0\n\n"),
        (b"f 1 2 \\\n3\n", b"f 1 2  3\n"),
    ],
)
def test_oddities_of_text_become_usual(odd: bytes, usual: bytes) -> None:
    assert plain(odd, ".obj") == usual


def test_relative_vertices_count_back_from_their_own_line() -> None:
    two = VERTICES + b"f -4 -3/-1 -2/-1/-1\n" + VERTICES + b"f -4 -3 -1\n"
    assert plain(two, ".obj") == VERTICES + b"f 1 2/-1 3/-1/-1\n" + VERTICES + b"f 5 6 8\n"


@pytest.mark.parametrize("face", [b"f 0 1 2", b"f 1 2 0", b"f 1/1 0/2 3/3", b"f -5 -2 -1", b"f 1 00 2"])
def test_a_face_of_no_vertex_is_refused(face: bytes) -> None:
    with pytest.raises(ValueError, match="vertices count from 1"):
        plain(VERTICES + face + b"\n", ".obj")


@pytest.mark.parametrize("face", [b"f 1/0 2/0 3/0", b"f 10 20 30", b"f 1 2 05"])
def test_a_zero_elsewhere_is_not(face: bytes) -> None:
    assert plain(VERTICES + face, ".obj") == VERTICES + face


def test_edges_of_a_ply_go_by_another_name_and_its_body_stays() -> None:
    body = b"\n\0element edge 7"
    assert plain(b"ply\nelement edge 2\nend_header" + body, ".ply") == b"ply\nelement wire 2\nend_header" + body


def test_binary_stays_as_it_is() -> None:
    stl = bytes(80) + (1).to_bytes(4, "little") + b"\t#\xe7\r\n" * 10
    assert plain(stl, ".stl") == stl


@pytest.mark.parametrize(
    ("content", "suffix", "words"),
    [
        (bytes(83), ".stl", "83 bytes, but its 0 faces take 84"),
        (bytes(80) + b"\2\0\0\0" + bytes(60), ".stl", "144 bytes, but its 2 faces take 184"),
        ("v 0 0 0".encode("utf-16"), ".obj", "not text"),
    ],
)
def test_binary_that_does_not_fit_is_refused(content: bytes, suffix: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        plain(content, suffix)
