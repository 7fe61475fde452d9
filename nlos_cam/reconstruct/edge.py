"""Cells at the occluder's edge, where a bench that is a little off its record differs most from it.

A column of cells there sees the wall in place of the occluder, or the other way round, as soon as
the lidar or the occluder stands some millimetres elsewhere. These few cells are then off by far more
than an object moves any, and a network that was trained on exact benches answers them with nonsense.
"""

from itertools import product

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Mask

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS
from nlos_cam.render import cast

BEAMS_PER_CELL = 4
"""Along each side of a cell: an edge within it counts, not only one that passes its middle."""
SIGNS = -1, 1


def edge_cells(rig: Rig, place_m: float, angle_deg: float) -> Mask:
    """Return the cells (64, 80) that the occluder's edge crosses or can pass, on a bench whose
    lidar and occluder are up to `place_m` elsewhere and whose lidar is turned by up to `angle_deg`.

    None of a rig without an occluder.
    """
    sheet = rig.occluder
    if sheet is None:
        return np.zeros((MAP_ROWS, MAP_COLUMNS), bool)
    lidar = rig.lidar
    lidars = [
        lidar.model_copy(
            update={
                "distance_m": lidar.distance_m + farther * place_m,
                "yaw_deg": lidar.yaw_deg + turned * angle_deg,
                "pitch_deg": lidar.pitch_deg + raised * angle_deg,
            }
        )
        for farther, turned, raised in product(SIGNS, repeat=3)
    ]
    sheets = [
        sheet.model_copy(
            update={"x_m": sheet.x_m + along * place_m, "z_min_m": sheet.z_min_m + wider * place_m}
        )
        for along, wider in product(SIGNS, repeat=2)
    ]
    some = np.zeros((MAP_ROWS, MAP_COLUMNS), bool)
    every = ~some
    for lidar, sheet in product(lidars, sheets):
        bench = rig.model_copy(update={"lidar": lidar, "occluder": sheet})
        # beams of a cell follow each other along both sides
        beams = _occluded(bench).reshape(MAP_ROWS, BEAMS_PER_CELL, MAP_COLUMNS, BEAMS_PER_CELL)
        some |= beams.any((1, 3))
        every &= beams.all((1, 3))
    return some & ~every


def _occluded(rig: Rig) -> Mask:
    """Return which beams (256, 320) meet the occluder before the wall."""
    finer = rig.pinhole.scaled(BEAMS_PER_CELL * MAP_COLUMNS, BEAMS_PER_CELL * MAP_ROWS)
    alone, with_occluder = (
        cast(rig, finer, occluder=occluder).on_wall for occluder in (False, True)
    )
    return (alone & ~with_occluder).reshape(finer.height, finer.width)
