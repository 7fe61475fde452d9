"""Full colour (simulation only: the L515's laser is infrared): judge weights on the 54 test
objects, painted.

Writes figures.json and sheet.png, and sheet-vae.png of a VAE alone, into a folder. The commands
that train weights are in docs/colour.md.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from color_figures import draw_color_sheet, figures_of_color, painted_maps
from nlos_calibration import load_rig
from nlos_models import load_network
from nlos_models.training import load_vae, rebuild, run

from nlos_cam.cli.common import PAPER_RIG, tracked
from nlos_cam.dataset import TEST_SEED, open_dataset
from nlos_cam.objects import OBJECTS_PER_CATEGORY, benchmark_objects, object_box


def main() -> None:
    """Render, reconstruct, judge."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--weights", type=Path, required=True, help="from `train direct` or `train compressor`"
    )
    parser.add_argument("--vae", type=Path, help="to be judged too, given the images themselves")
    parser.add_argument(
        "--dataset", type=Path, required=True, help="training objects, whose mean is a baseline"
    )
    parser.add_argument("--accuracy", default="standard", help="of the renderer")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    rig = load_rig(PAPER_RIG)
    depths = [one.depth_m for one in benchmark_objects(object_box(rig))]
    with tracked("rendering test objects in colour") as on_progress:
        maps = painted_maps(depths, rig, TEST_SEED, given.accuracy, on_progress)
    truth = maps.image.astype(np.float32)
    image = run(load_network(given.weights)[0], maps)
    alone = {"vae_alone": rebuild(load_vae(given.vae)[0], maps.image)} if given.vae else {}
    given.out.mkdir(parents=True, exist_ok=True)
    sheets = {"sheet": image, "sheet-vae": alone["vae_alone"]} if alone else {"sheet": image}
    for name, made in sheets.items():
        draw_color_sheet(
            given.out / f"{name}.png", made[::OBJECTS_PER_CATEGORY], truth[::OBJECTS_PER_CATEGORY]
        )
    training = open_dataset(given.dataset, color=True, expected=True).column("image")
    figures = json.dumps(figures_of_color(image, truth, alone, training), indent=2)
    (given.out / "figures.json").write_text(f"{figures}\n", encoding="utf-8")
    print(figures)


if __name__ == "__main__":
    main()
