"""Render the capture `single` with mitransient: run by a Python that has it.

    python tools/studies/mitransient_render.py SCENE.json SAMPLES...

SCENE.json says mesh, wall, grid, laser, lidar and bins; for each number of samples per point the
transient (bins, y, x) goes to SCENE-SAMPLES.npy. Prints one JSON object with the versions and the
processor seconds of each rendering, without compiling. mitransient needs LLVM 16 or later at hand
(DRJIT_LIBLLVM_PATH).
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_mono")
import mitransient as mitr  # noqa: E402  it reads the variant


def load(facts: dict[str, Any]) -> Any:
    """Return the scene, its laser on the point that it lights."""
    x0, x1, y0, y1 = facts["wall"]
    middle = [(x0 + x1) / 2, (y0 + y1) / 2, 0.0]
    half = [(x1 - x0) / 2, (y1 - y0) / 2, 1.0]
    white = {"type": "diffuse", "reflectance": 1.0}
    film = {
        "type": "transient_hdr_film",
        "width": facts["cells"],
        "height": facts["cells"],
        "temporal_bins": facts["bins"],
        "bin_width_opl": facts["bin_m"],
        "start_opl": facts["start_m"],
        "rfilter": {"type": "box"},
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "transient_nlos_path",
                "nlos_laser_sampling": True,
                "nlos_hidden_geometry_sampling": True,
                "nlos_hidden_geometry_sampling_includes_relay_wall": False,
                "account_first_and_last_bounces": True,
                "max_depth": 3,
                "temporal_filter": "box",
            },
            "hidden": {
                "type": "ply",
                "filename": facts["mesh"],
                "bsdf": {"type": "twosided", "bsdf": white},
            },
            "wall": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate(middle).scale(half),
                "bsdf": white,
                "sensor": {
                    "type": "nlos_capture_meter",
                    "sampler": {"type": "independent"},
                    "sensor_origin": facts["lidar_m"],
                    "film": film,
                },
            },
            "laser": {
                "type": "projector",
                "irradiance": 1.0,
                "fov": 0.2,
                "to_world": mi.ScalarTransform4f().translate(facts["lidar_m"]),
            },
        }
    )
    wall = next(shape for shape in scene.shapes() if shape.is_sensor())
    mitr.nlos.focus_emitter_at_relay_wall_3dpoint(
        mi.Point3f([*facts["laser_m"], 0.0]), wall, scene.emitters()[0]
    )
    return scene


def rendered(scene: Any, samples: int, seed: int) -> np.ndarray:
    """Return the transient (bins, y, x)."""
    _, transient = mi.render(scene, spp=samples, seed=seed)
    dr.eval(transient)
    found = np.array(transient)
    return np.moveaxis(found[..., 0], -1, 0)


def main() -> None:
    """Render with each number of samples."""
    path = Path(sys.argv[1])
    scene = load(json.loads(path.read_text(encoding="utf-8")))
    rendered(scene, 16, 0)  # compiles
    seconds = {}
    for samples in map(int, sys.argv[2:]):
        start_s = time.process_time()
        found = rendered(scene, samples, 1)
        seconds[samples] = time.process_time() - start_s
        np.save(path.with_name(f"{path.stem}-{samples}.npy"), found)
    versions = f"mitransient {mitr.__version__}, Mitsuba {mi.__version__}"
    print(json.dumps({"versions": versions, "seconds": seconds}))


if __name__ == "__main__":
    main()
