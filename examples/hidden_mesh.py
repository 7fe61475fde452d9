"""Save the most certain frame of a recording as a mesh: `python examples/hidden_mesh.py RUN.BAG
[OUT.glb]`
"""

import sys
from pathlib import Path

import numpy as np

import nlos_cam


def main(bag: Path, out: Path) -> None:
    """Write the surface with the smallest median uncertainty; the suffix may be .glb, .ply, .obj,
    .csv or .npz.
    """
    best = None
    best_m = np.inf
    with nlos_cam.open(f"bag:{bag}") as stream:
        for result in stream:
            seen = np.isfinite(result.depth_m)
            if result.uncertainty_m is not None and seen.any():
                doubt_m = float(np.median(result.uncertainty_m[seen]))
                best, best_m = (result, doubt_m) if doubt_m < best_m else (best, best_m)
    if best is None:
        sys.exit(f"{bag}: no frame shows a hidden surface with an uncertainty")
    mesh = best.to_mesh()
    mesh.save(out)
    print(
        f"{out}: frame {best.frame_number}, {len(mesh.faces)} triangles, median uncertainty"
        f" {1e3 * best_m:.0f} mm"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else Path("hidden.glb"))
