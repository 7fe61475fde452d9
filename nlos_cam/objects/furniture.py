"""Generators of what stands in a room: computer, cupboard, oven, soundbox, table."""

from nlos_cam.objects.settings import Setting, category
from nlos_cam.objects.solids import (
    Triangles,
    at,
    box,
    disc,
    frame,
    joined,
    knob,
    lathe,
    pierced,
    ring,
    tipped,
    turned,
)

SIDES = (-1, 1)


@category(
    width=Setting(0.8, 1.0, held_out=(0.875, 0.93)),
    height=Setting(0.5, 0.64, held_out=(0.55, 0.595)),
    neck=Setting(0.14, 0.22),
    reach=Setting(0.34, 0.46),
    tip=Setting(14, 30),
)
def computer(width: float, height: float, neck: float, reach: float, tip: float) -> Triangles:
    """A screen set into its frame, on neck and foot, with the keyboard before it."""
    foot = -height / 2 - neck
    screen = joined(frame(width, height, 0.07, 0.18), at(box(width - 0.1, height - 0.1, 0.04), z=0.06))
    stand = joined(at(box(0.16, neck, 0.08), y=foot + neck / 2), at(box(0.4, 0.04, 0.26), y=foot))
    keys = [at(box(width * 0.74, 0.06, 0.05), y=0.03, z=z) for z in (-0.09, 0.0, 0.09)]
    keyboard = turned(joined(box(width * 0.8, 0.05, 0.3), *keys), (1, 0, 0), -15)
    return tipped(joined(screen, stand, at(keyboard, y=foot + 0.02, z=-reach)), tip)


@category(
    width=Setting(0.56, 0.76, held_out=(0.635, 0.69)),
    depth=Setting(0.24, 0.34),
    shelves=Setting(2, 5),
    ajar=Setting(60, 115, held_out=(80, 95)),
    tip=Setting(-5, 15),
)
def cupboard(width: float, depth: float, shelves: float, ajar: float, tip: float) -> Triangles:
    """Two doors on short legs: one is shut, with its knob; the other stands open and shows the shelves."""
    leaf, rows = width / 2 - 0.02, int(shelves)
    case = joined(frame(width, 0.9, 0.05, depth), at(box(width, 0.9, 0.03), z=depth / 2))
    boards = [at(box(width - 0.04, 0.04, depth * 0.85), y=0.9 * (k / rows - 0.5), z=0.03) for k in range(1, rows)]
    middle = box(0.04, 0.9, depth)
    door = joined(at(box(leaf, 0.88, 0.04), leaf / 2), at(knob(0.035, 0.05), leaf * 0.85, z=-0.05))
    shut = at(door * (-1, 1, 1), width / 2, z=-depth / 2 - 0.02)
    wide = at(turned(door, (0, 1, 0), ajar), -width / 2, z=-depth / 2 - 0.02)
    cornice = at(box(width + 0.08, 0.06, depth + 0.06), y=0.47)
    legs = [at(box(0.08, 0.1, 0.08), s * (width / 2 - 0.05), -0.5, z * depth / 3) for s in SIDES for z in SIDES]
    return tipped(joined(case, *boards, middle, shut, wide, cornice, *legs), tip)


@category(
    width=Setting(0.62, 0.78, held_out=(0.68, 0.725)),
    depth=Setting(0.42, 0.56),
    window=Setting(0.26, 0.4, held_out=(0.31, 0.355)),
    knobs=Setting(3, 6),
    tip=Setting(18, 36),
)
def oven(width: float, depth: float, window: float, knobs: float, tip: float) -> Triangles:
    """A cooker seen a little from above: hob with rings, knobs, a handle, and the door's window set in."""
    front, count = -depth / 2, int(knobs)
    door = at(frame(width, 0.6, (0.6 - window) / 2, 0.14), y=-0.2, z=front + 0.07)
    body = joined(at(box(width, 0.6, depth - 0.14), y=-0.2, z=0.07), at(box(width, 0.26, depth), y=0.23))
    dials = [at(disc(0.05, 0.1), width * ((k + 0.5) / count - 0.5), 0.23, front - 0.05) for k in range(count)]
    handle = at(box(width * 0.7, 0.05, 0.05), 0, 0.03, front - 0.08)
    rings = [
        at(lathe([(0.05, 0), (0.05, 0.06), (0.12, 0.06), (0.12, 0)]), s * width / 4, 0.36, z * depth / 4)
        for s in SIDES
        for z in SIDES
    ]
    return tipped(joined(door, body, *dials, handle, *rings), tip)


@category(
    width=Setting(0.46, 0.62, held_out=(0.52, 0.565)),
    depth=Setting(0.3, 0.42),
    woofer=Setting(0.35, 0.45, held_out=(0.39, 0.415)),
    tweeter=Setting(0.2, 0.28),
)
def soundbox(width: float, depth: float, woofer: float, tweeter: float) -> Triangles:
    """A loudspeaker: a tall box, a large cone below and a small one above, each with its rim and its cap."""
    low, high = _speaker(width, 0.6, woofer * width), _speaker(width, 0.4, tweeter * width)
    fronts = joined(at(low, y=-0.2), at(high, y=0.3))
    return joined(at(fronts, z=-depth / 2), at(box(width, 1.0, depth - 0.28), z=0.14))


def _speaker(width: float, height: float, radius: float) -> Triangles:
    """A front plate facing the wall at z = 0, with a cone of some radius sunk into it."""
    cone = turned(lathe([(radius, 0.0), (radius * 0.4, -0.25), (0, -0.25)]), (1, 0, 0), -90)
    cap = at(knob(radius * 0.4, 0.1), z=0.25)
    return joined(at(pierced(width, height, radius, 0.28), z=0.14), ring(radius, 0.03), cone, cap)


@category(
    width=Setting(0.85, 1.0),
    depth=Setting(0.4, 0.6, held_out=(0.475, 0.53)),
    leg=Setting(0.08, 0.12),
    height=Setting(0.45, 0.7, held_out=(0.54, 0.61)),
    tip=Setting(15, 40),
)
def table(width: float, depth: float, leg: float, height: float, tip: float) -> Triangles:
    """A table seen a little from above: top and four legs."""
    legs = [
        at(box(leg, height, leg), s * (width - leg) / 2, -height / 2, z * (depth - leg) / 2)
        for s in SIDES
        for z in SIDES
    ]
    return tipped(joined(box(width, 0.09, depth), *legs), tip)
