"""Build the wheel and the sdist, install the wheel alone into a new environment, and use it from an
empty folder.

Prints one JSON object with sizes and times, and fails where a command does, where torch is needed,
or above the limits.

    .venv/bin/python tools/checks/wheel.py
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from venv import EnvBuilder

ROOT = Path(__file__).parents[2]
MAX_WHEEL_MB = 100.0  # of a file on the Python package index
MAX_INSTALL_MB = 850.0  # with both sets of weights
COMMANDS: tuple[tuple[str, ...], ...] = (
    ("--version",),
    ("doctor",),
    ("live", "sim", "--no-view", "--seconds", "2"),
    ("live", "sim", "--no-view", "--seconds", "2", "--log", "warm.csv"),
    ("replay", "sample", "--out", "replayed"),
    ("replay", "sample", "--weights", "paper", "--out", "replayed-paper"),
    ("export", "sample", "--out", "exported"),
    ("recipes",),
    ("scenes",),
)
"""The first run of `live` has an empty cache and no compiled code, as on a fresh machine; the
second has both.
"""
EXTRA = "train", "vae", "--recipe", "vae", "--out", "weights"
"""A command that needs the extra "train"."""
SIZES = """
import importlib.metadata, json, pathlib
total = {}
for found in importlib.metadata.distributions():
    paths = [pathlib.Path(found.locate_file(file)) for file in found.files or []]
    size = sum(path.stat().st_size for path in paths if path.is_file())
    total[found.metadata["Name"]] = size / 1e6
print(json.dumps(total))
"""
Times = dict[str, float]
"""Wall-clock time, and the processors' time, which other programs on a busy machine affect less."""
INSTALLER = {"pip", "setuptools"}
"""Of the environment, not of the installation."""


def build(out: Path) -> Path:
    """Build sdist and wheel into a folder; return the wheel."""
    subprocess.run(
        [sys.executable, "-P", "-m", "build", "--outdir", out, ROOT],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    (wheel,) = out.glob("*.whl")
    return wheel


def install(wheel: Path, environment: Path) -> Path:
    """Install a wheel into a new environment; return the environment's folder of programs."""
    EnvBuilder(with_pip=True).create(environment)
    programs = environment / ("Scripts" if sys.platform == "win32" else "bin")
    subprocess.run([programs / "python", "-m", "pip", "install", "--quiet", wheel], check=True)
    return programs


def run(
    programs: Path, arguments: tuple[str, ...], folder: Path
) -> tuple[subprocess.CompletedProcess[str], Times]:
    """Run a command in a folder, with a cache below it; return the outcome and the seconds it
    took.
    """
    start_s = time.perf_counter()
    before = os.times()
    settings = {**os.environ, "NLOS_CAM_CACHE": str(folder / "cache")}
    command = [str(programs / "nlos-cam"), *arguments]
    done = subprocess.run(
        command, cwd=folder, env=settings, capture_output=True, text=True, check=False
    )
    wall_s = time.perf_counter() - start_s
    after = os.times()
    cpu_s = (
        after.children_user + after.children_system - before.children_user - before.children_system
    )
    return done, {"wall": round(wall_s, 1), "cpu": round(cpu_s, 1)}


def main() -> int:
    """Check the wheel and print the figures."""
    failures: list[str] = []
    with TemporaryDirectory() as temporary:
        parts = {name: Path(temporary) / name for name in ("dist", "environment", "empty")}
        parts["empty"].mkdir()
        wheel = build(parts["dist"])
        programs = install(wheel, parts["environment"])
        sizes = json.loads(subprocess.check_output([programs / "python", "-c", SIZES], text=True))
        seconds = dict[str, Times]()
        for arguments in COMMANDS:
            done, seconds[" ".join(arguments)] = run(programs, arguments, parts["empty"])
            if done.returncode:
                failures.append(
                    f"{' '.join(arguments)}: exit {done.returncode}: {done.stderr[-500:]}"
                )
        done, _ = run(programs, EXTRA, parts["empty"])
        if (
            done.returncode != 1
            or 'pip install "nlos-cam[train]"' not in done.stderr
            or "Traceback" in done.stderr
        ):
            failures.append(f"{' '.join(EXTRA)}: exit {done.returncode}: {done.stderr[-500:]}")
        wheel_mb = wheel.stat().st_size / 1e6
    installed_mb = sum(size for name, size in sizes.items() if name not in INSTALLER)
    if wheel_mb > MAX_WHEEL_MB or installed_mb > MAX_INSTALL_MB:
        failures.append(f"too large: wheel {wheel_mb:.1f} MB, installed {installed_mb:.0f} MB")
    if heavy := {"torch", "lightning-fabric", "h5py", "onnx"} & sizes.keys():
        failures.append(f"the base installation has {', '.join(heavy)}")
    largest = sorted(sizes, key=sizes.__getitem__, reverse=True)[:10]
    figures = {
        "wheel_mb": round(wheel_mb, 1),
        "installed_mb": round(installed_mb),
        "largest_mb": {name: round(sizes[name], 1) for name in largest},
        "seconds": seconds,
    }
    print(json.dumps(figures, indent=2))
    print("\n".join(failures) or "the wheel works without the extra", file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
