"""A transient as another toolbox reads it: render, save as tal's HDF5, look at it, read it in y-tal.

y-tal needs numpy below 2, so it usually has an environment of its own, whose Python
NLOS_CAM_TAL_PYTHON names. Without one the last step is left out.
"""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

from nlos_cam.render import paper_scene
from nlos_cam.transients import (
    Capture,
    load_transient,
    render_transient,
    save_transient,
    transient_figure,
)

READER = """
import numpy as np, tal

data = tal.io.read_capture("airplane.hdf5")
size = np.array(data.scene_info["volume"]["size"])
low = np.array(data.scene_info["volume"]["center"]) - size / 2
axes = [low[k] + (np.arange(24) + 0.5) * size[k] / 24 for k in range(3)]
volume = np.stack(np.meshgrid(*axes, indexing="ij"), -1).astype(np.float32)
light = tal.reconstruct.bp.solve(
    data,
    volume_xyz=volume,
    volume_format=tal.enums.VolumeFormat.X_Y_Z_3,
    camera_system=tal.enums.CameraSystem.DIRECT_LIGHT,
    progress=False,
)
x, y, z = volume.reshape(-1, 3)[light.argmax()]
print(f"y-tal reads {data.H_format.name} {data.H.shape}, confocal: {data.is_confocal()}")
print(f"its back-projection is brightest at ({x:.3f}, {y:.3f}, {z:.3f}) m")
"""

path = Path("airplane.hdf5")
capture = Capture("confocal", cells=24)
save_transient(path, render_transient(paper_scene().scene_at(0), capture, accuracy="draft"))
found = load_transient(path)
print(f"{path}: {found.kind}, {found.bins} bins of {1e3 * found.bin_m:.0f} mm")
transient_figure(found, "airplane, confocal").savefig("transient_for_others.png")

python = sys.executable if importlib.util.find_spec("tal") else os.getenv("NLOS_CAM_TAL_PYTHON")
if python:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([python, "-c", READER], check=True, env=environment)
else:
    print("y-tal is not installed here: pip install y-tal")
