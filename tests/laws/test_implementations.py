"""Law of the backends: numba and torch agree with the reference on every kind of scene."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from depth_maps import depth_map
from nlos_calibration import Occluder, load_rig

from nlos_cam.errors import SceneError
from nlos_cam.objects import cell_centers_m, object_box, object_depth
from nlos_cam.render import (
    EFFECTS,
    Accuracy,
    Material,
    Scene,
    Surface,
    render,
    render_all,
    three_bounce,
)

pytestmark = pytest.mark.slow
RIG = load_rig("paper-rig")
QUICK = Accuracy("quick", relay_columns=40, relay_rows=32, sub_bins=64)
SMALL = Accuracy("small", relay_columns=12, relay_rows=10, sub_bins=1)
FEW = 12
"""Number of beams rendered by brute force."""
ROUNDING = 5e-5
"""Relative L1 between implementations in float32: a leg on the edge of a shadow may fall on either
side.
"""
NO_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def _object(seed: int = 5, size: int = 32) -> np.ndarray:
    return object_depth(seed, RIG.object_box)[1][:: 64 // size, :: 64 // size].copy()


def _plane(size: int = 22) -> np.ndarray:
    return depth_map(
        32,
        np.nan,
        (
            np.s_[4 : 4 + size, 4 : 4 + size],
            0.2 + 0.004 * np.arange(size),
        ),
    )


COLUMN_X_M = float(cell_centers_m(object_box(RIG), 32)[0][9])
NEAR = depth_map(
    32,
    np.nan,
    (np.s_[10:20, 10:20], 0.004),
)
PIXEL = depth_map(32, np.nan, ((15, 15), 0.3))
SCENES = {
    "object": Scene(RIG, _object()),
    "draughty object": Scene(RIG, _object(3)),
    "lambertian": Scene(RIG, _object(), radiometry="lambertian"),
    "no occluder": Scene(RIG.model_copy(update={"occluder": None}), _object()),
    "tilted plane": Scene(RIG, _plane()),
    "occluder in front": Scene(
        RIG.model_copy(update={"occluder": Occluder(x_m=0.43, z_min_m=0.1)}), _plane()
    ),
    "occluder on a column": Scene(
        RIG.model_copy(
            update={
                "occluder": Occluder(
                    x_m=COLUMN_X_M,
                    z_min_m=0.1,
                )
            }
        ),
        _plane(),
    ),
    "near contact": Scene(RIG, NEAR),
    "near contact, lambertian": Scene(RIG, NEAR, radiometry="lambertian"),
    "coloured": Scene(
        RIG,
        _object(),
        Surface(np.array([0.9, 0.5, 0.1])),
    ),
    "one pixel": Scene(RIG, PIXEL),
    "full grid": Scene(
        RIG,
        depth_map(32, 0.38, (np.s_[:, 12:14], 0.15)),
    ),
    "phong": Scene(
        RIG,
        _plane(8),
        Material(kind="phong", exponent=3).surface,
    ),
    "retroreflective": Scene(RIG, PIXEL, Material(kind="retroreflective").surface),
    "inter-reflection": Scene(
        RIG,
        depth_map(
            4,
            0.15,
            (np.s_[1:3, 1:3], 0.32),
        ),
        radiometry="lambertian",
    ),
}
MANY_PATCHES = 2e-3
FEW_PATCHES = 1.5e-2
"""Relative L1 from the reference: few patches do not average out paths that fall into the next
bin.
"""
FEW_OR_TABULATED = {k for k in SCENES if "near" in k or "pixel" in k} | {
    "phong",
    "retroreflective",
    "inter-reflection",
}
THREE_BOUNCE = frozenset(EFFECTS) - {"inter-reflection", "pulse"}


def _histograms(kind: str, backend: str) -> np.ndarray:
    scene = SCENES[kind]
    accuracy = QUICK if backend != "reference" else replace(QUICK, sub_bins=0)
    chosen = np.arange(0, 5120, 5120 // FEW)
    wanted = THREE_BOUNCE | ({kind} & {"inter-reflection"})
    return three_bounce(
        scene, accuracy, wanted, "cpu" if backend == "reference" else backend, chosen
    )


_kept = cache(_histograms)


@pytest.mark.parametrize(
    "backend",
    ["cpu", "torch", pytest.param("cuda", marks=NO_GPU)],
)
@pytest.mark.parametrize("kind", SCENES)
def test_backend_agrees_with_the_reference(kind: str, backend: str) -> None:
    found = _kept(kind, backend)
    slow = _kept(kind, "reference")

    assert slow.sum() > 0
    assert (
        np.abs(found - slow).sum()
        < (FEW_PATCHES if kind in FEW_OR_TABULATED else MANY_PATCHES) * slow.sum()
    )
    np.testing.assert_allclose(
        found.sum(), slow.sum(), rtol=QUICK.scatter_error if SCENES[kind].surface.brdf else 1e-5
    )


@pytest.mark.parametrize(
    "backend",
    ["torch", pytest.param("cuda", marks=NO_GPU)],
)
@pytest.mark.parametrize("kind", SCENES)
def test_torch_and_numba_differ_by_rounding(kind: str, backend: str) -> None:
    found = _kept(kind, backend)
    other = _kept(kind, "cpu")
    # A BRDF is left to numba by torch.
    limit = ROUNDING

    assert np.abs(found - other).sum() < limit * other.sum()


@pytest.mark.parametrize(
    "backend",
    ["torch", pytest.param("cuda", marks=NO_GPU)],
)
def test_torch_is_repeatable(backend: str) -> None:
    assert np.array_equal(_histograms("object", backend), _kept("object", backend))


@pytest.mark.parametrize(
    "backend",
    ["cpu", "torch", pytest.param("cuda", marks=NO_GPU)],
)
def test_batch_renders_each_scene_as_alone(backend: str) -> None:
    """To the last bit on the CPU, also of a batch of one."""
    coloured = Scene(
        RIG,
        PIXEL,
        Surface(np.array([0.9, 0.5, 0.1])),
    )
    open_rig = SCENES["no occluder"].rig
    lambertian = Scene(RIG, _object(size=16), radiometry="lambertian")
    scenes = [
        Scene(RIG, _object(size=16)),
        Scene(RIG),
        coloured,
        Scene(open_rig, PIXEL),
        SCENES["one pixel"],
    ]
    for batch in ([*scenes, lambertian], scenes[:1]):
        for scene, rendering in zip(
            batch,
            render_all(batch, SMALL, backend=backend),
            strict=True,
        ):
            alone = render(scene, SMALL, backend=backend)
            for one, same in (
                (rendering.multi.peak, alone.multi.peak),
                (rendering.intensity, alone.intensity),
            ):
                np.testing.assert_allclose(one, same, rtol=0 if backend == "cpu" else 1e-5)
            assert (rendering.color is None) == (alone.color is None) == (scene is not coloured)


def test_render_refuses_unknown_backends() -> None:
    with pytest.raises(SceneError, match="metal"):
        render(SCENES["one pixel"], "draft", backend="metal")
