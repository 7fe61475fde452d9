"""Transients beside a dataset's shards."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nlos_calibration import load_rig

from nlos_cam.dataset import build_transients
from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.objects import TEXTURES, object_depth, paint
from nlos_cam.render import Scene

PLAN = DatasetPlan(load_rig("paper-rig"), 40, accuracy="draft")


def scenes_of(plan: DatasetPlan, folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[Scene]:
    """Return the scenes that a plan renders for two transients."""
    scenes = list[Scene]()
    module = "nlos_cam.dataset.transients"
    monkeypatch.setattr(f"{module}.render_transient", lambda scene, **_: scenes.append(scene))
    monkeypatch.setattr(f"{module}.save_transient", lambda path, _: path.touch())
    build_transients(plan, 2, folder)
    return scenes


def test_transient_is_of_the_painted_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, _ = scenes_of(replace(PLAN, textures=tuple(TEXTURES)), tmp_path, monkeypatch)
    depth_m = object_depth(40, PLAN.box)[1]
    coat = paint(40, depth_m, tuple(TEXTURES))

    np.testing.assert_array_equal(scene.surface.albedo, coat.albedo)
    assert scene.surface.colored


def test_transient_of_unpainted_object_has_plan_material(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, _ = scenes_of(PLAN, tmp_path, monkeypatch)

    assert scene.surface == PLAN.material.surface
    assert [path.stem for path in sorted((tmp_path / "transients").iterdir())] == [
        "00000040",
        "00000041",
    ]
