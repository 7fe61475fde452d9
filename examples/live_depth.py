"""Ten lines: open a camera, loop, get the hidden depth in metres. `python examples/live_depth.py
[CAMERA]`
"""

import sys

import nlos_cam

with nlos_cam.open(sys.argv[1] if len(sys.argv) > 1 else "sim") as stream:
    for result in stream:
        if len(result.points_m):
            x_m, y_m, z_m = result.points_m.mean(0)
            print(
                f"frame {result.frame_number}: something at x {x_m:.3f}, y {y_m:.3f}, {z_m:.3f} m"
                " off the wall"
            )
