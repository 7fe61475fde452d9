"""Summary of a wall record for readers: quantities with 95 % intervals, as rows.

The report, the live view and the terminal all show these rows.
"""

from nlos_calibration.board_wall import BoardRecord
from nlos_calibration.gravity import roll_deg
from nlos_calibration.noise import with_degrees, with_mm
from nlos_calibration.wall_record import WallRecord

Row = tuple[str, str, str]
"""Quantity, value with its unit, meaning."""


def wall_facts(record: WallRecord) -> list[Row]:
    """Return the measured quantities of a record; those that were not measured are left out."""
    rows = [
        (
            "distance",
            with_mm(record.distance_m, record.distance_std_m),
            "from the lidar to the wall, along its normal",
        ),
        (
            "facing angle",
            with_degrees(record.facing_deg, record.facing_std_deg),
            "between optical axis and wall's normal",
        ),
        (
            "yaw",
            with_degrees(record.yaw_deg, record.yaw_std_deg, "+"),
            "positive turns the axis towards the object (+x)",
        ),
        ("pitch", with_degrees(record.pitch_deg, record.pitch_std_deg, "+"), "positive points up"),
    ]
    if record.range_offset_std_m is not None:
        causes = {
            "origin": "the beams start this far in front of the glass",
            "depth": "each depth is short by this",
        }
        meaning = causes.get(record.range_offset_cause or "", "added to the lidar's depth")
        offset = with_mm(record.range_offset_m, record.range_offset_std_m, "+")
        rows.append(("range offset", offset, f"{meaning}; included in the distance"))
    if found := record.occluder:
        edge = with_mm(found.x_m, found.x_std_m)
        gap = with_mm(found.gap_m, found.gap_std_m)
        rows.append(
            (f"occluder's edge ({found.source})", edge, "along the wall from the lidar's foot")
        )
        rows.append((f"occluder's gap ({found.source})", gap, "between its edge and the wall"))
        if found.tilt_deg is not None:
            leaning = "against the wall's normal; positive leans away from the lidar's foot"
            rows.append(("occluder's tilt", with_degrees(found.tilt_deg, None, "+"), leaning))
    if board := record.board:
        plane = (
            with_mm(board.distance_m, board.distance_std_m),
            with_degrees(board.facing_deg, board.facing_std_deg),
        )
        compared = board_agreement(board, record.range_offset_m)
        meaning = f"{board.corners} corners; used: {board.used}. {compared}"
        rows.append(("printed board", ", ".join(plane), meaning))
    rows += _depth_rows(record)
    view = f"{100.0 * record.footprint_share:.1f} %"
    rows.append(("view on the wall", view, "of the map's 64 x 80 cells"))
    rows.append(("measured on", f"{record.created}", f"{record.frames} frames averaged"))
    rows.append(_way_up_row(record))
    if celsius := record.temperatures_c.values():
        span = dict.fromkeys(f"{value:.1f}" for value in (min(celsius), max(celsius)))
        rows.append(("temperature", f"{' to '.join(span)} °C", "of the camera"))
    return rows


def _way_up_row(record: WallRecord) -> Row:
    if record.gravity_m_s2 is not None:
        roll = roll_deg(record.gravity_m_s2)
        return "camera", record.way_up, f"by gravity: rolled by {roll:+z.1f}° about its axis"
    if record.way_up == "unknown":
        return "camera", "upright?", "not known: gravity was not measured, and nobody was asked"
    return "camera", record.way_up, "as its owner said: gravity was not measured"


def board_agreement(board: BoardRecord, range_offset_m: float = 0.0) -> str:
    """Return how far the plane of a printed board is from the plane of the depth, before the range
    offset of the record was added to that.
    """
    offset = ""
    if range_offset_m:
        offset = f" With the range offset, {1e3 * range_offset_m:+.1f} mm, the two agree."
    if (
        board.disagreement_m is None
        or board.disagreement_deg is None
        or board.disagreement_sigmas is None
    ):
        return f"The depth was refused: {board.depth_refused}.{offset}"
    return (
        f"The board's plane is {1e3 * board.disagreement_m:+z.2f} mm and"
        f" {board.disagreement_deg:.3f}° from the depth's: {board.disagreement_sigmas:.1f} standard"
        f" deviations.{offset}"
    )


def _depth_rows(record: WallRecord) -> list[Row]:
    if record.residual_m is None:
        return [("depth", "refused", "the plane is the board's alone")]
    measured: list[tuple[str, float | None, str, float, str]] = [
        (
            "residual",
            record.residual_m,
            "{:.2f} mm RMS",
            1e3,
            "distance of the pixels used from the plane",
        ),
        (
            "on the plane",
            record.inlier_fraction,
            "{:.1f} %",
            100.0,
            "of the pixels with depth; the rest is left out",
        ),
        ("noise", record.noise_scale, "{:.2f} times nominal", 1.0, "of one depth sample"),
        (
            "ripples",
            record.ripple_m,
            "{:.2f} mm RMS",
            1e3,
            "of parts of the wall off the plane, beyond noise",
        ),
        (
            "bend",
            record.bend_m,
            "{:.2f} mm",
            1e3,
            "between planes through half of the view and through all of it",
        ),
        ("bend", record.bend_deg, "{:.2f}°", 1.0, "the same as an angle"),
    ]
    return [
        (name, form.format(scale * at), what)
        for name, at, form, scale, what in measured
        if at is not None
    ]
