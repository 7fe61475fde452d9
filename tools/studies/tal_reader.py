"""Read transients with y-tal's own loader and back-project them: run by a Python that has y-tal.

    python tools/studies/tal_reader.py FILE.hdf5...

Prints one JSON object: for each file what tal makes of it, and where its back-projection over the
written volume is brightest. y-tal 0.20 needs numpy 1, so it usually has an environment of its own.
"""

import contextlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import tal

SIDE = 24


def read(path: str) -> dict[str, Any]:
    """Return tal's view of a file, and its back-projection's brightest point."""
    data = tal.io.read_capture(path)
    size = np.array(data.scene_info["volume"]["size"])
    low = np.array(data.scene_info["volume"]["center"]) - size / 2
    axes = [low[k] + (np.arange(SIDE) + 0.5) * size[k] / SIDE for k in range(3)]
    volume = np.stack(np.meshgrid(*axes, indexing="ij"), -1).astype(np.float32)
    light = tal.reconstruct.bp.solve(
        data,
        volume_xyz=volume,
        volume_format=tal.enums.VolumeFormat.X_Y_Z_3,
        camera_system=tal.enums.CameraSystem.DIRECT_LIGHT,
        progress=False,
    )
    np.save(Path(path).with_suffix(".tal.npy"), light.astype(np.float32))
    at = np.unravel_index(int(light.argmax()), light.shape)
    return {
        "layout": data.H_format.name,
        "shape": data.H.shape,
        "confocal": bool(data.is_confocal()),
        "delta_t": float(data.delta_t),
        "t_start": float(data.t_start),
        "first_and_last": bool(data.t_accounts_first_and_last_bounces),
        "peak_m": [float(axis[k]) for axis, k in zip(axes, at, strict=True)],
    }


with contextlib.redirect_stdout(sys.stderr):  # tal prints its messages to stdout
    found = {Path(path).name: read(path) for path in sys.argv[1:]}
print(json.dumps(found))
