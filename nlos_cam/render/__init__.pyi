__all__ = [
    "DEPTH_UNIT_M",
    "EFFECTS",
    "QUIET",
    "RENDERING_VERSION",
    "STOPS",
    "Accuracy",
    "Agreement",
    "Beams",
    "EchoMaps",
    "Effect",
    "Effects",
    "Fault",
    "FaultKind",
    "Gradients",
    "HiddenObject",
    "Material",
    "MultiBounce",
    "Radiometry",
    "RenderProblem",
    "Rendering",
    "Scene",
    "SceneFacts",
    "SceneFile",
    "SceneVector",
    "SensedImages",
    "Sensor",
    "SensorModel",
    "Stop",
    "StoppedBeams",
    "Stopwatch",
    "Surface",
    "TransientAxes",
    "TransportJob",
    "WallGrid",
    "WallPaths",
    "Work",
    "accuracy_named",
    "agreement",
    "bare_wall_scene",
    "cast",
    "choose",
    "costs",
    "depth_bound",
    "device_named",
    "fit_pose",
    "histograms",
    "histograms_of_all",
    "included",
    "intensity_noise",
    "least_seconds",
    "load_scene",
    "moved",
    "packaged_scenes",
    "paper_scene",
    "phong",
    "prepare",
    "render",
    "render_all",
    "render_scan",
    "retroreflective",
    "ripples",
    "sensor_effects",
    "smooth_patches",
    "three_bounce",
    "transient",
    "transient_axes",
    "with_pulse",
]

from .accuracy import STOPS, Accuracy, Stop, accuracy_named
from .accuracy_table import choose
from .agreement import Agreement, EchoMaps, agreement
from .backend_cpu import histograms
from .backend_torch import device_named, histograms_of_all
from .echoes import MultiBounce, StoppedBeams, with_pulse
from .effect_costs import Stopwatch, Work, costs, least_seconds
from .effects import EFFECTS, Effect, Effects, included
from .geometry import Beams, cast
from .gradients import (
    Gradients,
    SceneVector,
    depth_bound,
    fit_pose,
    intensity_noise,
    moved,
)
from .job import TransportJob
from .material import Material, Surface, phong, retroreflective
from .planning import RenderProblem, prepare
from .renderer import (
    Rendering,
    TransientAxes,
    render,
    render_all,
    render_scan,
    three_bounce,
    transient,
    transient_axes,
)
from .scene import Radiometry, Scene
from .scene_facts import SceneFacts
from .scene_file import (
    RENDERING_VERSION,
    Fault,
    FaultKind,
    HiddenObject,
    SceneFile,
    bare_wall_scene,
    load_scene,
    packaged_scenes,
    paper_scene,
)
from .sensor.bias import ripples, smooth_patches
from .sensor.effects import sensor_effects
from .sensor.model import DEPTH_UNIT_M, QUIET, SensorModel
from .sensor.sensor import SensedImages, Sensor
from .wall_paths import WallGrid, WallPaths
