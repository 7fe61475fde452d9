"""Accuracy against time: one scene at three stops, compared with the finest."""

import time

import numpy as np

from nlos_cam.render import STOPS, paper_scene, render

scene = paper_scene().scene_at(0)
finest = render(scene, "fine")
print("stop      time, ms   depth off by over 1 mm   intensity error")
for stop in ("draft", "standard", "fine"):
    render(scene, STOPS[stop])  # the first call compiles

    start_s = time.perf_counter()
    found = render(scene, STOPS[stop])
    took_s = time.perf_counter() - start_s

    off = np.mean(np.abs(found.depth_m - finest.depth_m) > 1e-3)
    error = np.nansum(np.abs(found.intensity - finest.intensity)) / np.nansum(finest.intensity)
    print(f"{stop:9} {1e3 * took_s:8.1f} {off:16.1%} of cells {error:15.1%}")
