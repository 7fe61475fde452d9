"""Seconds of the dial's quick stops on the default scene: `pytest tests/bench -m bench
--benchmark-enable`.
"""

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from nlos_cam.render import paper_scene, render


@pytest.mark.bench
@pytest.mark.parametrize("stop", ["draft", "standard", "fine"])
def test_render_at_an_accuracy(benchmark: BenchmarkFixture, stop: str) -> None:
    scene = paper_scene().scene_at(0)
    render(scene, stop)  # compiles
    rendering = benchmark(render, scene, stop)

    assert rendering.accuracy.name == stop
