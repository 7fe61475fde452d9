"""The implementations that laws of the renderer are held against, and a setting that the brute
force can bear.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numba
import numpy as np
import pytest

from nlos_cam.render import Accuracy, Effects, Scene, TransportJob, renderer

COARSE = Accuracy("coarse", relay_columns=8, relay_rows=6)
"""Small enough for the brute force to take milliseconds."""


@dataclass(frozen=True)
class Implementation:
    """One of the renderers, by the same verbs."""

    name: str

    def _how(self, accuracy: Accuracy) -> tuple[Accuracy, str]:
        return (
            (replace(accuracy, sub_bins=0), "cpu")
            if self.name == "reference"
            else (accuracy, self.name)
        )

    def transient(
        self, scene: Scene, effects: Effects = "auto", accuracy: Accuracy = COARSE
    ) -> np.ndarray:
        setting, backend = self._how(accuracy)
        return renderer.transient(scene, setting, effects, backend)

    def render(
        self, scene: Scene, effects: Effects = "auto", accuracy: Accuracy = COARSE
    ) -> renderer.Rendering:
        setting, backend = self._how(accuracy)
        return renderer.render(scene, setting, effects, backend)

    def three_bounce(
        self,
        scene: Scene,
        chosen: np.ndarray | None = None,
        effects: Effects = "auto",
        accuracy: Accuracy = COARSE,
    ) -> np.ndarray:
        setting, backend = self._how(accuracy)
        return renderer.three_bounce(scene, setting, effects, backend, chosen)

    def histograms(self, job: TransportJob) -> np.ndarray:
        setting, backend = self._how(job.accuracy)
        return renderer.transport(replace(job, accuracy=setting), backend)


@pytest.fixture(scope="session", params=("cpu", "reference"))
def implementation(request: pytest.FixtureRequest) -> Implementation:
    return Implementation(request.param)


@pytest.fixture
def one_thread() -> Iterator[None]:
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)
