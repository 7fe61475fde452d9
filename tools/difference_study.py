"""How far the change that a hidden object makes stands above noise and bias: docs/difference_study.json, its picture.

Signal: expected (64, 80) maps with the object minus those without, of 24 random test objects on the paper's rig. The
lidar has no pulse (S5: the strongest bin) or one of 1 ns, whose echoes merge within 15 cm and shift the peak
(difference_waveform). Noise: of the maps of single frames of the simulated sensor's chain; falls as one over the root
of the frames, as is checked for 100 with such frames and extrapolated beyond. Pattern: the device's bias, which stays.

raw          less the ideal wall of the plane that was fitted to the bare wall: ripples, patches, misfit and drift stay
difference   less the mean of 1000 frames of the bare wall: their noise, and drift since, stay
levelled     that, less its median over the wall: of the drift only patches stay

(A) `paper` radiometry, receiver cells at which the direct return wins about nine beams of ten. Cells whose echo merged
(the direct return still wins, its depth changed by 1 um or more) are told apart from those that report another echo.
(B) `lambertian`: cells that light reaches by way of the object, and frames of object and bare wall alike. Ratios
(difference_snr) are medians over the objects. No arguments; 24 objects, `--objects` for fewer.
"""

import argparse
import json
import shlex
import sys
import time
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from difference_figure import draw
from difference_lambertian import lambertian
from difference_noise import USUAL_NOISE_FRAMES, WARM_CELSIUS, MapNoise, maps_of, noise_of, wall_cells
from difference_paper import CHOSEN_M2, USUAL, USUAL_FRAMES, USUAL_WARMER, paper, through_the_chain, winners
from difference_scenes import SHAPE, Bench, later_light, paper_rig
from difference_sight import REFERENCE_FRAMES, Sight, Track
from difference_tables import as_markdown
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import Rig

from nlos_cam.cli.common import INTERRUPTED, progress
from nlos_cam.evaluate.render_tradeoff import machine
from nlos_cam.render.echoes import nothing
from nlos_cam.render.scene import Radiometry
from nlos_cam.render.sensor.model import SensorModel
from nlos_cam.render.sensor.sensor import Sensor

DOCS = Path(__file__).parents[1] / "docs"
OBJECTS, CHAINED = 24, 6
LIBRARIES = "numpy", "numba", "opencv-contrib-python-headless", "matplotlib"
EXAMPLE = 2
"""The object that is drawn."""


def map_noise(rig: Rig, track: Track) -> MapNoise:
    """The noise of the bare wall's maps, from frames of the chain; bias does not matter to it."""
    sensor, bare = Sensor(rig, SensorModel()), nothing(SHAPE[0] * SHAPE[1]).of(SHAPE)
    return noise_of(*maps_of(sensor, bare, track(range(USUAL_NOISE_FRAMES), "frames of the bare wall")))


def study(objects: int, track: Track) -> tuple[dict[str, Any], Any]:
    """All figures, and the example that is drawn."""
    benches = [Bench(paper_rig(cell_m2), "paper", pulse_ns) for pulse_ns, cell_m2 in CHOSEN_M2.items()]
    sight = Sight(wall_cells(benches[0].rig), map_noise(benches[0].rig, track))
    later = rendered("paper", objects, track)
    rows, examples = through_the_chain(sight, benches[-1], later[:CHAINED], track)
    told: dict[str, Any] = {
        "wall_cells": int(sight.cells.sum()),
        "noise": {"frames": sight.noise.frames, "falls": sight.noise.falls},
        "winners": winners(later, sight.cells, track),
        "paper": [paper(sight, bench, [bench.signal(one) for one in later], track) for bench in benches],
        "chain": rows,
    }
    later = rendered("lambertian", objects, track)
    benches = [Bench(paper_rig(1e-4), "lambertian", pulse_ns) for pulse_ns in (0.0, 1.0)]
    told["lambertian"] = lambertian(sight, benches, later, track)
    return told, examples[min(EXAMPLE, len(examples) - 1)]


def rendered(radiometry: Radiometry, objects: int, track: Track) -> list[Float32]:
    """Light by way of each object, of one radiometry; the receiver's size changes it in neither."""
    return list(later_light(paper_rig(1e-4), radiometry, track(range(objects), f"objects, {radiometry}")))


def facts(objects: int, seconds: float) -> dict[str, Any]:
    """What was run, where, and by what device."""
    return {
        "command": shlex.join(["python", "tools/difference_study.py", *sys.argv[1:]]),
        "machine": machine(),
        "versions": {name: version(name) for name in LIBRARIES},
        "minutes": seconds / 60,
        "objects": objects,
        "device": USUAL.model_dump(),
        "warmer_celsius": USUAL_WARMER,
        "warm_celsius": WARM_CELSIUS,
        "frames": USUAL_FRAMES,
        "reference_frames": REFERENCE_FRAMES,
    }


def main() -> None:
    """Work out, write, draw, print; what is interrupted leaves the old figures as they are."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--objects", type=int, default=OBJECTS, help="how many hidden objects to look at")
    objects = parser.parse_args().objects
    start = time.perf_counter()
    try:
        with progress() as bar:

            def track(of: Iterable[Any], over: str) -> Iterator[Any]:
                return iter(bar.track(list(of), description=over))

            told, example = study(objects, track)
    except KeyboardInterrupt:
        print("interrupted: nothing was written", file=sys.stderr)
        sys.exit(INTERRUPTED)
    told = facts(objects, time.perf_counter() - start) | told
    (DOCS / "difference_study.json").write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
    draw(told, example, DOCS / "images" / "difference_study.png")
    print(as_markdown(told))


if __name__ == "__main__":
    main()
