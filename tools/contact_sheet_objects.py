"""Draw the hidden objects: `python tools/contact_sheet_objects.py DIR` makes objects.png and test_objects.png."""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import ObjectBox, load_rig

from nlos_cam.objects.benchmark import test_set
from nlos_cam.objects.depth_map import image_from_depth, object_box, orthographic_depth
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.placement import category_triangles, place, random_pose

VARIATIONS = 5
SIDE_BY_SIDE = 2
INCHES, DPI = 0.85, 100


def variations(category: str, box: ObjectBox) -> list[Float32]:
    """Images of a category as training sees it, each at another seed and pose."""
    poses = [random_pose(np.random.default_rng([k, *category.encode()]), box) for k in range(VARIATIONS)]
    placed = [place(category_triangles(category, k), pose, box) for k, pose in enumerate(poses)]
    return [image_from_depth(orthographic_depth(triangles, box), box) for triangles in placed]


def fixed(box: ObjectBox) -> dict[str, list[Float32]]:
    """Images of the test set, by category."""
    objects = test_set(box)
    return {
        name: [image_from_depth(thing.depth_m, box) for thing in objects if thing.category == name]
        for name in CATEGORIES
    }


def draw(path: Path, images: dict[str, list[Float32]]) -> Figure:
    """One line per category with its name, two categories side by side."""
    wide = max(len(row) for row in images.values())
    lines = -(-len(images) // SIDE_BY_SIDE)
    figure = Figure(figsize=(INCHES * SIDE_BY_SIDE * wide, 1.25 * INCHES * lines), layout="constrained")
    axes = figure.subplots(lines, SIDE_BY_SIDE * wide)
    for axis in axes.ravel():
        axis.axis("off")
    for number, (name, row) in enumerate(images.items()):
        side, line = divmod(number, lines)
        for k, image in enumerate(row):
            axis = axes[line, side * wide + k]
            axis.imshow(image, vmin=0, vmax=1, cmap="magma")
            if k == 0:
                axis.set_title(name, loc="left", fontsize=8, pad=2)
    figure.savefig(path, dpi=DPI)
    return figure


def main(folder: Path) -> None:
    """Both sheets, for the paper's rig."""
    box = object_box(load_rig("paper-rig"))
    draw(folder / "objects.png", {name: variations(name, box) for name in CATEGORIES})
    draw(folder / "test_objects.png", fixed(box))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
