"""Mesh files made plain enough for a parser that has none of its optional packages."""

import re
from functools import partial

_PLAIN = bytes(range(128)).replace(b"\t", b" ") + b"?" * 128
"""Tabs as blanks; letters of other alphabets, which only names and comments hold, as "?"."""
_COMMENT = re.compile(rb"#[^\n]*")
_RELATIVE = re.compile(rb" -(\d+)")
_RELATIVE_FACE = re.compile(rb"^f [^\n]*-", re.MULTILINE)
_VERTEX_0 = re.compile(rb"^f[^\n]* 0+(?!\d)", re.MULTILINE)


def plain(content: bytes, suffix: str) -> bytes:
    """The content of a .obj, .stl or .ply file with the same triangles.

    Raises ValueError where a parser would go astray: binary of the wrong length, a face of vertex 0.
    """
    if suffix == ".ply":
        content = _without_edges(content)
    if b"\0" in content:
        return _checked_binary(content, suffix)
    text = content.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").translate(_PLAIN)
    return _plain_obj(text) if suffix == ".obj" else text


def _checked_binary(content: bytes, suffix: str) -> bytes:
    if suffix == ".obj":
        raise ValueError("it is not text")
    faces = int.from_bytes(content[80:84], "little")
    if suffix == ".stl" and len(content) != 84 + 50 * faces:
        raise ValueError(f"it has {len(content)} bytes, but its {faces} faces take {84 + 50 * faces}")
    return content


def _without_edges(content: bytes) -> bytes:
    """A .ply file whose edges go by another name: as wireframe they would ask for scipy."""
    header, end, body = content.partition(b"end_header")
    return header.replace(b"element edge ", b"element wire ") + end + body


def _plain_obj(text: bytes) -> bytes:
    text = _COMMENT.sub(b"", text.replace(b"\\\n", b" "))
    if _RELATIVE_FACE.search(text):
        text = _absolute(text)
    if _VERTEX_0.search(text):
        raise ValueError("a face names vertex 0, but vertices count from 1")
    return text


def _absolute(text: bytes) -> bytes:
    """A .obj text whose faces name no vertex by how far back it stands (-1 is the latest)."""
    seen, lines = 0, text.split(b"\n")
    for k, line in enumerate(lines):
        if line.startswith(b"v "):
            seen += 1
        elif line.startswith(b"f "):
            lines[k] = _RELATIVE.sub(partial(_number, seen), line)
    return b"\n".join(lines)


def _number(seen: int, back: re.Match[bytes]) -> bytes:
    return b" %d" % max(seen + 1 - int(back[1]), 0)  # before the first: 0, which is refused
