"""Levelling: gain and offset of each map, fitted on cells that carry no information."""

from functools import lru_cache

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, OBJECT_PIXELS
from nlos_cam.objects import object_box

QUIET_SHARE = 0.5
"""Share of the wall's cells that levelling may use: those that see least of the object box."""
ROUNDS = 5
HUBER = 1.5
"""Residual, in robust standard deviations, from which a cell counts less."""


def quiet_cells(rig: Rig | None) -> NDArray[np.bool_]:
    """Return the cells (64, 80) that receive least three-bounce light from a sheet which fills the
    object box, relative to their direct return; all cells without a rig or a box.
    """
    if rig is None or rig.object_box is None:
        return np.ones((MAP_ROWS, MAP_COLUMNS), np.bool_)
    return _dimmest_cells(rig.model_dump_json())


@lru_cache(maxsize=4)
def _dimmest_cells(rig_json: str) -> NDArray[np.bool_]:
    rig = Rig.model_validate_json(rig_json)
    shape = MAP_ROWS, MAP_COLUMNS
    from nlos_cam.render import Scene, cast, three_bounce

    # The rendering equation, not the paper's law: the choice needs only an order of cells, and a
    # matt sheet in the middle of the box lights all cells that any object there can light.
    box = object_box(rig)
    middle_m = (box.z_near_m + box.z_far_m) / 2.0
    sheet_m = np.full((OBJECT_PIXELS, OBJECT_PIXELS), middle_m, np.float32)
    try:
        scene = Scene(rig, sheet_m, radiometry="lambertian")
        third = np.asarray(three_bounce(scene, "draft"), np.float64).sum(axis=-1)
    except SceneError:
        return np.ones(shape, np.bool_)
    direct = cast(rig, scene.cell_intrinsics, lambertian=True).direct.astype(np.float64).ravel()
    third = third.reshape(MAP_ROWS * MAP_COLUMNS, -1).mean(axis=1)
    lit = direct > 0
    share = np.divide(third, direct, out=np.full(direct.shape, np.inf), where=lit)
    return (share <= np.quantile(share[lit], QUIET_SHARE)).reshape(shape)


def level(maps: Float64, noise: Float64, quiet: NDArray[np.bool_]) -> Float64:
    """Return maps (T, 64, 80) of one channel, less gain and offset of each against their mean.

    `noise` (64, 80) is the standard deviation of a cell. The same for every order of labels, since
    neither mean nor fit knows which turns have the object.
    """
    reference = maps.mean(axis=0)
    usable = np.isfinite(reference) & (noise > 0)
    used = usable & quiet if np.count_nonzero(usable & quiet) > 2 else usable
    if np.count_nonzero(used) <= 2:
        return maps - reference

    # map = (1 + g) reference + o: two numbers for each map. Around the mean of the reference,
    # gain and offset are independent.
    center = reference[used].mean()
    basis = np.stack([np.ones(np.count_nonzero(used)), reference[used] - center], axis=1)
    everywhere = np.stack([np.ones(reference.shape), reference - center], axis=-1)
    weight = 1.0 / noise[used]
    leveled = np.empty_like(maps)
    for number, each in enumerate(maps):
        off = each - reference
        leveled[number] = off - everywhere @ _robust_fit(basis, off[used], weight)
    return leveled


def _robust_fit(basis: Float64, values: Float64, weight: Float64) -> Float64:
    """Return the coefficients (2,) of a fit by Huber's weights; `weight` is one over the noise."""
    # Cells that do carry light (the choice is a model's) are outliers here, and count little.
    extra = np.ones(len(values))
    found = np.zeros(2)
    for _ in range(ROUNDS):
        # The normal equations: two centered columns, so nothing is lost by squaring them.
        weighted = basis * (weight**2 * extra)[:, None]
        solved = np.linalg.lstsq(weighted.T @ basis, weighted.T @ values, rcond=None)[0]
        found = solved.astype(np.float64)
        residual = np.abs((values - basis @ found) * weight)
        scale = 1.4826 * float(np.median(residual))
        extra = np.minimum(1.0, HUBER * scale / np.maximum(residual, 1e-300))
        if scale == 0.0:
            break
    return found
