"""Parametric generators of everyday things, in units of their own size; each takes a random generator.

Proportions vary with every call; a person names each from its picture. A generator builds the thing as it stands (y up)
with the side worth seeing towards the wall (z negative).
"""

from collections.abc import Callable

import numpy as np

from nlos_cam.objects.solids import Mesh, at, box, ellipsoid, joined, lathe, ring, slab, turned

Generator = np.random.Generator


def airplane(rng: Generator) -> Mesh:
    """Seen from above: fuselage, swept wings, tailplane, fin."""
    body, span, chord = rng.uniform(0.09, 0.13), rng.uniform(0.42, 0.55), rng.uniform(0.2, 0.3)
    sweep, tail = rng.uniform(0.05, 0.22), rng.uniform(0.16, 0.24)
    fuselage = ellipsoid(body, 0.5, body)
    wings = [
        slab([(0, 0.1), (0, 0.1 - chord), (s * span, -0.05 - sweep), (s * span, 0.05 - sweep)], 0.05) for s in (-1, 1)
    ]
    tails = [slab([(0, -0.34), (0, -0.48), (s * tail, -0.5), (s * tail, -0.42)], 0.05) for s in (-1, 1)]
    fin = at(box(0.05, 0.14, 0.18), 0, -0.42, -0.1)
    return joined(fuselage, *wings, *tails, fin)


def bell(rng: Generator) -> Mesh:
    """A bell with a flared rim, a crown and a clapper."""
    rim, waist = rng.uniform(0.4, 0.52), rng.uniform(0.2, 0.28)
    shell = lathe(
        [(0, 0.34), (waist * 0.7, 0.32), (waist, 0.2), (waist * 1.1, -0.1), (rim * 0.8, -0.28), (rim, -0.4), (0, -0.4)]
    )
    return joined(shell, at(ring(0.1, 0.045), 0, 0.42), at(ellipsoid(0.09, 0.09, 0.09), 0, -0.44))


def boat(rng: Generator) -> Mesh:
    """From the side: hull, mast and a triangular sail."""
    beam, sail = rng.uniform(0.14, 0.24), rng.uniform(0.6, 0.8)
    hull = slab([(-0.48, -0.2), (0.5, -0.2), (0.3, -0.45), (-0.32, -0.45)], 2 * beam)
    mast = at(box(0.06, sail + 0.1, 0.06), 0, sail / 2 - 0.22)
    lead, lag = rng.uniform(0.25, 0.4), rng.uniform(0.12, 0.3)
    sails = [
        slab([(0.0, sail - 0.2), (0.0, -0.12), (lead, -0.12)], 0.06),
        slab([(0.0, sail - 0.25), (0.0, -0.12), (-lag, -0.12)], 0.06),
    ]
    return joined(hull, mast, *sails)


def bowl(rng: Generator) -> Mesh:
    """Tilted towards the wall, so that its hollow shows."""
    depth, foot = rng.uniform(0.25, 0.4), rng.uniform(0.14, 0.22)
    outer = [(0, -depth), (foot, -depth), (0.38, -depth * 0.45), (0.5, 0)]
    inner = [(0.43, 0), (0.32, -depth * 0.42), (0.12, -depth * 0.8), (0, -depth * 0.8)]
    return turned(lathe(outer + inner), (1, 0, 0), -rng.uniform(35, 75))


def car(rng: Generator) -> Mesh:
    """From the side: body, cabin, two wheels."""
    height, wheel, width = rng.uniform(0.14, 0.2), rng.uniform(0.09, 0.12), rng.uniform(0.18, 0.24)
    front, back = rng.uniform(0.12, 0.3), rng.uniform(0.2, 0.4)
    body = at(box(1.0, height, 2 * width), 0, -0.08)
    top = height / 2 - 0.1
    cabin = slab([(-back, top), (front, top), (front - 0.12, top + 0.22), (0.08 - back, top + 0.22)], 1.7 * width)
    wheels = [
        at(turned(lathe([(0, 0), (wheel, 0), (wheel, 0.1), (0, 0.1)]), (1, 0, 0), -90), x, -0.2, -width - 0.04)
        for x in (-0.29, 0.29)
    ]
    return joined(body, cabin, *wheels)


def cup(rng: Generator) -> Mesh:
    """A mug with its handle to one side."""
    radius, taper, height = rng.uniform(0.26, 0.34), rng.uniform(0.75, 1.0), rng.uniform(0.6, 0.85)
    wall = [(0, -height / 2), (radius * taper, -height / 2), (radius, height / 2), (radius - 0.06, height / 2)]
    body = lathe([*wall, (radius * taper - 0.06, 0.08 - height / 2), (0, 0.08 - height / 2)])
    handle = at(ring(height * rng.uniform(0.24, 0.3), 0.055), radius * 0.95)
    return turned(joined(body, handle), (1, 0, 0), -rng.uniform(0, 25))


