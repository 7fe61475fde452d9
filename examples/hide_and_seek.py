"""Hide an object, render its lidar maps, reconstruct it: `python examples/hide_and_seek.py
[CATEGORY [SEED]]`
"""

import sys

import numpy as np
from nlos_calibration import load_rig

from nlos_cam.dataset import sense_object
from nlos_cam.objects import Pose, load_object, object_box
from nlos_cam.reconstruct import load_networks, reconstruct
from nlos_cam.render import Scene, Sensor, SensorModel


def main(category: str = "cup", seed: int = 0) -> None:
    """Print the overlap of the true and the reconstructed silhouette, and the mean error of
    depth.
    """
    rig = load_rig("paper-rig")
    truth_m = load_object(category, object_box(rig), Pose(size_m=0.18), seed=seed).depth_m
    maps = sense_object(Scene(rig, truth_m), Sensor(rig, SensorModel()), seed)
    result_m = reconstruct(maps, rig, load_networks()).depth_m
    both = np.isfinite(truth_m) & np.isfinite(result_m)
    either = np.isfinite(truth_m) | np.isfinite(result_m)
    print(f"{category} {seed}: silhouettes overlap by {both.sum() / either.sum():.0%}")
    print(
        "mean depth error where both have a surface:"
        f" {1e3 * np.abs(result_m - truth_m)[both].mean():.0f} mm"
    )


if __name__ == "__main__":
    main(*sys.argv[1:2], *map(int, sys.argv[2:3]))
