"""Draw a contact sheet of the procedural categories: `python tools/contact_sheet_objects.py OUT.png`."""

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from nlos_calibration.rig import load_rig

from nlos_cam.dataset import DatasetPlan
from nlos_cam.objects.categories import CATEGORIES
from nlos_cam.objects.depth_image import image_from_depth
from nlos_cam.objects.hidden import category_triangles, place, random_pose
from nlos_cam.objects.raster import orthographic_depth

COLUMNS = 6


def main(out: Path) -> None:
    """One row per category, six variations each."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    box = DatasetPlan(load_rig("paper-rig"), 0).box
    figure, axes = plt.subplots(len(CATEGORIES), COLUMNS, figsize=(COLUMNS, len(CATEGORIES)), layout="constrained")
    for row, category in zip(axes, CATEGORIES, strict=True):
        for seed, axis in enumerate(row):
            pose = random_pose(np.random.default_rng(seed), box)
            depth_m = orthographic_depth(place(category_triangles(category, seed), pose, box), box)
            axis.imshow(image_from_depth(depth_m, box), vmin=0, vmax=1, cmap="magma")
            axis.axis("off")
        row[0].set_title(category, loc="left", fontsize=8)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
