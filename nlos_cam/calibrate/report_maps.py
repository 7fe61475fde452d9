"""Maps of the bare wall for the report: residual and its distribution, depth noise, infrared and
saturation.
"""

from math import ceil, floor, log10
from typing import TYPE_CHECKING, Any

import numpy as np
from nlos_calibration import (
    FULL_SCALE,
    BareWall,
    MeanNoise,
    WallRecord,
    depth_noise_m,
    wall_points_m,
)
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.report import Picture, figure_of, png

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colorbar import Colorbar

DRAWN_COLUMNS = 320
"""Maps are averaged in blocks to at most this width, which shows the wall's shape better than noisy
pixels.
"""


def residual_m(record: WallRecord, reference: BareWall) -> Float64:
    """Return each pixel's distance behind the record's plane, along its normal (height, width); NaN
    without return.

    The record's range offset is applied, by its cause (`nlos_calibration.range_offset`).
    """
    return -wall_points_m(record, reference)[..., 2]


def expected_std_m(record: WallRecord, reference: BareWall) -> Float64:
    """Return the standard deviation of a residual in metres due to the lidar's noise alone (height,
    width).

    A pixel at depth d lies at lidar + d * ray; its height above the plane changes with d by n .
    ray, n the normal.
    """
    scale = 1.0 if record.noise_scale is None else record.noise_scale
    noise = MeanNoise(np.array([float(reference.frames)]), scale)
    along = reference.intrinsics.rays() @ np.array(record.wall_from_lidar)[2, :3]
    return noise.of(reference.depth_m.astype(np.float64)) * np.abs(along)


def block_side(columns: int) -> int:
    """Return the side of a block in pixels for a map of this width."""
    return ceil(columns / DRAWN_COLUMNS)


def in_blocks(values: NDArray[np.floating], side: int) -> Float64:
    """Return means over blocks of side x side pixels without NaN; NaN for a block of NaN only."""
    known = np.isfinite(values)
    count = _sums(known.astype(np.float64), side)
    total = _sums(np.where(known, values, 0.0), side)
    nothing = np.full(count.shape, np.nan)
    return np.divide(total, count, out=nothing, where=count > 0.0)


