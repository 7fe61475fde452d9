"""Turn a recording into one point cloud of the hidden object: `python examples/point_cloud.py
RUN.BAG [OUT.ply]`
"""

import sys
from pathlib import Path

import numpy as np
import trimesh

import nlos_cam


def main(bag: Path, out: Path) -> None:
    """Write every frame's surface as points in the wall frame, in metres; later frames are
    lighter.
    """
    with nlos_cam.open(f"bag:{bag}") as stream:
        clouds = [result.points_m for result in stream]
    greys = np.linspace(0, 255, len(clouds)).repeat([len(points) for points in clouds])
    colours = np.stack([greys] * 3, 1).astype(np.uint8)
    trimesh.PointCloud(np.concatenate(clouds), colours).export(out)
    print(f"{out}: {len(greys)} points of {len(clouds)} frames")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else Path("hidden.ply"))
