"""Hide an object, render the lidar's report of it, reconstruct it: `python examples/hide_and_seek.py [CATEGORY [SEED]]`"""

import sys

import numpy as np
from nlos_calibration import load_rig

from nlos_cam.dataset import sense_object
from nlos_cam.objects import Pose, category_triangles, object_box, orthographic_depth, place
from nlos_cam.reconstruct import load_networks, reconstruct
from nlos_cam.render import Scene, Sensor, SensorModel


def main(category: str = "cup", seed: int = 0) -> None:
    """Print how much of the object was found, and how far off its surface is."""
    rig = load_rig("paper-rig")
    box = object_box(rig)
    truth_m = orthographic_depth(place(category_triangles(category, seed), Pose(size_m=0.18), box), box)
    maps = sense_object(Scene(rig, truth_m), Sensor(rig, SensorModel()), seed)
    found_m = reconstruct(maps, rig, load_networks()).depth_m
    both, either = np.isfinite(truth_m) & np.isfinite(found_m), np.isfinite(truth_m) | np.isfinite(found_m)
    print(f"{category} {seed}: silhouettes overlap by {both.sum() / either.sum():.0%}")
    print(f"where both are surface it is off by {1e3 * np.abs(found_m - truth_m)[both].mean():.0f} mm")


if __name__ == "__main__":
    main(*sys.argv[1:2], *map(int, sys.argv[2:3]))
