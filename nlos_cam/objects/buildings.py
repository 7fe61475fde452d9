"""Generators of what is lived in: birdhouse, tower."""

import numpy as np

from nlos_cam.objects.settings import Setting, category
from nlos_cam.objects.solids import Triangles, at, box, joined, lathe, pierced, ring, slab


@category(
    width=Setting(0.46, 0.58, held_out=(0.505, 0.54)),
    height=Setting(0.45, 0.6),
    depth=Setting(0.3, 0.4),
    gable=Setting(0.25, 0.4, held_out=(0.305, 0.345)),
    hole=Setting(0.09, 0.14),
)
def birdhouse(width: float, height: float, depth: float, gable: float, hole: float) -> Triangles:
    """A box with a gable roof, a round hole with its rim, and a perch under it."""
    eaves, front, sunk = height / 2 - 0.1, -depth / 2, 0.2
    house = at(box(width, height, depth - sunk), 0, -0.1, sunk / 2)
    face = at(pierced(width, height, hole, sunk), 0, -0.1, front + sunk / 2)
    rim = at(ring(hole + 0.02, 0.03), 0, -0.1, front)
    roof = slab([(-0.62 * width - 0.06, eaves), (0.62 * width + 0.06, eaves), (0, eaves + gable)], depth + 0.14)
    perch = at(box(0.06, 0.06, 0.24), 0, -0.16 - hole, front - 0.1)
    return joined(house, face, rim, roof, perch)


@category(
    radius=Setting(0.17, 0.25, held_out=(0.2, 0.225)),
    flare=Setting(1.15, 1.4, held_out=(1.24, 1.32)),
    turn=Setting(0.0, 1.0),
)
def tower(radius: float, flare: float, turn: float) -> Triangles:
    """A round tower with battlements."""
    head = radius * flare
    merlon = 0.45 * head
    shaft = lathe([(0, 0.35), (head, 0.35), (head, 0.22), (radius, 0.14), (radius * 1.1, -0.5), (0, -0.5)])
    around = np.linspace(0, 2 * np.pi, 6, endpoint=False) + turn
    crown = [at(box(merlon, 0.15, merlon), 0.85 * head * np.cos(a), 0.42, 0.85 * head * np.sin(a)) for a in around]
    return joined(shaft, *crown)
