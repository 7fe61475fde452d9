# %% Open a recording
# `nlos_cam.open` finds the camera and loads the networks; `with` starts it. A recording that comes with the package:
from matplotlib.figure import Figure

import nlos_cam
from nlos_cam.cli.main import main
from nlos_cam.recording import SAMPLE
from nlos_cam.render import paper_scene, transient, transient_axes

with nlos_cam.open(f"bag:{SAMPLE}") as stream:
    results = list(stream)
    print(f"{len(results)} frames, {stream.dropped} dropped, rig {stream.rig.name}")

# %% A result in a line, and how far to trust it
# `repr` says what a frame shows. `quality` is predicted, without the truth: the outline's IoU (10, 50 and 90 % quantile)
# and the depth error.
result = results[-1]
print(result)
print(result.quality)
print(result.verdict, result.warnings)

# %% Draw it
# A notebook shows the figure by itself.
result.plot().savefig("notebook_plot.png", dpi=70)

# %% Arrays and points
# Meters, in the wall's frame: x along the wall from the lidar's foot, y up, z into the room; NaN where nothing is.
print("depth_m", result.depth_m.shape, result.depth_m.dtype)
print("uncertainty_m", result.uncertainty_m.shape)
print("points_m", result.points_m.shape, "nearest", f"{result.points_m[:, 2].min():.3f} m")
print("mesh", result.to_mesh().faces.shape)

# %% A transient with its axes
# `transient` is all light that comes back, over the length of the whole path; `transient_axes` says what its numbers
# are over: bins up to the gate, from the moment the pulse leaves, where each beam meets the wall, the points of the relay wall.
scene = paper_scene().scene_at(0)
light = transient(scene, "draft")
axes = transient_axes(scene, "draft")
row, column = 32, 30
print("light", light.shape, "over", axes.path_m.shape, f"bins of {100 * axes.bin_m:.0f} cm")
print("this beam meets the wall at", axes.laser_spots_m[row, column].round(3), "m")

figure = Figure((7, 2.4), layout="constrained")
axis = figure.subplots()
axis.semilogy(axes.path_m[: light.shape[2]], light[row, column] + 1e-12)
axis.set(ylim=(1e-9, None), xlabel="path length (m)", ylabel="light")
figure.savefig("notebook_transient.png", dpi=70)

# %% A bench of your own
# `bench=` takes a folder of `nlos-cam calibrate --bench`: its wall, its occluder, and weights made for it if it has some.
# Here a simulated bare wall is measured first, by the same command that an owner types.
main(["calibrate", "--wall", "--camera", "sim:bare-wall", "--bench", "bench", "--quiet"])
with nlos_cam.open("sim:bare-wall", bench="bench") as stream:
    print(stream.rig.name, f"{stream.rig.lidar.distance_m:.4f} m to the wall")
    print(next(stream))