def hat(rng: Generator) -> Mesh:
    """A brimmed hat, a little tilted."""
    brim, crown, height = 0.5, rng.uniform(0.22, 0.3), rng.uniform(0.3, 0.5)
    profile = [
        (0, height),
        (crown * 0.85, height),
        (crown, height * 0.85),
        (crown * 1.1, 0.06),
        (brim, 0.04),
        (brim, -0.04),
        (0, -0.04),
    ]
    return turned(lathe(profile), (1, 0, 0), -rng.uniform(15, 60))


def lamp(rng: Generator) -> Mesh:
    """A table lamp: foot, stem, shade."""
    top, bottom, shade = rng.uniform(0.14, 0.24), rng.uniform(0.3, 0.42), rng.uniform(0.3, 0.42)
    hood = lathe([(0, 0.5), (top, 0.5), (bottom, 0.5 - shade), (0, 0.5 - shade)])
    stem = at(box(0.08, 0.6, 0.08), 0, -0.15)
    return joined(hood, stem, lathe([(0, -0.4), (rng.uniform(0.2, 0.3), -0.42), (0.3, -0.5), (0, -0.5)]))


def rocket(rng: Generator) -> Mesh:
    """Nose cone, body and fins."""
    radius, nose, fin = rng.uniform(0.13, 0.19), rng.uniform(0.2, 0.35), rng.uniform(0.14, 0.22)
    body = lathe(
        [
            (0, 0.5),
            (radius * 0.6, 0.5 - nose * 0.5),
            (radius, 0.5 - nose),
            (radius, -0.4),
            (radius * 0.6, -0.5),
            (0, -0.5),
        ]
    )
    fins = [
        slab(
            [
                (s * radius * 0.8, -0.1),
                (s * radius * 0.8, -0.42),
                (s * (radius + fin), -0.5),
                (s * (radius + fin), -0.34),
            ],
            0.06,
        )
        for s in (-1, 1)
    ]
    return joined(body, *fins, at(box(0.06, 0.3, fin), 0, -0.33, -radius))


def table(rng: Generator) -> Mesh:
    """A table seen a little from above: top and four legs."""
    width, depth, leg, height = (
        rng.uniform(0.85, 1.0),
        rng.uniform(0.4, 0.6),
        rng.uniform(0.08, 0.12),
        rng.uniform(0.45, 0.7),
    )
    legs = [
        at(box(leg, height, leg), x * (width - leg) / 2, -height / 2, z * (depth - leg) / 2)
        for x in (-1, 1)
        for z in (-1, 1)
    ]
    return turned(joined(box(width, 0.09, depth), *legs), (1, 0, 0), -rng.uniform(15, 40))


def tower(rng: Generator) -> Mesh:
    """A round tower with battlements."""
    radius, flare = rng.uniform(0.17, 0.25), rng.uniform(1.15, 1.4)
    shaft = lathe(
        [(0, 0.35), (radius * flare, 0.35), (radius * flare, 0.22), (radius, 0.14), (radius * 1.1, -0.5), (0, -0.5)]
    )
    around = np.linspace(0, 2 * np.pi, 6, endpoint=False) + rng.uniform(0, 1)
    crown = [
        at(box(0.13, 0.14, 0.13), 0.9 * radius * flare * np.cos(a), 0.42, 0.9 * radius * flare * np.sin(a))
        for a in around
    ]
    return joined(shaft, *crown)


def birdhouse(rng: Generator) -> Mesh:
    """A box with a gable roof, a round hole's rim and a perch."""
    width, height, depth = rng.uniform(0.46, 0.58), rng.uniform(0.45, 0.6), rng.uniform(0.3, 0.4)
    eaves = height / 2 - 0.1
    house = at(box(width, height, depth), 0, -0.1)
    roof = slab(
        [(-0.62 * width - 0.06, eaves), (0.62 * width + 0.06, eaves), (0, eaves + rng.uniform(0.25, 0.4))], depth + 0.14
    )
    front = -depth / 2 - 0.02
    return joined(house, roof, at(ring(0.12, 0.04), 0, 0, front), at(box(0.06, 0.06, 0.2), 0, -0.22, front - 0.08))


CATEGORIES: dict[str, Callable[[Generator], Mesh]] = {
    make.__name__: make for make in (airplane, bell, birdhouse, boat, bowl, car, cup, hat, lamp, rocket, table, tower)
}
"""By name, in a fixed order: a seed picks the same thing everywhere."""
