"""Second set of test objects: 54 of 18 kinds that no training object resembles by construction.

Each kind has three variants, given by `k` from 0 to 2. Nothing here is random, and nothing may
serve for training. Objects stand with y up and face the wall (-z), in units of their own size.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from nlos_calibration.arrays import Float64

from nlos_cam.objects.primitives import (
    Point,
    arch,
    at,
    bar,
    box,
    disc,
    ellipsoid,
    joined,
    knob,
    lathe,
    prism,
    ring,
    slab,
    tipped,
    turned,
)

Kind = Callable[[int], Float64]
SIDES = (-1, 1)


def _line(points: Sequence[Point], width: float, thickness: float) -> Float64:
    """Return a bent bar with round joints."""
    joints = [at(disc(width / 2, thickness), x, y) for x, y in points]
    return joined(*(bar(a, b, width, thickness) for a, b in pairwise(points)), *joints)


def letter(k: int) -> Float64:
    """Build an A, a K or an R."""
    leg = [(-0.3, -0.5), (-0.3, 0.5)]
    strokes = (
        [
            [(-0.35, -0.5), (0.0, 0.5), (0.35, -0.5)],
            [(-0.2, -0.1), (0.2, -0.1)],
        ],
        [leg, [(0.3, 0.5), (-0.3, -0.02), (0.32, -0.5)]],
        [
            leg,
            [
                (-0.3, 0.5),
                (0.15, 0.5),
                (0.3, 0.27),
                (0.15, 0.02),
                (-0.3, 0.02),
            ],
            [(0.0, 0.02), (0.32, -0.5)],
        ],
    )[k]
    return joined(*(_line(stroke, 0.14, 0.16) for stroke in strokes))


def gear(k: int) -> Float64:
    """Build a toothed wheel with a hub that stands out."""
    teeth = 8 + 3 * k
    angle = np.pi * (np.arange(4 * teeth) // 2) / teeth
    radius = np.tile([0.38, 0.5, 0.5, 0.38], teeth)
    wheel = prism(
        radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]),
        0.16,
    )
    return joined(
        wheel,
        at(disc(0.14 + 0.03 * k, 0.3), z=-0.05),
        ring(0.3, 0.04),
    )


def chair(k: int) -> Float64:
    """Build a chair with a slatted back, turned aside and seen from above."""
    legs = [
        at(
            box(0.07, 0.42, 0.07),
            0.2 * s,
            -0.29,
            0.2 * t,
        )
        for s in SIDES
        for t in SIDES
    ]
    posts = [at(box(0.06, 0.6, 0.06), 0.2 * s, 0.22, 0.2) for s in SIDES]
    slats = [
        at(
            box(0.4, 0.07, 0.04),
            0,
            y,
            0.2,
        )
        for y in np.linspace(0.12, 0.48, 2 + k)
    ]
    whole = joined(at(box(0.48, 0.07, 0.48), 0, -0.06), *legs, *posts, *slats)
    return tipped(turned(whole, (0, 1, 0), 25 + 15 * k), 15)


def tree(k: int) -> Float64:
    """Build a conifer of two to four storeys on a trunk."""
    storeys = 2 + k
    tops = np.linspace(0.5, 0.12 - 0.06 * k, storeys)
    crowns = [
        lathe(
            [
                (0, top),
                (0.2 + 0.2 * n / storeys, top - 0.4),
                (0, top - 0.36),
            ]
        )
        for n, top in enumerate(tops.tolist())
    ]
    return joined(*crowns, at(box(0.1, 0.3, 0.1), 0, -0.42))


def hand(k: int) -> Float64:
    """Build an open hand: palm, four fingers, thumb."""
    spread = 8 + 6 * k
    parts = [ellipsoid(0.2, 0.24, 0.09)]
    for n, length in enumerate((0.2, 0.24, 0.23, 0.17)):
        finger = at(ellipsoid(0.05, length, 0.05), 0, length)
        parts.append(
            at(
                turned(finger, (0, 0, 1), spread * (1.5 - n)),
                0.1 * (n - 1.5),
                0.14,
            )
        )
    thumb = turned(
        at(ellipsoid(0.055, 0.18, 0.055), 0, 0.18),
        (0, 0, 1),
        50 + 5 * k,
    )
    return joined(*parts, at(thumb, -0.12, -0.08))


def key(k: int) -> Float64:
    """Build a door key: bow, shaft, bits."""
    bits = [
        at(
            box(0.07, 0.16 - 0.04 * (n % 2), 0.08),
            0.42 - 0.11 * n,
            -0.1,
        )
        for n in range(2 + k)
    ]
    return joined(
        at(ring(0.17, 0.05), -0.3),
        bar((-0.14, 0), (0.5, 0), 0.08, 0.08),
        *bits,
    )


def fish(k: int) -> Float64:
    """Build a fish from the side: body, tail, fins, eye."""
    body = ellipsoid(0.36, 0.15 + 0.04 * k, 0.1)
    tail = [
        slab(
            [(0.3, 0.0), (0.52, s * (0.16 + 0.04 * k)), (0.44, 0.0)],
            0.05,
        )
        for s in SIDES
    ]
    fin = slab(
        [(-0.1, 0.1), (0.16, 0.1), (0.1, 0.3 + 0.03 * k)],
        0.05,
    )
    return joined(body, *tail, fin, at(knob(0.035, 0.05), -0.24, 0.04, -0.07))


def star(k: int) -> Float64:
    """Build a star of five to seven points with raised middle."""
    points = 5 + k
    angle = np.pi * np.arange(2 * points) / points + np.pi / 2
    outline = np.where(
        np.arange(2 * points) % 2,
        0.21,
        0.5,
    )[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return prism(outline, 0.24, 0.35)


def spiral(k: int) -> Float64:
    """Build a flat spiral of two turns and more."""
    angle = np.linspace(0, 2 * np.pi * (1.75 + 0.25 * k), 48)
    radius = 0.06 + 0.4 * angle / angle[-1]
    return _line(
        [
            *zip(
                (radius * np.cos(angle)).tolist(),
                (radius * np.sin(angle)).tolist(),
                strict=True,
            )
        ],
        0.085,
        0.12,
    )


def ladder(k: int) -> Float64:
    """Build a ladder that leans away at the top."""
    rails = [at(box(0.06, 1.0, 0.06), 0.18 * s) for s in SIDES]
    rungs = [
        at(
            box(0.36, 0.05, 0.05),
            0,
            y,
        )
        for y in np.linspace(-0.4, 0.4, 4 + k)
    ]
    return turned(joined(*rails, *rungs), (1, 0, 0), 12 + 8 * k)


def umbrella(k: int) -> Float64:
    """Build an open umbrella from the side, with a crook."""
    rise = 0.22 + 0.06 * k
    canopy = [
        (
            0.48 * np.sin(a),
            rise * np.cos(a),
        )
        for a in np.linspace(0, np.pi / 2, 8)
    ]
    stick = bar((0, 0.05), (0, -0.5), 0.05, 0.05)
    crook = turned(arch(0.08, 0.025), (1, 0, 0), 180)
    return tipped(
        joined(
            at(lathe([*canopy, (0, 0.02)]), 0, 0.1),
            stick,
            at(crook, 0.08, -0.5),
        ),
        -5 * k,
    )


def teapot(k: int) -> Float64:
    """Build a teapot: belly, lid, spout, handle."""
    belly = ellipsoid(0.3, 0.22 + 0.03 * k, 0.3)
    spout = at(bar((0.22, -0.05), (0.5, 0.2), 0.09, 0.09))
    handle = at(ring(0.15, 0.035), -0.33, 0.02)
    return joined(
        belly,
        spout,
        handle,
        at(
            lathe([(0, 0.1), (0.16, 0.0), (0, 0.0)]),
            0,
            0.2 + 0.03 * k,
        ),
        at(knob(0.05, 0.05), 0, 0.33),
    )


def barbell(k: int) -> Float64:
    """Build a barbell with one to three discs on each end, turned aside."""
    discs = [
        turned(
            at(disc(0.26 - 0.05 * n, 0.07), z=s * (0.42 - 0.09 * n)),
            (0, 1, 0),
            90,
        )
        for s in SIDES
        for n in range(1 + k)
    ]
    return turned(joined(box(1.0, 0.07, 0.07), *discs), (0, 1, 0), 25)


def windmill(k: int) -> Float64:
    """Build a windmill: tower, cap and four sails."""
    tower = lathe(
        [
            (0, 0.1),
            (0.12, 0.1),
            (0.2, -0.5),
            (0, -0.5),
        ]
    )
    sails = [
        turned(
            bar((0.04, 0.05), (0.42, 0.05), 0.11, 0.04),
            (0, 0, 1),
            90 * n + 15 + 20 * k,
        )
        for n in range(4)
    ]
    return joined(
        tower,
        at(
            ellipsoid(0.13, 0.1, 0.13),
            0,
            0.1,
        ),
        *(at(sail, 0, 0.12, -0.2) for sail in sails),
    )


def mushroom(k: int) -> Float64:
    """Build a mushroom with a domed cap."""
    cap = [
        (0.42 * np.sin(a), 0.12 + (0.24 + 0.06 * k) * np.cos(a))
        for a in np.linspace(0, np.pi / 2, 8)
    ]
    stem = [
        (0.13, 0.1),
        (0.11, -0.2),
        (0.17 + 0.02 * k, -0.45),
        (0, -0.45),
    ]
    return tipped(lathe([*cap, (0.4, 0.08), *stem]), 8 * k)


def anchor(k: int) -> Float64:
    """Build an anchor: ring, stock, shank, arms with flukes."""
    arms = at(
        turned(arch(0.32 + 0.03 * k, 0.04), (0, 0, 1), 180),
        0,
        -0.1,
    )
    tips = [
        at(
            slab([(-0.08, -0.03), (0.08, -0.03), (0, 0.12)], 0.07),
            s * (0.32 + 0.03 * k),
            -0.1,
        )
        for s in SIDES
    ]
    stock = at(box(0.4 + 0.06 * k, 0.07, 0.07), 0, 0.26)
    return joined(
        arms,
        *tips,
        stock,
        bar(
            (0, -0.45),
            (0, 0.38),
            0.08,
            0.08,
        ),
        at(ring(0.08, 0.03), 0, 0.45),
    )


def stairs(k: int) -> Float64:
    """Build a flight of three to five steps, turned aside."""
    steps = 3 + k
    side = 1.0 / steps
    parts = [
        at(
            box(side, side * (n + 1), 0.5),
            side * (n + 0.5) - 0.5,
            side * (n + 1) / 2 - 0.5,
        )
        for n in range(steps)
    ]
    return turned(joined(*parts), (0, 1, 0), 20 + 10 * k)


def figure(k: int) -> Float64:
    """Build a standing person with arms raised by 20 to 100 degrees."""
    lift = 20 + 40 * k
    parts = [
        at(ellipsoid(0.09, 0.11, 0.1), 0, 0.4),
        at(ellipsoid(0.14, 0.24, 0.1), 0, 0.08),
    ]
    for s in SIDES:
        arm = turned(
            at(ellipsoid(0.05, 0.19, 0.05), 0, -0.17),
            (0, 0, 1),
            s * lift,
        )
        leg = turned(
            at(ellipsoid(0.065, 0.22, 0.07), 0, -0.2),
            (0, 0, 1),
            s * 8,
        )
        parts += [at(arm, s * 0.13, 0.24), at(leg, s * 0.07, -0.1)]
    return joined(*parts)


KINDS: dict[str, Kind] = {
    kind.__name__: kind
    for kind in (
        *(anchor, barbell, chair, figure, fish, gear, hand, key, ladder),
        *(letter, mushroom, spiral, stairs, star, teapot, tree, umbrella, windmill),
    )
}
"""By name, in alphabetical order."""
