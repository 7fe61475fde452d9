"""The simulated bench's recordings: which objects are in which part, what a recording holds, going on after a stop."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from nlos_calibration import load_rig

from nlos_cam.dataset import read_labelled
from nlos_cam.objects import BenchmarkObject, object_box
from nlos_cam.objects import benchmark_objects as fixed_set
from nlos_cam.recording import load_sidecar
from nlos_cam.render import MultiBounce, SceneFile, load_scene

EXAMPLE = Path(__file__).parents[3] / "examples" / "bench.toml"


@pytest.fixture(scope="module")
def bench(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("transfer")


@pytest.fixture(scope="module")
def things() -> list[BenchmarkObject]:
    return fixed_set(object_box(load_rig("paper-rig")))


@pytest.fixture(scope="module")
def scene() -> SceneFile:
    """The example's bench with few pixels."""
    whole = load_scene(EXAMPLE)
    small = whole.rig.intrinsics.model_copy(update=vars(whole.rig.pinhole.scaled(80, 64)))
    return whole.model_copy(update={"rig": whole.rig.model_copy(update={"intrinsics": small})})


@pytest.fixture
def rendered(bench: ModuleType, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What was rendered; echoes are of nothing but a depth, which takes no time."""
    scenes: list[Any] = []

    def render(scene: Any) -> Any:
        scenes.append(scene)
        peak = np.full((64, 80), 1e-4, np.float32)
        path_m = np.full((64, 80), 2 * np.nanmin(scene.object_depth_m), np.float32)
        return type("Rendering", (), {"multi": MultiBounce(peak, peak / 4, path_m, direct_included=True)})

    monkeypatch.setattr(bench, "render", render)
    return scenes


@pytest.mark.slow
def test_a_recording_is_of_its_object_on_the_bench_and_labelled(
    bench: ModuleType, things: list[BenchmarkObject], scene: SceneFile, rendered: list[Any], tmp_path: Path
) -> None:
    paths = list(bench.record_all(scene, things[:2], tmp_path, 3, lambda *_: None))
    assert [path.name for path in paths] == ["airplane-1.bag", "airplane-2.bag"]
    for path, thing, shown in zip(paths, things, rendered, strict=False):
        sidecar = load_sidecar(path.with_suffix(".json"))
        assert (sidecar.label, sidecar.state, sidecar.rig) == (thing.name, "complete", scene.rig)
        np.testing.assert_array_equal(shown.object_depth_m, thing.depth_m)
        assert (shown.rig, shown.pulse_ns) == (scene.rig, scene.sensor.pulse_ns)
        read = read_labelled([path], known=lambda _: {})
        np.testing.assert_array_equal(read.object_depth_m, np.stack([thing.depth_m] * 3))
