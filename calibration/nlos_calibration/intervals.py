"""95 % intervals and their text: as many digits as the interval justifies, and one unit."""

from math import floor, log10

INTERVAL_STDS = 1.96
"""Half the width of a 95 % interval, in standard uncertainties."""
MAX_DECIMALS_MM, MAX_DECIMALS_DEG = 2, 3
"""Finest digits printed, however small the interval: an interval below one unit of them is printed as one unit."""


def with_mm(value_m: float, std_m: float | None, sign: str = "") -> str:
    """Return a length in metres as millimetres with its 95 % interval: "200.00 ± 0.01 mm"."""
    return f"{_with_interval(1e3 * value_m, None if std_m is None else 1e3 * std_m, MAX_DECIMALS_MM, sign)} mm"


def with_degrees(value_deg: float, std_deg: float | None, sign: str = "") -> str:
    """Return an angle with its 95 % interval: "45.000 ± 0.001°"."""
    return f"{_with_interval(value_deg, std_deg, MAX_DECIMALS_DEG, sign)}°"


def _with_interval(value: float, std: float | None, max_decimals: int, sign: str) -> str:
    """Return a value and the half width of its 95 % interval; without a standard uncertainty the value alone."""
    if std is None:
        return f"{value:{sign}z.{max_decimals - 1}f}"
    half = max(INTERVAL_STDS * std, 10.0**-max_decimals)
    # one significant digit of the half width, two where it begins with 1: none after the point from 2 to 20, one from
    # 0.2 to 2, ...
    decimals = min(max(-floor(log10(half / 2.0)), 0), max_decimals)
    return f"{value:{sign}z.{decimals}f} ± {half:.{decimals}f}"
