"""A bench forecast: what would this bench see, and what if the lidar stood elsewhere?"""

from pathlib import Path

from nlos_calibration import load_rig

from nlos_cam.forecast import forecast, words_of, write_report

bench = load_rig("paper-rig")
found = forecast(bench, quick=True)
print("\n".join(words_of(found)))
write_report(found, Path("bench_forecast.png"))

print("\nlidar to wall   expected IoU   cells won")
for distance_m in (0.15, 0.20, 0.25, 0.30):
    lidar = bench.lidar.model_copy(update={"distance_m": distance_m})
    moved = forecast(bench.model_copy(update={"lidar": lidar}), quick=True)
    print(f"{distance_m:11.2f} m {moved.expected_iou:14.2f} {moved.at().cells:11.0f}")