def block_majority(mask: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    """Return a mask of the blocks with at least half of their pixels in the mask."""
    return in_blocks(mask.astype(np.float64), side) >= 0.5


def _sums(values: NDArray[np.floating], side: int) -> Float64:
    rows, columns = (ceil(length / side) * side for length in values.shape)
    padded = np.zeros((rows, columns))
    padded[: values.shape[0], : values.shape[1]] = values
    return padded.reshape(rows // side, side, columns // side, side).sum(axis=(1, 3))


STRAY = (0.72, 0.72, 0.72, 1.0)
STRIPE = (0.35, 0.35, 0.35, 1.0)
NO_RETURN = (0.9, 0.9, 0.9, 1.0)
STRIPE_BLOCKS = 4
LEVELS = 21
"""Number of colors: noise in more of them makes files large. Odd, so that the middle one is
white.
"""
MIN_RESIDUAL_MM = 0.5
"""Smallest end of the scale, so that the noise of a good wall stays pale."""
ROUND = 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0
SPREAD_POINTS = 500
"""Number of pixels whose expected distributions are averaged."""


def wall_maps(record: WallRecord, reference: BareWall) -> list[Picture]:
    """Return the pictures of the reference: residual, its distribution, noise, infrared."""
    return [
        _residuals(record, reference),
        _spread(record, reference),
        _noise(reference),
        _infrared(reference),
    ]


def _residuals(record: WallRecord, reference: BareWall) -> Picture:
    title = "Is the wall flat, and is the plane on it?"
    off_mm = 1e3 * residual_m(record, reference)
    known = np.isfinite(off_mm)
    if not known.any():
        return Picture(
            title, "No pixel has depth in half of the frames: there is no residual to draw."
        )
    stray = known & ~reference.inliers
    drawn = np.where(stray, np.nan, off_mm)
    side = block_side(drawn.shape[1])
    limit_mm = max(_limit(np.abs(in_blocks(drawn, side))), MIN_RESIDUAL_MM)
    figure = figure_of(8.6, 5.4)
    axis = figure.add_subplot()
    label = "mm behind the plane (negative: in front)"
    _map(axis, drawn, label, extend="both", cmap="RdBu_r", vmin=-limit_mm, vmax=limit_mm)
    _shade(axis, stray, ~known)
    axis.set_title("distance of the mean depth from the plane, normal to the wall", fontsize=10)
    shares = (
        f"Left out of the plane (striped): {_percent(stray)} of the pixels; without return:"
        f" {_percent(~known)}."
    )
    how = (
        "Even, pale speckle is noise on a flat wall. Broad red or blue areas are a bent wall or"
        " ripples of the lidar; a patch with a sharp edge is an object in front of the wall. Each"
        f" dot is the mean of {side} x {side} pixels. "
    )
    if record.residual_m is None:
        shares += (
            " The depth was refused and the plane is the board's: the map shows their difference."
        )
    return Picture(title, how + shares, png(figure))


def _spread(record: WallRecord, reference: BareWall) -> Picture:
    title = "Do the residuals look like noise alone?"
    used = reference.inliers & np.isfinite(reference.depth_m)
    off_mm = 1e3 * residual_m(record, reference)[used]
    sigma_mm = 1e3 * expected_std_m(record, reference)[used]
    if len(off_mm) < 2:
        return Picture(title, "No pixel is on the plane: there are no residuals to count.")
    rms_mm, expected_mm = (float(np.sqrt(np.mean(values**2))) for values in (off_mm, sigma_mm))
    reach_mm = 4.0 * max(rms_mm, expected_mm)
    # a Gaussian for each of some pixels, averaged: noise grows with distance, so their mixture is
    # not a Gaussian
    some_mm = sigma_mm[:: max(len(sigma_mm) // SPREAD_POINTS, 1), np.newaxis]
    at_mm = np.linspace(-reach_mm, reach_mm, 241)
    normal = np.exp(-0.5 * (at_mm / some_mm) ** 2) / (np.sqrt(2.0 * np.pi) * some_mm)
    figure = figure_of(8.6, 3.4)
    axis = figure.add_subplot()
    ends_mm = -reach_mm, reach_mm
    axis.hist(off_mm, bins=80, range=ends_mm, density=True, color="#9ecae1", label="measured")
    axis.plot(at_mm, normal.mean(axis=0), color="#b2182b", label="expected from the lidar's noise")
    axis.axvline(0.0, color="0.4", linewidth=0.8)
    axis.set(xlabel="mm behind the plane", ylabel="share of pixels per mm", xlim=ends_mm)
    axis.legend(frameon=False)
    caption = (
        f"The pixels that the plane rests on are {rms_mm:.3f} mm RMS off it; noise, averaged over"
        f" {reference.frames} frames, would leave {expected_mm:.3f} mm. Bars much wider than the"
        " line, or beside it, are not noise: ripples of the lidar, a wall that is not flat, or"
        " another plane."
    )
    return Picture(title, caption, png(figure))


def _noise(reference: BareWall) -> Picture:
    title = "Is the lidar as quiet as it should be?"
    std_m = reference.depth_std_m.astype(np.float64)
    if not np.isfinite(std_m).any():
        return Picture(title, "No pixel has two depth samples: the noise is unknown.")
    ratio = std_m / depth_noise_m(reference.depth_m.astype(np.float64))
    figure = figure_of(11.0, 3.9)
    left, right = figure.subplots(1, 2)
    _map(left, 1e3 * std_m, "mm", extend="max", cmap="viridis", vmin=0.0, vmax=_limit(1e3 * std_m))
    _shade(left, np.zeros_like(reference.inliers), ~np.isfinite(std_m))
    left.set_title("noise of one depth sample (standard deviation)", fontsize=10)
    times = np.log2(np.maximum(ratio, 2.0**-9))
    label = "times the nominal noise"
    bar = _map(right, times, label, extend="both", cmap="PuOr_r", vmin=-2.0, vmax=2.0)
    bar.set_ticks([-2.0, -1.0, 0.0, 1.0, 2.0], labels=["¼", "½", "1", "2", "4"])
    _shade(right, np.zeros_like(reference.inliers), ~np.isfinite(ratio))
    right.set_title("against 0.5 mm + 2 mm per metre, the nominal", fontsize=10)
    caption = (
        "Left: standard deviation of one pixel's depth from frame to frame. Right: white is as"
        " expected, orange is noisier (weak returns, a cold lidar, light from elsewhere)."
    )
    if np.isfinite(ratio).any():
        caption += f" Typical here: {np.nanmedian(ratio):.2f} times the nominal."
    return Picture(title, caption, png(figure))


def _infrared(reference: BareWall) -> Picture:
    title = "Is there too much light anywhere?"
    ir = reference.ir.astype(np.float64)
    share = 100.0 * reference.saturated.astype(np.float64)
    if not np.isfinite(ir).any():
        return Picture(title, "There is no infrared image.")
    saturated = share > 0.0
    high = min(_limit(ir), float(FULL_SCALE))
    gray: dict[str, Any] = {"levels": 3 * LEVELS, "cmap": "gray", "vmin": 0.0, "vmax": high}
    figure = figure_of(11.0, 3.9) if saturated.any() else figure_of(6.2, 4.0)
    axes = figure.subplots(1, 2 if saturated.any() else 1, squeeze=False)[0]
    _map(axes[0], ir, "IR counts of 255", **gray)
    axes[0].set_title("mean infrared image", fontsize=10)
    if not saturated.any():
        caption = (
            f"No pixel is saturated: the brightest is {np.nanmax(ir):.0f} of 255 counts on average."
        )
        return Picture(title, caption, png(figure))

    _map(axes[1], share, "% of the frames", cmap="magma", vmin=0.0, vmax=100.0)
    axes[1].set_title("saturated: at full scale", fontsize=10)
    caption = (
        f"{_percent(saturated)} of the pixels were at full scale in some frame,"
        f" {_percent(share >= 50.0)} in half of them. There the depth is unreliable: lower the"
        " laser power or the gain."
    )
    return Picture(title, caption, png(figure))


def _map(
    axis: "Axes",
    values: Float64,
    label: str,
    *,
    extend: Any = "neither",
    levels: int = LEVELS,
    **style: Any,
) -> "Colorbar":
    """Draw an image of the sensor in blocks, and return its color bar."""
    from matplotlib import colormaps

    height, width = values.shape
    style |= {"cmap": colormaps[style["cmap"]].resampled(levels), "interpolation": "nearest"}
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    image = axis.imshow(in_blocks(values, block_side(width)), extent=extent, **style)
    bar = axis.figure.colorbar(image, ax=axis, label=label, extend=extend)
    axis.set(xlabel="column (pixels), as the lidar sees it", ylabel="row (pixels)")
    return bar


def _shade(axis: "Axes", stray: NDArray[np.bool_], absent: NDArray[np.bool_]) -> None:
    """Stripe pixels left out of the plane, gray pixels without return, and add a legend."""
    from matplotlib.patches import Patch

    height, width = stray.shape
    side = block_side(width)
    stray_blocks = block_majority(stray, side)
    absent_blocks = block_majority(absent, side)
    rows, columns = np.indices(stray_blocks.shape)
    paint = np.zeros((*stray_blocks.shape, 4))
    paint[stray_blocks] = STRAY
    paint[stray_blocks & ((rows + columns) // STRIPE_BLOCKS % 2 == 0)] = STRIPE
    paint[absent_blocks] = NO_RETURN
    axis.imshow(paint, extent=(-0.5, width - 0.5, height - 0.5, -0.5), interpolation="nearest")
    entries: list[Patch] = []
    if stray.any():
        label = "left out of the plane"
        entries.append(Patch(facecolor=STRAY, edgecolor=STRIPE, hatch="///", label=label))
    if absent.any():
        entries.append(Patch(facecolor=NO_RETURN, edgecolor="0.6", label="no return"))
    if entries:
        axis.legend(handles=entries, loc="lower right", fontsize=8, framealpha=0.95)


def _percent(mask: NDArray[np.bool_]) -> str:
    """Return a share as text; a few pixels are not rounded to none."""
    share = 100.0 * float(mask.mean())
    if share == 0.0:
        return "none"
    return "less than 0.1 %" if share < 0.1 else f"{share:.1f} %"


def _limit(values: Float64) -> float:
    """Return the end of a scale that holds 99 % of the values, rounded up; 0.1 without values above
    0.
    """
    known = values[np.isfinite(values)]
    high = float(np.percentile(known, 99.0)) if len(known) else 0.0
    if high <= 0.0:
        return 0.1
    power = 10.0 ** floor(log10(high))
    return next(step * power for step in ROUND if step * power >= high * (1.0 - 1e-9))
