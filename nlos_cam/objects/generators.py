"""Generators of the 18 object categories of SI 1 of the paper, and the ranges of their settings.

A generator builds a recognisable object as it stands (y up), in units of its own size, with its
telling side towards the wall (-z). Each setting is a proportion with a range; some have a held-out
interval, which no training seed draws and from which the benchmark takes its values.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from nlos_calibration.arrays import Float64

from nlos_cam.errors import UnknownNameError, did_you_mean
from nlos_cam.objects.primitives import (
    arch,
    at,
    bar,
    box,
    disc,
    ellipsoid,
    frame,
    joined,
    knob,
    lathe,
    pierced,
    ring,
    slab,
    tipped,
    turned,
)


@dataclass(frozen=True)
class Setting:
    """Range of one proportion of an object, in units of its size, in degrees, or a count (the whole
    part).
    """

    low: float
    high: float
    held_out: tuple[float, float] | None = None
    """Open interval, within the range or beside it, that training never draws from."""

    @property
    def training_intervals(self) -> list[tuple[float, float]]:
        """The closed intervals that training draws from."""
        if self.held_out is None:
            return [(self.low, self.high)]
        gap_low, gap_high = self.held_out
        pieces = (
            (self.low, min(self.high, gap_low)),
            (
                max(self.low, gap_high),
                self.high,
            ),
        )
        return [(low, high) for low, high in pieces if low < high]

    def draw(self, unit: float) -> float:
        """Return the value at `unit` in [0, 1] of the training intervals, joined end to end."""
        # Uniform over the intervals joined end to end: past the first, the value skips the gap.
        pieces = self.training_intervals
        value = pieces[0][0] + sum(high - low for low, high in pieces) * unit
        if len(pieces) == 1 or value <= pieces[0][1]:
            return value
        return max(
            pieces[1][0],
            value + (pieces[1][0] - pieces[0][1]),
        )

    def draw_held_out(self, unit: float) -> float:
        """Return the value at `unit` in ]0, 1[ of the held-out interval, or of the whole range if
        there is none.
        """
        if self.held_out is None:
            return self.draw(unit)
        low, high = self.held_out
        return low + (high - low) * unit


@dataclass(frozen=True)
class Category:
    """Object category: its generator, and its settings in the order in which a seed draws them."""

    make: Callable[..., Float64]
    settings: Mapping[str, Setting]

    @property
    def name(self) -> str:
        """The generator's name, an everyday word."""
        return self.make.__name__

    def draw(self, units: Iterable[float]) -> dict[str, float]:
        """Return training settings from numbers in [0, 1], one for each."""
        return {
            name: s.draw(unit)
            for (name, s), unit in zip(
                self.settings.items(),
                units,
                strict=True,
            )
        }

    def draw_held_out(self, units: Iterable[float]) -> dict[str, float]:
        """Return benchmark settings from numbers in ]0, 1[, one for each."""
        return {
            name: s.draw_held_out(unit)
            for (name, s), unit in zip(self.settings.items(), units, strict=True)
        }


def category(**settings: Setting) -> Callable[[Callable[..., Float64]], Category]:
    """Return a decorator that makes a category from a generator function and the ranges of its
    arguments.
    """
    return lambda make: Category(make, settings)


SIDES = (-1, 1)


def _at_corners(solid: Float64, x: float, y: float, z: float) -> list[Float64]:
    return [at(solid, s * x, y, t * z) for s in SIDES for t in SIDES]


@category(
    width=Setting(0.8, 1.0, held_out=(0.875, 0.93)),
    height=Setting(0.5, 0.64, held_out=(0.55, 0.595)),
    neck=Setting(0.14, 0.22),
    reach=Setting(0.34, 0.46),
    tip=Setting(14, 30),
)
def computer(width: float, height: float, neck: float, reach: float, tip: float) -> Float64:
    """Build a screen set into its frame, on a neck and a foot, with a keyboard in front."""
    foot = -height / 2 - neck
    screen = joined(
        frame(width, height, 0.07, 0.18), at(box(width - 0.1, height - 0.1, 0.04), z=0.06)
    )
    stand = joined(
        at(box(0.16, neck, 0.08), y=foot + neck / 2),
        at(box(0.4, 0.04, 0.26), y=foot),
    )
    keys = [
        at(
            box(width * 0.74, 0.06, 0.05),
            y=0.03,
            z=z,
        )
        for z in (-0.09, 0.0, 0.09)
    ]
    keyboard = turned(
        joined(box(width * 0.8, 0.05, 0.3), *keys),
        (1, 0, 0),
        -15,
    )
    return tipped(joined(screen, stand, at(keyboard, y=foot + 0.02, z=-reach)), tip)


@category(
    width=Setting(0.56, 0.76, held_out=(0.635, 0.69)),
    depth=Setting(0.24, 0.34),
    shelves=Setting(2, 5),
    ajar=Setting(60, 115, held_out=(80, 95)),
    tip=Setting(-5, 15),
)
def cupboard(width: float, depth: float, shelves: float, ajar: float, tip: float) -> Float64:
    """Build a cupboard on short legs: one door is shut, the other stands open and shows the
    shelves.
    """
    leaf = width / 2 - 0.02
    rows = int(shelves)
    case = joined(
        frame(width, 0.9, 0.05, depth),
        at(box(width, 0.9, 0.03), z=depth / 2),
    )
    boards = [
        at(
            box(width - 0.04, 0.04, depth * 0.85),
            y=0.9 * (k / rows - 0.5),
            z=0.03,
        )
        for k in range(1, rows)
    ]
    middle = box(0.04, 0.9, depth)
    door = joined(
        at(box(leaf, 0.88, 0.04), leaf / 2),
        at(knob(0.035, 0.05), leaf * 0.85, z=-0.05),
    )
    shut = at(door * (-1, 1, 1), width / 2, z=-depth / 2 - 0.02)
    wide = at(
        turned(door, (0, 1, 0), ajar),
        -width / 2,
        z=-depth / 2 - 0.02,
    )
    cornice = at(box(width + 0.08, 0.06, depth + 0.06), y=0.47)
    legs = _at_corners(box(0.08, 0.1, 0.08), width / 2 - 0.05, -0.5, depth / 3)
    return tipped(joined(case, *boards, middle, shut, wide, cornice, *legs), tip)


@category(
    width=Setting(0.62, 0.78, held_out=(0.68, 0.725)),
    depth=Setting(0.42, 0.56),
    window=Setting(0.26, 0.4, held_out=(0.31, 0.355)),
    knobs=Setting(3, 6),
    tip=Setting(18, 36),
)
def oven(width: float, depth: float, window: float, knobs: float, tip: float) -> Float64:
    """Build a cooker seen a little from above: hob with rings, knobs, handle, door with a recessed
    window.
    """
    front = -depth / 2
    count = int(knobs)
    door = at(
        frame(width, 0.6, (0.6 - window) / 2, 0.14),
        y=-0.2,
        z=front + 0.07,
    )
    body = joined(
        at(
            box(width, 0.6, depth - 0.14),
            y=-0.2,
            z=0.07,
        ),
        at(box(width, 0.26, depth), y=0.23),
    )
    dials = [
        at(disc(0.05, 0.1), width * ((k + 0.5) / count - 0.5), 0.23, front - 0.05)
        for k in range(count)
    ]
    handle = at(box(width * 0.7, 0.05, 0.05), 0, 0.03, front - 0.08)
    ring_profile = [(0.05, 0), (0.05, 0.06), (0.12, 0.06), (0.12, 0)]
    rings = _at_corners(lathe(ring_profile), width / 4, 0.36, depth / 4)
    return tipped(joined(door, body, *dials, handle, *rings), tip)


@category(
    width=Setting(0.46, 0.62, held_out=(0.52, 0.565)),
    depth=Setting(0.3, 0.42),
    woofer=Setting(0.35, 0.45, held_out=(0.39, 0.415)),
    tweeter=Setting(0.2, 0.28),
)
def soundbox(width: float, depth: float, woofer: float, tweeter: float) -> Float64:
    """Build a loudspeaker: a tall box with a large cone below and a small one above."""
    low = _speaker(width, 0.6, woofer * width)
    high = _speaker(width, 0.4, tweeter * width)
    fronts = joined(at(low, y=-0.2), at(high, y=0.3))
    return joined(
        at(fronts, z=-depth / 2),
        at(box(width, 1.0, depth - 0.28), z=0.14),
    )


def _speaker(width: float, height: float, radius: float) -> Float64:
    """Return a front plate at z = 0, facing the wall, with a sunk cone, its rim and its cap."""
    cone = turned(
        lathe([(radius, 0.0), (radius * 0.4, -0.25), (0, -0.25)]),
        (1, 0, 0),
        -90,
    )
    cap = at(knob(radius * 0.4, 0.1), z=0.25)
    return joined(
        at(pierced(width, height, radius, 0.28), z=0.14),
        ring(radius, 0.03),
        cone,
        cap,
    )


@category(
    width=Setting(0.85, 1.0),
    depth=Setting(0.4, 0.6, held_out=(0.475, 0.53)),
    leg=Setting(0.08, 0.12),
    height=Setting(0.45, 0.7, held_out=(0.54, 0.61)),
    tip=Setting(15, 40),
)
def table(width: float, depth: float, leg: float, height: float, tip: float) -> Float64:
    """Build a table seen a little from above: top and four legs."""
    legs = _at_corners(
        box(leg, height, leg),
        (width - leg) / 2,
        -height / 2,
        (depth - leg) / 2,
    )
    return tipped(joined(box(width, 0.09, depth), *legs), tip)


@category(
    width=Setting(0.46, 0.58, held_out=(0.505, 0.54)),
    height=Setting(0.45, 0.6),
    depth=Setting(0.3, 0.4),
    gable=Setting(0.25, 0.4, held_out=(0.305, 0.345)),
    hole=Setting(0.09, 0.14),
)
def birdhouse(width: float, height: float, depth: float, gable: float, hole: float) -> Float64:
    """Build a box with a gable roof, a round hole with a rim, and a perch below it."""
    eaves = height / 2 - 0.1
    front = -depth / 2
    sunk = 0.2
    house = at(box(width, height, depth - sunk), 0, -0.1, sunk / 2)
    face = at(pierced(width, height, hole, sunk), 0, -0.1, front + sunk / 2)
    rim = at(ring(hole + 0.02, 0.03), 0, -0.1, front)
    roof = slab(
        [
            (-0.62 * width - 0.06, eaves),
            (0.62 * width + 0.06, eaves),
            (0, eaves + gable),
        ],
        depth + 0.14,
    )
    perch = at(box(0.06, 0.06, 0.24), 0, -0.16 - hole, front - 0.1)
    return joined(house, face, rim, roof, perch)


@category(
    radius=Setting(0.17, 0.25, held_out=(0.2, 0.225)),
    flare=Setting(1.15, 1.4, held_out=(1.24, 1.32)),
    turn=Setting(0.0, 1.0),
)
def tower(radius: float, flare: float, turn: float) -> Float64:
    """Build a round tower with battlements."""
    head = radius * flare
    merlon = 0.45 * head
    shaft = lathe(
        [
            (0, 0.35),
            (head, 0.35),
            (head, 0.22),
            (radius, 0.14),
            (radius * 1.1, -0.5),
            (0, -0.5),
        ]
    )
    around = np.linspace(0, 2 * np.pi, 6, endpoint=False) + turn
    crown = [
        at(
            box(merlon, 0.15, merlon),
            0.85 * head * np.cos(a),
            0.42,
            0.85 * head * np.sin(a),
        )
        for a in around
    ]
    return joined(shaft, *crown)


@category(
    bottom=Setting(0.26, 0.36),
    height=Setting(0.34, 0.48, held_out=(0.39, 0.43)),
    handle=Setting(0.85, 1.3, held_out=(1.01, 1.14)),
    ribs=Setting(3, 6),
    tip=Setting(10, 30),
)
def baskets(bottom: float, height: float, handle: float, ribs: float, tip: float) -> Float64:
    """Build a round woven basket, tipped so that its hollow shows, with a tall handle."""
    rows = 2 * int(ribs) + 1
    top = 0.44
    low = -height
    weave = [
        (
            bottom + (top - bottom) * k / rows + (0.035 if k % 2 else 0.0),
            low + height * k / rows,
        )
        for k in range(rows + 1)
    ]
    hollow = [(top - 0.06, 0.0), (bottom - 0.06, low * 0.8), (0, low * 0.8)]
    shell = lathe(
        [
            (0, low),
            *weave,
            (top + 0.035, -0.02),
            (top + 0.035, 0.03),
            *hollow,
        ]
    )
    return tipped(joined(shell, arch(top - 0.02, 0.04) * (1, handle, 1.4)), tip)


@category(
    rim=Setting(
        0.4,
        0.52,
        held_out=(0.44, 0.475),
    ),
    waist=Setting(0.2, 0.28, held_out=(0.23, 0.255)),
)
def bell(rim: float, waist: float) -> Float64:
    """Build a bell with a flared rim, a crown and a clapper."""
    crown = [(0, 0.34), (waist * 0.7, 0.32), (waist, 0.2)]
    shell = lathe(
        [
            *crown,
            (waist * 1.1, -0.1),
            (rim * 0.8, -0.28),
            (rim, -0.4),
            (0, -0.4),
        ]
    )
    return joined(
        shell,
        at(ring(0.1, 0.045), 0, 0.42),
        at(knob(0.09, 0.09), 0, -0.44),
    )


@category(
    depth=Setting(0.28, 0.42, held_out=(0.33, 0.37)),
    foot=Setting(0.16, 0.24, held_out=(0.19, 0.215)),
    tip=Setting(20, 42),
)
def bowl(depth: float, foot: float, tip: float) -> Float64:
    """Build a bowl tipped towards the wall, so that its hollow shows above its side and foot."""
    base = [(0, -depth - 0.06), (foot, -depth - 0.06), (foot, -depth)]
    outer = [*base, (0.38, -depth * 0.5), (0.47, -depth * 0.15), (0.5, 0)]
    inner = [
        (0.44, 0),
        (0.33, -depth * 0.5),
        (0.14, -depth * 0.85),
        (0, -depth * 0.85),
    ]
    return tipped(lathe(outer + inner), tip)


@category(
    radius=Setting(0.26, 0.34, held_out=(0.29, 0.315)),
    taper=Setting(0.75, 1.0),
    height=Setting(0.6, 0.85, held_out=(0.69, 0.76)),
    handle=Setting(0.24, 0.3),
    tip=Setting(5, 28),
)
def cup(radius: float, taper: float, height: float, handle: float, tip: float) -> Float64:
    """Build a mug with its handle to one side."""
    wall = [
        (0, -height / 2),
        (radius * taper, -height / 2),
        (radius, height / 2),
        (radius - 0.06, height / 2),
    ]
    body = lathe(
        [
            *wall,
            (radius * taper - 0.06, 0.08 - height / 2),
            (0, 0.08 - height / 2),
        ]
    )
    return tipped(joined(body, at(ring(height * handle, 0.055), radius * 0.95)), tip)


@category(
    crown=Setting(0.22, 0.3, held_out=(0.25, 0.275)),
    height=Setting(0.36, 0.54, held_out=(0.43, 0.48)),
    tip=Setting(8, 38),
)
def hat(crown: float, height: float, tip: float) -> Float64:
    """Build a brimmed hat with its band, a little tipped."""
    top = [
        (0, height - 0.03),
        (crown * 0.6, height),
        (crown * 0.85, height),
        (crown, height * 0.85),
    ]
    band = [(crown * 1.06, 0.2), (crown * 1.2, 0.2), (crown * 1.24, 0.06)]
    return tipped(
        lathe(
            [
                *top,
                *band,
                (0.42, 0.02),
                (0.5, 0.05),
                (0.5, 0.0),
                (0, -0.04),
            ]
        ),
        tip,
    )


@category(
    top=Setting(0.14, 0.24, held_out=(0.175, 0.205)),
    bottom=Setting(0.3, 0.42),
    shade=Setting(0.3, 0.42, held_out=(0.345, 0.38)),
    foot=Setting(0.2, 0.3),
)
def lamp(top: float, bottom: float, shade: float, foot: float) -> Float64:
    """Build a table lamp: foot, stem, shade."""
    hood = lathe(
        [
            (0, 0.5),
            (top, 0.5),
            (bottom, 0.5 - shade),
            (0, 0.5 - shade),
        ]
    )
    stem = at(box(0.08, 0.6, 0.08), 0, -0.15)
    return joined(
        hood,
        stem,
        lathe(
            [
                (0, -0.4),
                (foot, -0.42),
                (0.3, -0.5),
                (0, -0.5),
            ]
        ),
    )


@category(
    body=Setting(0.09, 0.13),
    span=Setting(0.42, 0.55, held_out=(0.56, 0.6)),
    chord=Setting(0.2, 0.3),
    sweep=Setting(0.05, 0.22, held_out=(0.0, 0.04)),
    tail=Setting(0.16, 0.24),
)
def airplane(body: float, span: float, chord: float, sweep: float, tail: float) -> Float64:
    """Build an airplane seen from above. Keep it as it is: the default scene shows one."""
    fuselage = ellipsoid(body, 0.5, body)
    wings = [
        slab(
            [
                (0, 0.1),
                (0, 0.1 - chord),
                (s * span, -0.05 - sweep),
                (s * span, 0.05 - sweep),
            ],
            0.05,
        )
        for s in SIDES
    ]
    tails = [
        slab(
            [
                (0, -0.34),
                (0, -0.48),
                (s * tail, -0.5),
                (s * tail, -0.42),
            ],
            0.05,
        )
        for s in SIDES
    ]
    fin = at(box(0.05, 0.14, 0.18), 0, -0.42, -0.1)
    return joined(fuselage, *wings, *tails, fin)


@category(
    beam=Setting(0.14, 0.24),
    sail=Setting(0.6, 0.8, held_out=(0.675, 0.725)),
    lead=Setting(0.25, 0.4, held_out=(0.305, 0.345)),
    lag=Setting(0.12, 0.3),
)
def boat(beam: float, sail: float, lead: float, lag: float) -> Float64:
    """Build a boat from the side: hull, mast and two triangular sails."""
    hull = slab(
        [
            (-0.48, -0.2),
            (0.5, -0.2),
            (0.3, -0.45),
            (-0.32, -0.45),
        ],
        2 * beam,
    )
    mast = at(box(0.06, sail + 0.1, 0.06), 0, sail / 2 - 0.22)
    jib = slab([(0.0, sail - 0.2), (0.0, -0.12), (lead, -0.12)], 0.06)
    return joined(
        hull,
        mast,
        jib,
        slab([(0.0, sail - 0.25), (0.0, -0.12), (-lag, -0.12)], 0.06),
    )


@category(
    height=Setting(0.15, 0.21),
    wheel=Setting(0.1, 0.13),
    width=Setting(0.18, 0.24),
    front=Setting(0.1, 0.26, held_out=(0.155, 0.205)),
    back=Setting(0.25, 0.44, held_out=(0.32, 0.37)),
    cabin=Setting(0.2, 0.26),
)
def car(
    height: float, wheel: float, width: float, front: float, back: float, cabin: float
) -> Float64:
    """Build a car from the side: body, cabin with recessed windows, two wheels."""
    body = slab(
        [
            (-0.5, -0.08),
            (-0.5, 0.04),
            (0.44, 0.04),
            (0.5, -0.02),
            (0.5, -0.08),
        ],
        2 * width,
    )
    sill = at(box(1.0, height - 0.06, 2 * width), 0, -0.08 - (height - 0.06) / 2)
    top = 0.04 + cabin
    lean = 0.12
    glass = slab(
        [
            (-back, 0.04),
            (front, 0.04),
            (front - lean, top),
            (lean / 2 - back, top),
        ],
        1.2 * width,
    )
    roof = bar(
        (
            lean / 2 - back - 0.01,
            top - 0.02,
        ),
        (front - lean + 0.01, top - 0.02),
        0.05,
        1.8 * width,
    )
    middle = (front - back) / 2
    pillars = [
        bar(foot, (head, top - 0.02), 0.045, 1.8 * width)
        for foot, head in (
            ((-back, 0.04), lean / 2 - back),
            ((middle, 0.04), middle),
            ((front, 0.04), front - lean),
        )
    ]
    bottom = -0.02 - height
    wheels = [
        at(
            disc(wheel, 0.12),
            x,
            bottom,
            -width - 0.02,
        )
        for x in (-0.29, 0.29)
    ]
    hubs = [
        at(
            disc(wheel * 0.45, 0.06),
            x,
            bottom,
            -width - 0.09,
        )
        for x in (-0.29, 0.29)
    ]
    return joined(body, sill, glass, roof, *pillars, *wheels, *hubs)


@category(
    wheel=Setting(0.15, 0.19, held_out=(0.165, 0.176)),
    tyre=Setting(0.035, 0.055),
    base=Setting(0.27, 0.32),
    rake=Setting(0.06, 0.16, held_out=(0.095, 0.125)),
    bars=Setting(0.16, 0.26),
    tank=Setting(0.12, 0.17),
)
def motorcycle(
    wheel: float, tyre: float, base: float, rake: float, bars: float, tank: float
) -> Float64:
    """Build a motorcycle from the side: two open wheels, slanted fork, tank, seat, engine and
    exhaust.
    """
    axle = -0.22
    head = base - rake
    wheels = [
        at(
            joined(ring(wheel, tyre), disc(0.05, 0.14)),
            s * base,
            axle,
        )
        for s in SIDES
    ]
    guards = [
        at(
            arch(wheel + 0.05, 0.03, 150),
            s * base,
            axle,
        )
        * (1, 1, 2)
        for s in SIDES
    ]
    fork = [
        at(
            bar((base, axle), (head, 0.16), 0.05, 0.05),
            z=z,
        )
        for z in (-0.09, 0.09)
    ]
    handle = at(
        joined(
            box(0.05, 0.05, 2 * bars),
            bar((0, 0), (-0.12, 0.04), 0.04, 0.3),
        ),
        head,
        0.18,
    )
    lamp = at(knob(0.06, 0.08), head + 0.06, 0.1)
    frame = [
        bar((-base, axle), (0.02, -0.16), 0.05, 0.16),
        bar((-0.1, -0.2), (head, 0.08), 0.06, 0.08),
    ]
    engine = joined(
        at(box(0.22, 0.17, 0.2), -0.01, -0.17),
        at(disc(0.07, 0.3), 0.0, -0.17),
    )
    # Concave at its last corner, which `slab` does not cut out: the notch under the tail is filled,
    # some pixels of 64 x 64. It stays, as weights and figures are of the seat as it is drawn.
    seat = slab(
        [
            (-0.4, 0.08),
            (-0.36, 0.0),
            (0.0, -0.02),
            (0.0, 0.05),
            (-0.24, 0.05),
        ],
        0.2,
    )
    exhaust = at(
        bar((0.02, -0.25), (-base - 0.14, -0.2), 0.055, 0.06),
        z=-0.14,
    )
    body = at(ellipsoid(tank, 0.085, 0.12), 0.04, 0.06)
    return joined(*wheels, *guards, *fork, handle, lamp, *frame, engine, seat, exhaust, body)


@category(
    radius=Setting(0.13, 0.19, held_out=(0.152, 0.168)),
    nose=Setting(0.2, 0.35, held_out=(0.255, 0.295)),
    fin=Setting(0.14, 0.22),
)
def rocket(radius: float, nose: float, fin: float) -> Float64:
    """Build a rocket: nose cone, body with a porthole, fins."""
    tip = [(0, 0.5), (radius * 0.6, 0.5 - nose * 0.5), (radius, 0.5 - nose)]
    body = lathe(
        [
            *tip,
            (radius, -0.4),
            (radius * 0.6, -0.5),
            (0, -0.5),
        ]
    )
    root = radius * 0.8
    fins = [
        slab(
            [
                (s * root, -0.1),
                (s * root, -0.42),
                (s * (radius + fin), -0.5),
                (s * (radius + fin), -0.34),
            ],
            0.06,
        )
        for s in SIDES
    ]
    porthole = at(ring(radius * 0.45, 0.03), 0, 0.38 - nose, -radius)
    return joined(body, *fins, porthole, at(box(0.06, 0.3, fin), 0, -0.33, -radius))


CATEGORIES: dict[str, Category] = {
    kind.name: kind
    for kind in (
        *(airplane, baskets, bell, birdhouse, boat, bowl, car, computer, cup),
        *(cupboard, hat, lamp, motorcycle, oven, rocket, soundbox, table, tower),
    )
}
"""By name, in alphabetical order: a seed picks by position."""


def find_category(name: str) -> Category:
    """Return a category by name. Raises UnknownNameError, with the nearest name, where there is
    none.
    """
    if name in CATEGORIES:
        return CATEGORIES[name]
    choices = f"Choose from {', '.join(CATEGORIES)}"
    raise UnknownNameError(
        f"no object category {name!r}.{did_you_mean(name, CATEGORIES)} {choices}"
    )
