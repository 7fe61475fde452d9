"""Accuracy against time: one scene at three stops, compared with the finest."""

import time

import numpy as np
from matplotlib.figure import Figure

from nlos_cam.render import STOPS, paper_scene, render

scene = paper_scene().scene_at(0)
finest = render(scene, "fine")
figure = Figure((8, 2.4), layout="constrained")
axes = dict(zip(("draft", "standard", "fine"), figure.subplots(1, 3), strict=True))

print("stop      time, ms   depth off by over 1 mm   intensity error")
for stop, axis in axes.items():
    render(scene, STOPS[stop])  # the first call compiles

    start_s = time.perf_counter()
    found = render(scene, STOPS[stop])
    took_s = time.perf_counter() - start_s

    off_m = np.abs(found.depth_m - finest.depth_m)
    error = np.nansum(np.abs(found.intensity - finest.intensity)) / np.nansum(finest.intensity)
    print(f"{stop:9} {1e3 * took_s:8.1f} {np.mean(off_m > 1e-3):16.1%} of cells {error:15.2%}")
    axis.imshow(off_m > 1e-3, cmap="gray_r")
    axis.set_title(f"{stop}: cells whose depth is off", fontsize=9)
figure.savefig("accuracy_in_time.png")
