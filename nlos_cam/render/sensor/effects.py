"""Which stages of the sensor's chain a model calls for: pure verdicts, which the sensor reads."""

from math import sqrt

from nlos_cam.frames import SATURATED
from nlos_cam.render.effects import Effect
from nlos_cam.render.sensor.model import DEPTH_UNIT_M, FARTHEST, SensorModel

IR, DEPTH = "relative L1 of the IR", "relative L1 of the depth"


def sensor_effects(model: SensorModel) -> tuple[Effect, ...]:
    """The verdicts in the order of the chain; gain, saturation and quantisation are in every image's format.

    The bound is of the images, on average over the noise, the view and returns of one count or more; the reason names
    its unit.
    """
    return (
        _texture(model),
        Effect("gain", included=True, reason=f"the bare wall reads {model.bare_wall_counts:g} counts; {IR}", bound=1.0),
        _ambient(model),
        _shot(model),
        _read(model),
        Effect("saturation", included=True, reason=f"8 bits end at {SATURATED} counts; {IR}", bound=1.0),
        _offset(model),
        _ripples(model),
        _patches(model),
        _drift(model),
        _range(model),
        Effect(
            "quantisation", included=True, reason="0.25 mm, 8 bits, 4 bits; metres of depth", bound=DEPTH_UNIT_M / 2
        ),
        _dead(model),
    )


def _verdict(name: str, needed: bool, why: str, bound: float) -> Effect:
    return Effect(name, needed, why, bound) if needed else Effect(name, needed, "the model has none", 0.0)


def _texture(model: SensorModel) -> Effect:
    """Of a factor of mean 1, normal by its logarithm, E|factor - 1| = 2 erf(strength / sqrt(8)) < strength."""
    strength = model.wall_texture
    why = f"the wall's reflectance varies by {100 * strength:g} %; {IR}"
    return _verdict("wall texture", strength > 0, why, strength)


def _ambient(model: SensorModel) -> Effect:
    """Noise grows by at most shot_noise sqrt(ambient); a saturated return loses the ambient's share of full scale."""
    ambient = model.ambient_counts
    why = f"{ambient:g} counts of steady light; {IR}"
    return _verdict("ambient light", ambient > 0, why, model.shot_noise * sqrt(ambient) + ambient / SATURATED)


def _shot(model: SensorModel) -> Effect:
    """The standard deviation over the signal falls with the signal: largest at one count."""
    why = f"{model.shot_noise:g} x the root of the counts; {IR}"
    return _verdict("shot noise", model.shot_noise > 0, why, model.shot_noise * sqrt(1 + model.ambient_counts))


def _read(model: SensorModel) -> Effect:
    noise = model.read_noise_counts
    return _verdict("read noise", noise > 0, f"{noise:g} counts; {IR}", noise)


def _offset(model: SensorModel) -> Effect:
    offset_m = model.range_offset_m
    why = f"every depth lacks {1000 * offset_m:g} mm; metres of depth"
    return _verdict("range offset", offset_m != 0, why, abs(offset_m))


def _ripples(model: SensorModel) -> Effect:
    why = f"a wave of {1000 * model.ripple_m:g} mm across the view; metres of depth"
    return _verdict("ripples", model.ripple_m > 0, why, model.ripple_m)


def _patches(model: SensorModel) -> Effect:
    """The mean of what a pattern adds is at most its standard deviation; it is largest in the warm device."""
    why = f"patches of {1000 * model.patch_drift_m:g} mm in the warm device; metres of depth"
    return _verdict("patchy drift", model.patch_drift_m > 0, why, model.patch_drift_m)


def _drift(model: SensorModel) -> Effect:
    """Largest where the warm-up begins; without one, no instant differs from another."""
    warm, per_celsius_m = model.warm_up, model.drift_m_per_celsius
    warmed = warm.to_celsius - warm.from_celsius if warm else 0.0
    why = f"{1000 * per_celsius_m:g} mm a degree over {warmed:g} degrees; metres of depth"
    bound = abs(per_celsius_m) * warmed
    if per_celsius_m and not bound:
        return Effect("drift", included=False, reason="the temperature is steady", bound=0.0)
    return _verdict("drift", bound > 0, why, bound)


def _range(model: SensorModel) -> Effect:
    """The standard deviation grows with depth: largest at the end of Z16."""
    fixed, per_m = model.range_noise_m, model.range_noise_per_m
    why = f"{1000 * fixed:g} mm and {1000 * per_m:g} mm a metre; metres of depth"
    return _verdict("range noise", fixed > 0 or per_m > 0, why, fixed + per_m * FARTHEST * DEPTH_UNIT_M)


def _dead(model: SensorModel) -> Effect:
    why = f"{100 * model.dead_share:g} % of the pixels give no depth; {DEPTH}"
    return _verdict("dead pixels", model.dead_share > 0, why, model.dead_share)
