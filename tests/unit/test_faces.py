"""Packages' faces: every name loads, the documented ones are there, and other packages import from
faces only.
"""

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = ROOT / "nlos_cam", ROOT / "calibration/nlos_calibration", ROOT / "models/nlos_models"
FACES = sorted(
    ".".join(face.parent.relative_to(source.parent).parts)
    for source in SOURCES
    for face in source.rglob("__init__.pyi")
)
SHARED = {"arrays", "errors"}
"""Modules of a package without a camera that every other package names in full."""
ROW = re.compile(r"^\| `(\w+)` \|[^|]*\| `([^`]*)` \|$", re.MULTILINE)


def documented() -> Iterator[tuple[str, str]]:
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    for package, names in ROW.findall(text):
        yield from ((package, name) for name in names.split(", ") if package != "cli")


def package_of(module: str) -> str:
    """Return the package with a face that a module belongs to, or the module itself."""
    return max(
        (face for face in FACES if f"{module}.".startswith(f"{face}.")), key=len, default=module
    )


def are_one_family(one: str, other: str) -> bool:
    """Return True for a package and itself, or one that lies in it."""
    return f"{one}.".startswith(f"{other}.") or f"{other}.".startswith(f"{one}.")


def modules() -> Iterator[tuple[Path, str]]:
    """Yield the product's files, the examples and the tools, with the module's name (of a script:
    its own).
    """
    for source in SOURCES:
        for path in source.rglob("*.py"):
            yield (
                path,
                ".".join(path.relative_to(source.parent).with_suffix("").parts).removesuffix(
                    ".__init__"
                ),
            )
    for folder in ("examples", "tools"):
        yield from ((path, path.stem) for path in (ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize("face", FACES)
def test_face_loads_every_name(face: str) -> None:
    package = importlib.import_module(face)

    assert package.__doc__
    assert package.__all__
    assert all(hasattr(package, name) for name in package.__all__)


@pytest.mark.parametrize(("package", "name"), [*documented()])
def test_documented_name_is_in_its_face(package: str, name: str) -> None:
    assert name in importlib.import_module(f"nlos_cam.{package}").__all__


def test_packages_import_each_other_by_faces_only() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno} imports from {node.module}"
        for path, module in modules()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom)
        and node.module
        and not node.level
        and (face := package_of(node.module)) in FACES
        and face != node.module
        and not are_one_family(face, package_of(module))
        and node.module.rpartition(".")[2] not in SHARED
    ]
    assert found == []


def test_importing_faces_imports_nothing_heavy() -> None:
    program = (
        f"import sys, {', '.join(FACES)}; print(*{{'torch', 'numba', 'cv2', 'rerun', 'h5py'}} &"
        " {*sys.modules})"
    )
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout

    assert found.strip() == ""
