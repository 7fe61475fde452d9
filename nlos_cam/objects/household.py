"""Generators of small things of the house: baskets, bell, bowl, cup, hat, lamp."""

from nlos_cam.objects.settings import Setting, category
from nlos_cam.objects.solids import Triangles, arch, at, box, joined, knob, lathe, ring, tipped


@category(
    bottom=Setting(0.26, 0.36),
    height=Setting(0.34, 0.48, held_out=(0.39, 0.43)),
    handle=Setting(0.85, 1.3, held_out=(1.01, 1.14)),
    ribs=Setting(3, 6),
    tip=Setting(10, 30),
)
def baskets(bottom: float, height: float, handle: float, ribs: float, tip: float) -> Triangles:
    """A round basket with woven rows, tipped so that its hollow shows, and a tall handle over it."""
    rows = 2 * int(ribs) + 1
    top, low = 0.44, -height
    weave = [
        (bottom + (top - bottom) * k / rows + (0.035 if k % 2 else 0.0), low + height * k / rows)
        for k in range(rows + 1)
    ]
    hollow = [(top - 0.06, 0.0), (bottom - 0.06, low * 0.8), (0, low * 0.8)]
    shell = lathe([(0, low), *weave, (top + 0.035, -0.02), (top + 0.035, 0.03), *hollow])
    return tipped(joined(shell, arch(top - 0.02, 0.04) * (1, handle, 1.4)), tip)


@category(
    rim=Setting(0.4, 0.52, held_out=(0.44, 0.475)),
    waist=Setting(0.2, 0.28, held_out=(0.23, 0.255)),
)
def bell(rim: float, waist: float) -> Triangles:
    """A bell with a flared rim, a crown and a clapper."""
    crown = [(0, 0.34), (waist * 0.7, 0.32), (waist, 0.2)]
    shell = lathe([*crown, (waist * 1.1, -0.1), (rim * 0.8, -0.28), (rim, -0.4), (0, -0.4)])
    return joined(shell, at(ring(0.1, 0.045), 0, 0.42), at(knob(0.09, 0.09), 0, -0.44))


@category(
    depth=Setting(0.28, 0.42, held_out=(0.33, 0.37)),
    foot=Setting(0.16, 0.24, held_out=(0.19, 0.215)),
    tip=Setting(20, 42),
)
def bowl(depth: float, foot: float, tip: float) -> Triangles:
    """Tipped towards the wall, so that its hollow shows above its side and foot."""
    base = [(0, -depth - 0.06), (foot, -depth - 0.06), (foot, -depth)]
    outer = [*base, (0.38, -depth * 0.5), (0.47, -depth * 0.15), (0.5, 0)]
    inner = [(0.44, 0), (0.33, -depth * 0.5), (0.14, -depth * 0.85), (0, -depth * 0.85)]
    return tipped(lathe(outer + inner), tip)


@category(
    radius=Setting(0.26, 0.34, held_out=(0.29, 0.315)),
    taper=Setting(0.75, 1.0),
    height=Setting(0.6, 0.85, held_out=(0.69, 0.76)),
    handle=Setting(0.24, 0.3),
    tip=Setting(5, 28),
)
def cup(radius: float, taper: float, height: float, handle: float, tip: float) -> Triangles:
    """A mug with its handle to one side."""
    wall = [(0, -height / 2), (radius * taper, -height / 2), (radius, height / 2), (radius - 0.06, height / 2)]
    body = lathe([*wall, (radius * taper - 0.06, 0.08 - height / 2), (0, 0.08 - height / 2)])
    return tipped(joined(body, at(ring(height * handle, 0.055), radius * 0.95)), tip)


@category(
    crown=Setting(0.22, 0.3, held_out=(0.25, 0.275)),
    height=Setting(0.36, 0.54, held_out=(0.43, 0.48)),
    tip=Setting(8, 38),
)
def hat(crown: float, height: float, tip: float) -> Triangles:
    """A brimmed hat with its band, a little tipped."""
    top = [(0, height - 0.03), (crown * 0.6, height), (crown * 0.85, height), (crown, height * 0.85)]
    band = [(crown * 1.06, 0.2), (crown * 1.2, 0.2), (crown * 1.24, 0.06)]
    return tipped(lathe([*top, *band, (0.42, 0.02), (0.5, 0.05), (0.5, 0.0), (0, -0.04)]), tip)


@category(
    top=Setting(0.14, 0.24, held_out=(0.175, 0.205)),
    bottom=Setting(0.3, 0.42),
    shade=Setting(0.3, 0.42, held_out=(0.345, 0.38)),
    foot=Setting(0.2, 0.3),
)
def lamp(top: float, bottom: float, shade: float, foot: float) -> Triangles:
    """A table lamp: foot, stem, shade."""
    hood = lathe([(0, 0.5), (top, 0.5), (bottom, 0.5 - shade), (0, 0.5 - shade)])
    stem = at(box(0.08, 0.6, 0.08), 0, -0.15)
    return joined(hood, stem, lathe([(0, -0.4), (foot, -0.42), (0.3, -0.5), (0, -0.5)]))
