"""Measure the bare wall in a recording, write its record: `python examples/calibrate_bag.py RUN.BAG
[WALL.toml]`
"""

import sys
from datetime import datetime
from pathlib import Path

from nlos_calibration import new_wall_record

from nlos_cam.calibrate import WallFiles, collect_statistics, measure_by_depth, write_record
from nlos_cam.camera import open_camera


def main(bag: Path, out: Path) -> None:
    """Fit the wall to 60 frames, print its distance and angle, and write record, reference and
    report.
    """
    with open_camera(f"bag:{bag}") as camera:
        result = collect_statistics(camera, 60)
    fit, facts = measure_by_depth(result)
    about = {"camera": result.camera, "frames": result.statistics.depth.frames}
    today = datetime.now().astimezone().date()
    others = result.facts() | facts
    record = new_wall_record(fit, result.intrinsics, **about, created=today, others=others)
    write_record(WallFiles.beside(out, overwrite=False), record, result.reference(fit.inliers))
    print(
        f"{1e3 * record.distance_m:.1f} mm to the wall, {record.facing_deg:.2f} degrees:"
        f" {record.verdict}"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else Path("wall.toml"))
