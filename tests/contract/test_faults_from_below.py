"""Faults of the system below every command that writes: limits of size, descriptors and memory, bad
disks, clock jumps.

Each command ends well, or with one line that names its output; nothing half-written stays under the
output's name.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nlos_cam.recording import verify

SHIM = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

static int is_regular(int fd, const char *folder) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return strncmp(path, folder, strlen(folder)) == 0;
}

ssize_t write(int fd, const void *data, size_t count) {
    static ssize_t (*next)(int, const void *, size_t);
    static int writes;
    if (!next) next = dlsym(RTLD_NEXT, "write");
    const char *folder = getenv("SHIM_FOLDER");
    const char *fail = getenv("SHIM_FAIL_AT");
    const char *cut = getenv("SHIM_SHORT");
    if (folder && is_regular(fd, folder)) {
        if (fail && ++writes >= atoi(fail)) { errno = EIO; return -1; }
        if (cut && count > 1000) count = count / 2;
    }
    return next(fd, data, count);
}

int clock_gettime(clockid_t id, struct timespec *now) {
    static int (*next)(clockid_t, struct timespec *);
    static long calls;
    if (!next) next = dlsym(RTLD_NEXT, "clock_gettime");
    int result = next(id, now);
    const char *jump = getenv("SHIM_JUMP_S");
    if (jump && id == CLOCK_REALTIME && ++calls % 20 >= 10) now->tv_sec += atol(jump);
    return result;
}
"""
EXPORT = "export {bag} --out {out}/export"
REPAIR = "repair {bag} --out {out}/repaired.bag"
RENDER = "render cup --out {out}/cup.npz"
BOARD = "board --out {out}/board.pdf"
COMMANDS = EXPORT, REPAIR, RENDER, BOARD
START = "import resource, sys; from nlos_cam.cli import run; {limit}; run()"


def ending(
    command: str, bag: Path, out: Path, limit: str = "", **variables: str
) -> tuple[int, str]:
    """Run a command in a process under a limit, with environment variables; return its exit code
    and stderr.

    A fork of the tests would not do: OpenMP refuses to run in the child of a process that has used
    it.
    """
    out.mkdir(exist_ok=True)
    words = [*command.format(bag=bag, out=out).split(), "--json"]
    start = [sys.executable, "-c", START.format(limit=limit or "None"), *words]
    environment = {
        **os.environ,
        "PYTHONDONTWRITEBYTECODE": "1",
        **variables,
    }  # a limit would cut compiled modules
    ended = subprocess.run(
        start, env=environment, capture_output=True, text=True, timeout=250, check=False
    )
    return ended.returncode, ended.stderr


def size_limit(limit_bytes: int) -> str:
    return f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit_bytes}, {limit_bytes}))"


@pytest.mark.slow
@pytest.mark.parametrize("limit_bytes", [100, 1_000, 20_000])
@pytest.mark.parametrize("command", COMMANDS)
def test_full_disk_is_one_line_and_leaves_nothing(
    noise_bag: Path, tmp_path: Path, command: str, limit_bytes: int
) -> None:
    out = tmp_path / "out"
    code, said = ending(command, noise_bag, out, size_limit(limit_bytes))

    assert code == 1, said
    assert len(said.strip().splitlines()) <= 2
    assert str(out) in said
    assert "a file cannot" not in said

    left = [
        path
        for path in out.iterdir()
        if path.suffix != ".npz" or not np.load(path)["depth_m"].any()
    ]

    assert left == [], "the maps may be there, whole, without their picture"


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_limit_above_every_file_is_no_fault(noise_bag: Path, tmp_path: Path, command: str) -> None:
    code, said = ending(command, noise_bag, tmp_path / "out", size_limit(1_000_000))
    assert code == 0, said


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_sixty_four_descriptors_are_enough(noise_bag: Path, tmp_path: Path, command: str) -> None:
    code, said = ending(
        command, noise_bag, tmp_path / "out", "resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))"
    )
    assert code == 0, said


@pytest.mark.slow
@pytest.mark.parametrize("command", [EXPORT, REPAIR, BOARD])
def test_folder_that_cannot_be_written_is_one_line(
    noise_bag: Path, tmp_path: Path, command: str
) -> None:
    code, said = ending(command.replace("{out}", "/proc"), noise_bag, tmp_path)

    assert code in {1, 4}
    assert "/proc" in said
    assert len(said.strip().splitlines()) == 1


@pytest.fixture(scope="module")
def shim(tmp_path_factory: pytest.TempPathFactory) -> str:
    if not (compiler := shutil.which("cc")):
        pytest.skip("needs a C compiler")
    folder = tmp_path_factory.mktemp("shim")
    (folder / "shim.c").write_text(SHIM, encoding="utf-8")
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-o", "shim.so", "shim.c", "-ldl"], cwd=folder, check=True
    )
    return str(folder / "shim.so")


@pytest.mark.slow
@pytest.mark.parametrize("write", [1, 2, 5])
def test_disk_error_is_one_line_and_leaves_nothing(
    shim: str, noise_bag: Path, tmp_path: Path, write: int
) -> None:
    variables = {
        "LD_PRELOAD": shim,
        "SHIM_FOLDER": str(out := tmp_path / "out"),
        "SHIM_FAIL_AT": str(write),
    }
    code, said = ending(REPAIR, noise_bag, out, **variables)

    assert code == 1, said
    assert "Input/output error" in said
    assert str(out) in said
    assert list(out.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "variables", [{"SHIM_SHORT": "1"}, {"SHIM_JUMP_S": "100000000"}, {"SHIM_JUMP_S": "-90000"}]
)
def test_short_writes_and_clock_jumps_change_nothing(
    shim: str, noise_bag: Path, tmp_path: Path, variables: dict[str, str]
) -> None:
    out = tmp_path / "out"
    code, said = ending(REPAIR, noise_bag, out, LD_PRELOAD=shim, SHIM_FOLDER=str(out), **variables)

    assert code == 0, said
    assert verify(out / "repaired.bag").frames == verify(noise_bag).frames
