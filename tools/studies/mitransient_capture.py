"""Render one laser point's transient with mitransient: run by a Python that has it.

    python tools/studies/mitransient_capture.py MESH.ply JSON OUT.npy

The JSON holds wall ([x0, x1, y0, y1]), cells, lidar_m, laser_m, bin_m, start_m, bins and samples
(a list of samples per pixel). Writes two runs of each (samples, 2, T, x, y), and prints the seconds
of each after a first run that compiles.
"""

import json
import sys
import time

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
import mitransient as mitr  # noqa: E402  it needs the variant


def scene_of(mesh: str, facts: dict) -> mi.Scene:  # type: ignore[type-arg]
    """Return the scene: relay wall with the capture's film, hidden mesh, laser."""
    x0, x1, y0, y1 = facts["wall"]
    place = mi.ScalarTransform4f().translate([(x0 + x1) / 2, (y0 + y1) / 2, 0])
    white = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 1.0}}
    film = {
        "type": "transient_hdr_film",
        "width": facts["cells"],
        "height": facts["cells"],
        "temporal_bins": facts["bins"],
        "bin_width_opl": facts["bin_m"],
        "start_opl": facts["start_m"],
        "rfilter": {"type": "box"},
    }
    loaded = mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "transient_nlos_path",
                "nlos_laser_sampling": True,
                "nlos_hidden_geometry_sampling": True,
                "account_first_and_last_bounces": True,
                "temporal_filter": "box",
                "filter_bounces": 3,
                "max_depth": 5,
            },
            "wall": {
                "type": "rectangle",
                "to_world": place @ mi.ScalarTransform4f().scale([(x1 - x0) / 2, (y1 - y0) / 2, 1]),
                "bsdf": {"type": "diffuse", "reflectance": 1.0},
                "sensor": {
                    "type": "nlos_capture_meter",
                    "sensor_origin": facts["lidar_m"],
                    "film": film,
                },
            },
            "hidden": {"type": "ply", "filename": mesh, "face_normals": True, "bsdf": white},
            "laser": {
                "type": "projector",
                "irradiance": 100.0,
                "fov": 0.2,
                "to_world": mi.ScalarTransform4f().look_at(
                    origin=facts["lidar_m"], target=facts["laser_m"], up=[0, 1, 0]
                ),
            },
        }
    )
    shapes = {shape.id(): shape for shape in loaded.shapes()}
    mitr.nlos.focus_emitter_at_relay_wall_3dpoint(
        mi.Point3f(facts["laser_m"]), shapes["wall"], loaded.emitters()[0]
    )
    return loaded


def main() -> None:
    """Render, write, and print the seconds of each run."""
    mesh, text, out = sys.argv[1:]
    facts = json.loads(text)
    scene = scene_of(mesh, facts)
    seconds = []
    every = []
    for samples in facts["samples"]:
        runs = []
        for seed in range(3):
            start = time.perf_counter()
            _, transient = mi.render(scene, spp=samples, seed=seed)
            dr.eval(transient)
            image = np.array(transient)[..., 0]
            if seed:  # the first run compiles
                seconds.append(time.perf_counter() - start)
                # (y, x, T) of a film whose first row is the wall's upper edge, or (x, y, T)
                runs.append(np.moveaxis(image, -1, 0))
        every.append(runs)
    np.save(out, np.array(every, np.float32))
    print(json.dumps({"seconds": np.reshape(seconds, (-1, 2)).mean(1).tolist()}))


main()
