"""How much of an outline do the maps hold? A linear estimate of each pixel's albedo, with the depth given.

python tools/studies/outline.py --dataset DIR [--stride 3]: docs/outline.json

Prior: mean and covariance of the silhouettes of a dataset's first 12,000 objects. Measurement: the intensity of every
beam that a three-bounce echo wins, linear in the albedos (`Gradients.jacobian`), with the sensor's noise. Estimate: the
posterior mean, cut at the best of five thresholds. Nothing else is unknown.
"""

import argparse
from pathlib import Path

import cv2
import h5py
import harness
import numpy as np
from nlos_calibration import load_rig
from nlos_calibration.arrays import Float32, Float64

from nlos_cam import evaluate
from nlos_cam.objects import benchmark_objects, object_box, unseen_objects
from nlos_cam.render import Gradients, Scene, SensorModel, Surface, intensity_noise

RIG = load_rig("paper-rig")
EFFECTS = "direct", "three-bounce", "occluder"
COMPONENTS, OBJECTS, FAINT = 1500, 12_000, 1e-6
CUTS = 0.3, 0.35, 0.4, 0.45, 0.5


def silhouettes(folder: Path) -> Float32:
    """Return the silhouettes (n, 4096) of a dataset's first objects."""
    found: list[Float32] = []
    for path in sorted(folder.glob("shard-*.h5")):
        with h5py.File(path) as shard:
            found.append((~np.isnan(shard["object_depth_m"][:])).reshape(-1, 64 * 64).astype(np.float32))
        if sum(map(len, found)) >= OBJECTS:
            break
    return np.concatenate(found)


def extended(depth_m: Float32) -> Float32:
    """Return a depth map whose background has the depth of the nearest surface."""
    seen = ~np.isnan(depth_m)
    _, label = cv2.distanceTransformWithLabels((~seen).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    nearest = np.zeros(label.max() + 1, np.float32)
    nearest[label[seen]] = depth_m[seen]
    return nearest[label]


def gradients(depth_m: Float32, seen: Float64, off_m: float) -> Gradients:
    """Return the gradients of an object whose surface goes on, black, beyond its outline."""
    return Gradients(
        Scene(RIG, extended(depth_m) + np.float32(off_m), Surface(np.where(seen, 1.0, FAINT))), "standard", EFFECTS
    )


def estimate(
    depth_m: Float32, mean: Float32, axes: Float32, variance: Float32, frames: int, off_m: float
) -> tuple[float, float]:
    """Return the IoU of the estimate, and how many numbers the maps determine, with the depth off by so much."""
    seen = ~np.isnan(depth_m)
    true, taken = gradients(depth_m, seen, 0.0), gradients(depth_m, seen, off_m)
    both = true.three_bounce & taken.three_bounce
    noise = intensity_noise(true, SensorModel(), frames)[both]
    exact, model = (one.jacobian("albedo")[0][both[one.three_bounce]] / noise[:, None] for one in (true, taken))
    sensed = exact @ seen.ravel() + np.random.default_rng(0).normal(size=len(noise))
    through = (model @ axes).astype(np.float64)
    inverse = np.linalg.inv(through.T @ through + np.diag(1 / variance))
    found = mean + axes @ (inverse @ (through.T @ (sensed - model @ mean)))
    iou = max(float(((found > cut) & seen.ravel()).sum() / ((found > cut) | seen.ravel()).sum()) for cut in CUTS)
    return iou, float((1 - np.diag(inverse) / variance).sum())


def main() -> None:
    """Measure all cases."""
    parser = harness.options(__doc__)
    parser.add_argument("--dataset", type=Path, required=True)
    parser.add_argument("--stride", type=int, default=3)
    options: argparse.Namespace = parser.parse_args()
    every, box, rows = silhouettes(options.dataset), object_box(RIG), []
    mean = every.mean(0)
    variance, axes = np.linalg.eigh(np.cov(every.T))
    variance, axes = np.maximum(variance[-COMPONENTS:], FAINT), axes[:, -COMPONENTS:].astype(np.float32)
    sets = {"kinds of training": benchmark_objects(box), "kinds never seen": unseen_objects(box)}
    for name, objects in sets.items():
        for frames, off_m in ((1, 0.0), (100, 0.0), (1, 0.005), (100, 0.005)):
            found = np.array(
                [estimate(o.depth_m, mean, axes, variance, frames, off_m) for o in objects[:: options.stride]]
            )
            rows.append({"objects": name, "count": len(found), "frames": frames, "depth_off_mm": off_m * 1e3})
            rows[-1] |= {"silhouette_iou": float(found[:, 0].mean()), "numbers": float(found[:, 1].mean())}
            print(rows[-1], flush=True)
    harness.write("outline", {"machine": evaluate.machine(), "prior": len(every), "rows": rows})


if __name__ == "__main__":
    main()
