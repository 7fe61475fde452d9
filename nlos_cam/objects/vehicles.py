"""Generators of what drives, sails and flies: airplane, boat, car, motorcycle, rocket."""

from nlos_cam.objects.settings import Setting, category
from nlos_cam.objects.solids import Triangles, arch, at, bar, box, disc, ellipsoid, joined, knob, lathe, ring, slab

SIDES = (-1, 1)


@category(
    body=Setting(0.09, 0.13),
    span=Setting(0.42, 0.55, held_out=(0.56, 0.6)),
    chord=Setting(0.2, 0.3),
    sweep=Setting(0.05, 0.22, held_out=(0.0, 0.04)),
    tail=Setting(0.16, 0.24),
)
def airplane(body: float, span: float, chord: float, sweep: float, tail: float) -> Triangles:
    """Seen from above: fuselage, swept wings, tailplane, fin. Frozen: the default scene's picture is one of them."""
    fuselage = ellipsoid(body, 0.5, body)
    wings = [
        slab([(0, 0.1), (0, 0.1 - chord), (s * span, -0.05 - sweep), (s * span, 0.05 - sweep)], 0.05) for s in SIDES
    ]
    tails = [slab([(0, -0.34), (0, -0.48), (s * tail, -0.5), (s * tail, -0.42)], 0.05) for s in SIDES]
    fin = at(box(0.05, 0.14, 0.18), 0, -0.42, -0.1)
    return joined(fuselage, *wings, *tails, fin)


@category(
    beam=Setting(0.14, 0.24),
    sail=Setting(0.6, 0.8, held_out=(0.675, 0.725)),
    lead=Setting(0.25, 0.4, held_out=(0.305, 0.345)),
    lag=Setting(0.12, 0.3),
)
def boat(beam: float, sail: float, lead: float, lag: float) -> Triangles:
    """From the side: hull, mast and two triangular sails."""
    hull = slab([(-0.48, -0.2), (0.5, -0.2), (0.3, -0.45), (-0.32, -0.45)], 2 * beam)
    mast = at(box(0.06, sail + 0.1, 0.06), 0, sail / 2 - 0.22)
    jib = slab([(0.0, sail - 0.2), (0.0, -0.12), (lead, -0.12)], 0.06)
    return joined(hull, mast, jib, slab([(0.0, sail - 0.25), (0.0, -0.12), (-lag, -0.12)], 0.06))


@category(
    height=Setting(0.15, 0.21),
    wheel=Setting(0.1, 0.13),
    width=Setting(0.18, 0.24),
    front=Setting(0.1, 0.26, held_out=(0.155, 0.205)),
    back=Setting(0.25, 0.44, held_out=(0.32, 0.37)),
    cabin=Setting(0.2, 0.26),
)
def car(height: float, wheel: float, width: float, front: float, back: float, cabin: float) -> Triangles:
    """From the side: body, a cabin with windows set in, two wheels."""
    body = slab([(-0.5, -0.08), (-0.5, 0.04), (0.44, 0.04), (0.5, -0.02), (0.5, -0.08)], 2 * width)
    sill = at(box(1.0, height - 0.06, 2 * width), 0, -0.08 - (height - 0.06) / 2)
    top, lean = 0.04 + cabin, 0.12
    glass = slab([(-back, 0.04), (front, 0.04), (front - lean, top), (lean / 2 - back, top)], 1.2 * width)
    roof = bar((lean / 2 - back - 0.01, top - 0.02), (front - lean + 0.01, top - 0.02), 0.05, 1.8 * width)
    middle = (front - back) / 2
    pillars = [
        bar(foot, (head, top - 0.02), 0.045, 1.8 * width)
        for foot, head in (((-back, 0.04), lean / 2 - back), ((middle, 0.04), middle), ((front, 0.04), front - lean))
    ]
    bottom = -0.02 - height
    wheels = [at(disc(wheel, 0.12), x, bottom, -width - 0.02) for x in (-0.29, 0.29)]
    hubs = [at(disc(wheel * 0.45, 0.06), x, bottom, -width - 0.09) for x in (-0.29, 0.29)]
    return joined(body, sill, glass, roof, *pillars, *wheels, *hubs)


@category(
    wheel=Setting(0.15, 0.19, held_out=(0.165, 0.176)),
    tyre=Setting(0.035, 0.055),
    base=Setting(0.27, 0.32),
    rake=Setting(0.06, 0.16, held_out=(0.095, 0.125)),
    bars=Setting(0.16, 0.26),
    tank=Setting(0.12, 0.17),
)
def motorcycle(wheel: float, tyre: float, base: float, rake: float, bars: float, tank: float) -> Triangles:
    """From the side: two open wheels, a slanted fork up to the handlebar, tank, seat, engine and exhaust."""
    axle, head = -0.22, base - rake
    wheels = [at(joined(ring(wheel, tyre), disc(0.05, 0.14)), s * base, axle) for s in SIDES]
    guards = [at(arch(wheel + 0.05, 0.03, 150), s * base, axle) * (1, 1, 2) for s in SIDES]
    fork = [at(bar((base, axle), (head, 0.16), 0.05, 0.05), z=z) for z in (-0.09, 0.09)]
    handle = at(joined(box(0.05, 0.05, 2 * bars), bar((0, 0), (-0.12, 0.04), 0.04, 0.3)), head, 0.18)
    lamp = at(knob(0.06, 0.08), head + 0.06, 0.1)
    frame = [bar((-base, axle), (0.02, -0.16), 0.05, 0.16), bar((-0.1, -0.2), (head, 0.08), 0.06, 0.08)]
    engine = joined(at(box(0.22, 0.17, 0.2), -0.01, -0.17), at(disc(0.07, 0.3), 0.0, -0.17))
    seat = slab([(-0.4, 0.08), (-0.36, 0.0), (0.0, -0.02), (0.0, 0.05), (-0.24, 0.05)], 0.2)
    exhaust = at(bar((0.02, -0.25), (-base - 0.14, -0.2), 0.055, 0.06), z=-0.14)
    body = at(ellipsoid(tank, 0.085, 0.12), 0.04, 0.06)
    return joined(*wheels, *guards, *fork, handle, lamp, *frame, engine, seat, exhaust, body)


@category(
    radius=Setting(0.13, 0.19, held_out=(0.152, 0.168)),
    nose=Setting(0.2, 0.35, held_out=(0.255, 0.295)),
    fin=Setting(0.14, 0.22),
)
def rocket(radius: float, nose: float, fin: float) -> Triangles:
    """Nose cone, body with a porthole, and fins."""
    tip = [(0, 0.5), (radius * 0.6, 0.5 - nose * 0.5), (radius, 0.5 - nose)]
    body = lathe([*tip, (radius, -0.4), (radius * 0.6, -0.5), (0, -0.5)])
    root = radius * 0.8
    fins = [
        slab([(s * root, -0.1), (s * root, -0.42), (s * (radius + fin), -0.5), (s * (radius + fin), -0.34)], 0.06)
        for s in SIDES
    ]
    porthole = at(ring(radius * 0.45, 0.03), 0, 0.38 - nose, -radius)
    return joined(body, *fins, porthole, at(box(0.06, 0.3, fin), 0, -0.33, -radius))
