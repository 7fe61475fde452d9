"""How far a reconstruction may be believed, by a small network that sees the maps and what was made of them."""

from dataclasses import dataclass

from nlos_cam.frames import Float32


@dataclass(frozen=True)
class Doubt:
    """What is known of a reconstruction beside itself."""

    nothing: float
    """Probability that nothing is hidden."""
    outside: float
    """Probability that what is hidden is unlike anything that the networks were trained on."""
    error_m: Float32
    """(64, 64): expected absolute error of the hidden depth, were there a surface; finite everywhere."""
