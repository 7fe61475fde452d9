"""Law of the backends: numba and torch agree with the reference on every kind of scene."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from nlos_calibration import Occluder, Rig, load_rig

from nlos_cam.errors import SceneError
from nlos_cam.objects import cell_centers_m, object_box, object_depth
from nlos_cam.render import EFFECTS, Accuracy, Material, Scene, Surface, render, render_all, three_bounce

pytestmark = pytest.mark.slow
RIG = load_rig("paper-rig")
QUICK = Accuracy("quick", relay_columns=40, relay_rows=32, sub_bins=64)
SMALL = Accuracy("small", relay_columns=12, relay_rows=10, sub_bins=1)
FEW = 12
"""Number of beams rendered by brute force."""
ROUNDING = 5e-5
"""Relative L1 between implementations in float32: a leg on the edge of a shadow may fall on either side."""
NO_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def _object(seed: int = 5, size: int = 32) -> np.ndarray:
    return object_depth(seed, RIG.object_box)[1][:: 64 // size, :: 64 // size].copy()


def _background(size: int = 32) -> np.ndarray:
    return np.full((size, size), np.nan, np.float32)


def _plane(size: int = 22) -> np.ndarray:
    depth = _background()
    depth[4 : 4 + size, 4 : 4 + size] = 0.2 + 0.004 * np.arange(size)
    return depth


def _occluder(x_m: float) -> Rig:
    return RIG.model_copy(update={"occluder": Occluder(x_m=x_m, z_min_m=0.1)})


def _near() -> np.ndarray:
    depth = _background()
    depth[10:20, 10:20] = 0.004
    return depth


def _pixel() -> np.ndarray:
    depth = _background()
    depth[15, 15] = 0.3
    return depth


def _cup() -> np.ndarray:
    depth = np.full((4, 4), 0.15, np.float32)
    depth[1:3, 1:3] = 0.32
    return depth


def _full() -> np.ndarray:
    depth = np.full((32, 32), 0.38, np.float32)
    depth[:, 12:14] = 0.15
    return depth


SCENES = {
    "object": Scene(RIG, _object()),
    "draughty object": Scene(RIG, _object(3)),
    "lambertian": Scene(RIG, _object(), radiometry="lambertian"),
    "no occluder": Scene(RIG.model_copy(update={"occluder": None}), _object()),
    "tilted plane": Scene(RIG, _plane()),
    "occluder in front": Scene(_occluder(0.43), _plane()),
    "occluder on a column": Scene(_occluder(float(cell_centers_m(object_box(RIG), 32)[0][9])), _plane()),
    "near contact": Scene(RIG, _near()),
    "near contact, lambertian": Scene(RIG, _near(), radiometry="lambertian"),
    "coloured": Scene(RIG, _object(), Surface(np.array([0.9, 0.5, 0.1]))),
    "one pixel": Scene(RIG, _pixel()),
    "full grid": Scene(RIG, _full()),
    "phong": Scene(RIG, _plane(8), Material(kind="phong", exponent=3).surface),
    "retroreflective": Scene(RIG, _pixel(), Material(kind="retroreflective").surface),
    "inter-reflection": Scene(RIG, _cup(), radiometry="lambertian"),
}
MANY_PATCHES, FEW_PATCHES = 2e-3, 1.5e-2
"""Relative L1 from the reference: few patches do not average out paths that fall into the next bin."""
FEW_OR_TABULATED = {k for k in SCENES if "near" in k or "pixel" in k} | {"phong", "retroreflective", "inter-reflection"}
THREE_BOUNCE = frozenset(EFFECTS) - {"inter-reflection", "pulse"}


def _histograms(kind: str, backend: str) -> np.ndarray:
    scene, accuracy = SCENES[kind], QUICK if backend != "reference" else replace(QUICK, sub_bins=0)
    chosen = np.arange(0, 5120, 5120 // FEW)
    wanted = THREE_BOUNCE | ({kind} & {"inter-reflection"})
    return three_bounce(scene, accuracy, wanted, "cpu" if backend == "reference" else backend, chosen)


_kept = cache(_histograms)


@pytest.mark.parametrize("backend", ["cpu", "torch", pytest.param("cuda", marks=NO_GPU)])
@pytest.mark.parametrize("kind", SCENES)
def test_backend_agrees_with_the_reference(kind: str, backend: str) -> None:
    found, slow = _kept(kind, backend), _kept(kind, "reference")
    assert slow.sum() > 0
    assert np.abs(found - slow).sum() < (FEW_PATCHES if kind in FEW_OR_TABULATED else MANY_PATCHES) * slow.sum()
    np.testing.assert_allclose(found.sum(), slow.sum(), rtol=QUICK.scatter_error if SCENES[kind].surface.brdf else 1e-5)


@pytest.mark.parametrize("backend", ["torch", pytest.param("cuda", marks=NO_GPU)])
@pytest.mark.parametrize("kind", SCENES)
def test_torch_and_numba_differ_by_rounding(kind: str, backend: str) -> None:
    found, other = _kept(kind, backend), _kept(kind, "cpu")
    # A BRDF is interpolated between spots by torch and expanded by numba: each is within the accuracy's error.
    limit = ROUNDING if SCENES[kind].surface.brdf is None else 2 * QUICK.scatter_error
    assert np.abs(found - other).sum() < limit * other.sum()


@pytest.mark.parametrize("backend", ["torch", pytest.param("cuda", marks=NO_GPU)])
def test_torch_is_repeatable(backend: str) -> None:
    assert np.array_equal(_histograms("object", backend), _kept("object", backend))


@pytest.mark.parametrize("backend", ["torch", pytest.param("cuda", marks=NO_GPU)])
def test_batch_renders_each_scene_as_alone(backend: str) -> None:
    coloured = Scene(RIG, _pixel(), Surface(np.array([0.9, 0.5, 0.1])))
    open_rig = SCENES["no occluder"].rig
    scenes = [Scene(RIG, _object(size=16)), Scene(RIG), coloured, Scene(open_rig, _pixel()), SCENES["one pixel"]]
    together = list(render_all(scenes, SMALL, backend=backend))
    for scene, rendering in zip(scenes, together, strict=True):
        alone = render(scene, SMALL, backend=backend)
        np.testing.assert_allclose(rendering.multi.peak, alone.multi.peak, rtol=1e-5)
        np.testing.assert_array_equal(rendering.color is None, alone.color is None)
    assert together[2].color is not None


def test_render_refuses_unknown_backends() -> None:
    with pytest.raises(SceneError, match="metal"):
        render(SCENES["one pixel"], "draft", backend="metal")
