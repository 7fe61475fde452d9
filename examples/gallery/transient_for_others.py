"""A transient as another toolbox reads it: render, save as y-tal's HDF5, back-project in y-tal.

Needs `pip install y-tal`; without it the script says so and ends.
"""

import importlib.util
import sys
from pathlib import Path

if importlib.util.find_spec("tal") is None:
    print("skipped: y-tal is not installed (pip install y-tal)")
    sys.exit()

import tal

from nlos_cam.render import paper_scene
from nlos_cam.transients import render_transient, save_transient

path = Path("airplane.hdf5")
save_transient(path, render_transient(paper_scene().scene_at(0), accuracy="draft"))
data = tal.io.read_capture(str(path))
print(f"y-tal reads a {data.H_format.name} transient of shape {data.H.shape}")
