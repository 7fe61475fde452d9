"""Numba's cache follows every file with kernels."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from nlos_cam import kernel_cache
from nlos_cam.cli import common

CALLED = """
from numba import njit

@njit(cache=True)
def called(x):
    return x + {number}
"""
CALLER = """
from numba import njit
from nlos_cam import kernel_cache
kernel_cache.install()
from nlos_cam.render.called import called

@njit(cache=True)
def caller(x):
    return called(x)

print(caller(1))
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Package with one kernel that calls another, in two files."""
    package = tmp_path / "nlos_cam"
    (package / "render").mkdir(parents=True)
    (package / "__init__.py").touch()
    shutil.copy(kernel_cache.__file__, package)
    (package / "render" / "called.py").write_text(CALLED.format(number=1))
    (package / "caller.py").write_text(CALLER)
    return package


def run(package: Path, **environment: str) -> str:
    """Return what the calling kernel prints in a process of its own."""
    return outputs(package, **environment)[0]


def outputs(package: Path, **environment: str) -> tuple[str, str]:
    """Return what the calling kernel prints, and what the cache logs."""
    known = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    program = "import logging; logging.basicConfig(level=logging.INFO); import nlos_cam.caller"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**known, "PYTHONPATH": str(package.parent), **environment},
        cwd=package.parent,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip(), done.stderr.strip()


def change(package: Path) -> None:
    """Change the called kernel.

    By another length too: Python's byte code follows a file's size and the whole second in which it
    was changed, and a fast machine runs the kernel and changes it within one second.
    """
    (package / "render" / "called.py").write_text(CALLED.format(number=50))


@pytest.mark.slow
def test_changed_kernel_changes_its_callers(package: Path) -> None:
    assert run(package) == "2"

    change(package)

    assert run(package) == "51"


@pytest.mark.slow
def test_old_folders_are_removed(package: Path) -> None:
    run(package)
    before = list((package / "__pycache__").glob("kernels-*"))
    change(package)
    run(package)
    after = list((package / "__pycache__").glob("kernels-*"))

    assert len(before) == len(after) == 1
    assert before != after


@pytest.mark.slow
def test_compiling_is_logged_once_and_not_from_the_cache(package: Path) -> None:
    _, first = outputs(package)
    _, second = outputs(package)

    assert first.count(kernel_cache.NOTICE) == 1
    assert kernel_cache.NOTICE not in second


@pytest.mark.slow
def test_read_only_package_is_cached_in_the_users_folder(package: Path, tmp_path: Path) -> None:
    (package / "__pycache__").write_text("a file, so that no folder can be made here")
    cache = tmp_path / "cache"

    assert run(package, NLOS_CAM_CACHE=str(cache)) == "2"
    assert list(cache.rglob("*.nbi"))


@pytest.mark.parametrize("is_quiet", [False, True])
def test_commands_say_what_is_logged(is_quiet: bool, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        common.set_detail(quiet=is_quiet)
        kernel_cache.log.info(kernel_cache.NOTICE)
    finally:
        common.set_detail()

    assert (kernel_cache.NOTICE in capsys.readouterr().err) is not is_quiet


def test_checksum_follows_a_constant_in_a_file_without_kernels(tmp_path: Path) -> None:
    (tmp_path / "render").mkdir()
    (tmp_path / "render" / "constants.py").write_text("X = 1")
    before = kernel_cache.checksum(tmp_path)
    (tmp_path / "render" / "constants.py").write_text("X = 2")
    kernel_cache.checksum.cache_clear()

    assert kernel_cache.checksum(tmp_path) != before


def test_every_file_with_kernels_is_among_the_sources() -> None:
    package = kernel_cache.PACKAGE
    compiled = re.compile(rb"cache=True|\binner\(")
    kernels = {path for path in package.rglob("*.py") if compiled.search(path.read_bytes())}
    found = {path for pattern in kernel_cache.SOURCES for path in package.glob(pattern)}

    assert kernels
    assert kernels <= found
