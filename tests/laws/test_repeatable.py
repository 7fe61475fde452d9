"""Laws of repeatability: the same bits again, on any number of threads, and in any part of the
whole.
"""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration import load_rig

from nlos_cam.render import EFFECTS, STOPS, Accuracy, Scene, Surface, phong, render

pytestmark = pytest.mark.slow
RIG = load_rig("paper-rig")
COARSE = Accuracy("coarse", relay_columns=7, relay_rows=5, scatter_error=0.1)
FEW = replace(COARSE, relay_columns=2, relay_rows=2)
DEPTH = np.random.default_rng(0).uniform(0.13, 0.35, (8, 8)).astype(np.float32)
SCENES = {
    "plain": Scene(RIG, DEPTH),
    "lambertian": Scene(RIG, DEPTH, radiometry="lambertian", jump_m=0.5),
    "shiny": Scene(
        RIG,
        DEPTH[:3, :3],
        Surface(1.0, phong(0.4, 0.6, 10)),
    ),
    "bouncing": Scene(RIG, DEPTH[:3, :3], radiometry="lambertian"),
}
EVERY = np.arange(5120)
DISTANT = EVERY[::97]


def _effects(name: str) -> set[str]:
    return set(EFFECTS) - (set() if name == "bouncing" else {"inter-reflection"})


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("name", SCENES)
def test_result_repeats_again_and_on_one_thread(implementation: Any, name: str) -> None:
    first = implementation.three_bounce(SCENES[name], DISTANT, _effects(name), FEW)
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    for _ in range(2):
        np.testing.assert_array_equal(
            implementation.three_bounce(SCENES[name], DISTANT, _effects(name), FEW), first
        )

    assert first.any()


@pytest.fixture(scope="module")
def whole(implementation: Any) -> dict[str, np.ndarray]:
    chosen = {name: EVERY if name in {"plain", "lambertian"} else DISTANT for name in SCENES}
    return {
        name: implementation.three_bounce(one, chosen[name], _effects(name), FEW)
        for name, one in SCENES.items()
    }


@settings(max_examples=10, deadline=None, derandomize=True)
@given(
    name=st.sampled_from(sorted(SCENES)),
    start=st.integers(0, 5000),
    step=st.integers(1, 900),
)
def test_beams_do_not_depend_on_other_beams(
    implementation: Any, whole: Any, name: str, start: int, step: int
) -> None:
    known = whole[name]
    if len(known) == len(EVERY):
        some = EVERY[start::step]
        expected = known[some]
    else:
        places = np.arange(len(DISTANT))[start % len(DISTANT) :: step]
        some = DISTANT[places]
        expected = known[places]
    found = implementation.three_bounce(SCENES[name], some, _effects(name), FEW)

    np.testing.assert_array_equal(found, expected)


ROUGHLY = replace(FEW, scatter_error=0.5, beams_per_cell=2)


@pytest.mark.parametrize(
    ("name", "accuracy", "rows"),
    [
        ("plain", COARSE, (17, 40)),
        ("lambertian", COARSE, (17, 40)),
        ("shiny", ROUGHLY, (30, 33)),
    ],
)
def test_rows_alone_equal_rows_of_the_whole(
    name: str, accuracy: Accuracy, rows: tuple[int, int]
) -> None:
    every = render(SCENES[name], accuracy)
    part = render(SCENES[name], accuracy, rows=rows)
    for image in ("intensity", "depth_m", "margin"):
        np.testing.assert_array_equal(
            getattr(part, image),
            getattr(every, image)[slice(*rows)],
        )


@pytest.mark.usefixtures("one_thread")
def test_whole_object_repeats_at_a_named_stop() -> None:
    depth = np.random.default_rng(1).uniform(0.13, 0.35, (32, 32)).astype(np.float32)
    first = render(Scene(RIG, depth), STOPS["draft"])
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    again = render(Scene(RIG, depth), STOPS["draft"])

    np.testing.assert_array_equal(first.intensity, again.intensity)
    np.testing.assert_array_equal(first.multi.runner_up, again.multi.runner_up)


GLOSSY_BITS = """
import hashlib
from dataclasses import replace

from nlos_cam.render import Surface, paper_scene, phong, render

scene = replace(paper_scene().scene_at(0), surface=Surface(1.0, phong(0.5, 0.5, 20)))
print(hashlib.sha256(render(scene, "draft").multi.peak.tobytes()).hexdigest())
"""


def test_run_that_compiles_has_the_bits_of_later_runs(tmp_path: Path) -> None:
    """Functions that are compiled into several others round alike in each of them."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run(
            [sys.executable, "-c", GLOSSY_BITS],
            env=environment,
            capture_output=True,
            check=True,
            text=True,
        ).stdout
        for _ in range(2)
    )

    assert list(tmp_path.rglob("*.nbc"))
    assert first == second
