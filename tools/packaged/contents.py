"""Write the generated files of the wheel: graphs of the shipped weights, loops of the packaged
scenes, the sample. `bytes` stores new weights in a byte each, before their graphs are written.

Each is committed, and a test holds graphs and loops equal to their source.

    .venv/bin/python tools/packaged/contents.py bytes|graphs|worlds|sample ...
"""

import argparse
import sys
from pathlib import Path

from nlos_models import SHIPPED, export_folder, shipped_folder
from nlos_models.training import store_in_bytes

from nlos_cam.camera import (
    WORLDS,
    Recording,
    SimulatedCamera,
    World,
    pack_loop,
    read_packaged,
    render_loop,
)
from nlos_cam.recording import SAMPLE
from nlos_cam.render import bare_wall_scene, paper_scene

EVERY = 12
WIDTH = 320
HEIGHT = 240
"""Of the sample recording, which stays below 2 MB: every twelfth pose, in the smallest of the
L515's depth modes.
"""


def write_bytes() -> list[Path]:
    """Store the shipped weights in a byte each, unless they are; takes the extra "train"."""
    folders = [shipped_folder(name) for name in SHIPPED]
    for folder in folders:
        store_in_bytes(folder)
    return [path for folder in folders for path in folder.glob("*.safetensors")]


def write_graphs() -> list[Path]:
    """Export the shipped weights as ONNX graphs that point into their tensors; takes the extra
    "train".
    """
    return [path for name in SHIPPED for path in export_folder(shipped_folder(name))]


def write_worlds() -> list[Path]:
    """Render the loops of the packaged scenes, in two minutes on two cores; those of earlier
    renderings go.
    """
    WORLDS.mkdir(exist_ok=True)
    scenes = paper_scene(), bare_wall_scene()
    loops = {f"{scene.checksum}.npz": pack_loop(*render_loop(scene, _report)) for scene in scenes}
    for old in WORLDS.glob("*.npz"):
        old.unlink()
    for name, content in loops.items():
        (WORLDS / name).write_bytes(content)
    return [WORLDS / name for name in loops]


def write_sample() -> list[Path]:
    """Record the simulated airplane in poses spread over its loop, as librealsense records them."""
    scene = paper_scene()
    echoes, truths = read_packaged(scene) or render_loop(scene, _report)
    size = vars(scene.rig.pinhole.scaled(WIDTH, HEIGHT))
    rig = scene.rig.model_copy(update={"intrinsics": scene.rig.intrinsics.model_copy(update=size)})
    world = World(scene.model_copy(update={"rig": rig}), echoes[::EVERY], list(truths[::EVERY]))
    SAMPLE.unlink(missing_ok=True)
    with SimulatedCamera(
        "sim", world, recording=Recording(SAMPLE, frames=len(echoes[::EVERY]))
    ) as camera:
        for _ in camera:
            pass
    return [SAMPLE]


def _report(done: int, total: int) -> None:
    print(f"\r{done}/{total}", end="", file=sys.stderr)


PARTS = {
    "bytes": write_bytes,
    "graphs": write_graphs,
    "worlds": write_worlds,
    "sample": write_sample,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="+", choices=PARTS)
    for part in parser.parse_args().parts:
        for path in PARTS[part]():
            print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
