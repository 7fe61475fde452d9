"""Product ids under which the L515's family and other RealSense cameras are met on USB."""

from typing import Literal

INTEL = 0x8086
Kind = Literal["camera", "recovery", "other"]
L515 = 0x0B64
LIDARS: dict[int, tuple[Kind, str]] = {
    L515: ("camera", "L515"),
    0x0B3D: ("camera", "L515 (pre-production)"),
    0x0B0D: ("camera", "L500"),
    0x0B55: ("recovery", "L515 in recovery mode"),
    0x0ADC: ("recovery", "RealSense in recovery mode on USB 2 (an early L515, or a D400)"),
}
"""The L515's family: what each is, and what to call it."""
OTHERS = {
    0x0AA5: "SR300",
    0x0AD1: "D400",
    0x0AD2: "D410",
    0x0AD3: "D415",
    0x0AD4: "D430",
    0x0ADB: "D400 in recovery mode",
    0x0B07: "D435",
    0x0B3A: "D435i",
    0x0B48: "SR305",
    0x0B4B: "D430i",
    0x0B5B: "D405",
    0x0B5C: "D455",
}
"""Other RealSense cameras that are likely to be met, so that they can be named."""
