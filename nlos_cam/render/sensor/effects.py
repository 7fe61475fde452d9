"""Verdicts on the stages of the sensor's chain, which the sensor follows."""

from math import sqrt

from nlos_cam.frames import SATURATED
from nlos_cam.render.effects import Effect
from nlos_cam.render.sensor.model import DEPTH_UNIT_M, FARTHEST, SensorModel

IR = "relative L1 of the IR"
DEPTH = "relative L1 of the depth"


def sensor_effects(model: SensorModel) -> tuple[Effect, ...]:
    """Return the verdicts in the order of the chain; gain, saturation and quantization are always
    included.

    Bounds are of the images' change, on average over the noise, the view and returns of one count
    or more; each reason names the unit.
    """
    m = model
    ambient = model.ambient_counts
    return (
        # A factor of mean 1 with normal logarithm has E|factor - 1| = 2 erf(strength / sqrt(8)) <
        # strength.
        _verdict(
            "wall texture",
            f"the wall's reflectance varies by {100 * m.wall_texture:g} %; {IR}",
            m.wall_texture,
        ),
        Effect(
            "gain",
            included=True,
            reason=f"the bare wall reads {m.bare_wall_counts:g} counts; {IR}",
            bound=1.0,
        ),
        # Noise grows by at most shot_noise sqrt(ambient); a saturated return loses the ambient's
        # share of full scale.
        _verdict(
            "ambient light",
            f"{ambient:g} counts of steady light; {IR}",
            m.shot_noise * sqrt(ambient) + ambient / SATURATED,
        ),
        # The standard deviation over the signal falls with the signal: largest at one count.
        _verdict(
            "shot noise",
            f"{m.shot_noise:g} x the root of the counts; {IR}",
            m.shot_noise * sqrt(1 + ambient),
        ),
        _verdict("read noise", f"{m.read_noise_counts:g} counts; {IR}", m.read_noise_counts),
        Effect(
            "saturation", included=True, reason=f"8 bits end at {SATURATED} counts; {IR}", bound=1.0
        ),
        _metres(
            "range offset",
            f"every depth is {1000 * m.range_offset_m:g} mm too short",
            abs(m.range_offset_m),
        ),
        _metres("ripples", f"a wave of {1000 * m.ripple_m:g} mm across the view", m.ripple_m),
        # The mean absolute value of a pattern is at most its standard deviation; it is largest in
        # the warm device.
        _metres(
            "patchy drift",
            f"patches of {1000 * m.patch_drift_m:g} mm in the warm device",
            m.patch_drift_m,
        ),
        _drift(model),
        # The standard deviation grows with depth: largest at the end of Z16.
        _metres(
            "range noise",
            f"{1000 * m.range_noise_m:g} mm and {1000 * m.range_noise_per_m:g} mm a metre",
            m.range_noise_m + m.range_noise_per_m * FARTHEST * DEPTH_UNIT_M,
        ),
        _metres("quantisation", "0.25 mm, 8 bits, 4 bits", DEPTH_UNIT_M / 2),
        _verdict(
            "dead pixels",
            f"{100 * m.dead_share:g} % of the pixels give no depth; {DEPTH}",
            m.dead_share,
        ),
    )


def _verdict(name: str, why: str, bound: float) -> Effect:
    return Effect(name, included=True, reason=why, bound=bound) if bound > 0 else _left_out(name)


def _metres(name: str, why: str, bound: float) -> Effect:
    return _verdict(name, f"{why}; metres of depth", bound)


def _left_out(name: str, why: str = "the model has none") -> Effect:
    return Effect(name, included=False, reason=why, bound=0.0)


def _drift(model: SensorModel) -> Effect:
    """Return the verdict on drift: largest at the start of the warm-up, and none at a steady
    temperature.
    """
    warm = model.warm_up
    per_celsius_m = model.drift_m_per_celsius
    warmed = warm.to_celsius - warm.from_celsius if warm else 0.0
    if per_celsius_m and not warmed:
        return _left_out("drift", "the temperature is steady")
    why = f"{1000 * per_celsius_m:g} mm a degree over {warmed:g} degrees"
    return _metres("drift", why, abs(per_celsius_m) * warmed)
