"""A hidden object in ten lines: place it, sense it, reconstruct it, draw it."""

from matplotlib.figure import Figure
from nlos_calibration import load_rig

from nlos_cam.dataset import sense_object
from nlos_cam.objects import Pose, load_object, object_box
from nlos_cam.reconstruct import load_networks, reconstruct
from nlos_cam.render import Scene, Sensor, SensorModel

rig = load_rig("paper-rig")
truth_m = load_object("cup", object_box(rig), Pose(size_m=0.18), seed=4).depth_m
maps = sense_object(Scene(rig, truth_m), Sensor(rig, SensorModel()), 4)
hidden = reconstruct(maps, rig, load_networks())
pictures = {
    "depth map of the lidar (m)": maps.depth_m,
    "hidden cup: truth (m)": truth_m,
    "reconstruction (m)": hidden.depth_m,
}

figure = Figure((8, 2.6), layout="constrained")
for axes, (title, image) in zip(figure.subplots(1, 3), pictures.items(), strict=True):
    figure.colorbar(axes.imshow(image), ax=axes)
    axes.set_title(title, fontsize=9)
figure.savefig("hidden_object.png")
print(f"the cup is {1e3 * (hidden.depth_m[hidden.depth_m > 0].min()):.0f} mm from the wall")
