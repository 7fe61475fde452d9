"""Report on a measured wall: one HTML file with verdict, ranges, pictures, quantities, device and
use.
"""

import shlex
from collections.abc import Mapping
from html import escape

import nlos_calibration as walls

from nlos_cam.calibrate.report_drawings import bench_picture, footprint_picture
from nlos_cam.calibrate.report_maps import wall_maps
from nlos_cam.camera import pictures_command
from nlos_cam.report import Picture, bullets, commands, figure, page, pairs, table

BAR_WIDTH = 640.0
BAR_MARGIN = 20.0
VERDICTS = {
    "good": "✔ Good: the bench can be used",
    "out of range": "✘ Out of range: the wall is measured, but the bench has to be moved",
    "doubtful": "? Doubtful: the wall may be elsewhere than measured",
}
"""Words and a sign beside the color, for readers who cannot tell the colors apart."""
NO_MAPS = Picture(
    "Maps of the wall",
    "This record names no reference of the bare wall: there are no maps to draw.",
)


def report_html(wall: walls.MeasuredWall, record_file: str) -> str:
    """Return the report on a wall whose record is called `record_file`: HTML that needs no other
    file, no network.
    """
    record = wall.record
    maps = [NO_MAPS] if wall.reference is None else wall_maps(record, wall.reference)
    subtitle = f"{record.created}, {record.camera}, {record.frames} frames of the bare wall"
    if wall.reference and record.occluder and record.occluder.source == "detected":
        subtitle += f", {wall.reference.frames} with the occluder"
    parts = [
        banner(record),
        ranges(record),
        figure(bench_picture(record)),
        measures(record),
        board(record),
        figure(footprint_picture(record)),
        *map(figure, maps),
        device(wall),
        usage(record, record_file),
    ]
    return page(f"The bench as measured: {record_file}", subtitle, parts)


def range_bar(
    name: str, value: float, allowed: tuple[float, float], tolerance: float, unit: str, end: float
) -> str:
    """Return a bar from 0 to `end` with the allowed range and a marker at the value, or at the
    bar's nearer end.
    """
    low, high = allowed
    inside = low - tolerance <= value <= high + tolerance
    shown = min(max(value, 0.0), end)
    left, right, at = (BAR_MARGIN + BAR_WIDTH * each / end for each in (low, high, shown))
    marker = "inside" if inside else "outside"
    state = marker
    if not inside:
        state = "too small" if value < low else "too large"
    label = escape(f"{name}: {value:.1f} {unit}, {state} ({low:.0f} to {high:.0f} {unit})")
    ends = "".join(
        f"<text x='{x:.0f}' y='46' text-anchor='middle'>{each:.0f} {unit}</text>"
        for x, each in ((left, low), (right, high))
    )
    return (
        f"<p class='bar'><b>{label}</b></p><svg viewBox='0 0 680 52' role='img'"
        f" aria-label='{label}'><rect x='{BAR_MARGIN:.0f}' y='14' width='{BAR_WIDTH:.0f}'"
        f" height='14' rx='7' class='rail'/><rect x='{left:.1f}' y='14' width='{right - left:.1f}'"
        f" height='14' class='allowed'/>{ends}<path d='M {at:.1f} 28 l -9 -24 h 18 z'"
        f" class='{marker}'/></svg>"
    )


def banner(record: walls.WallRecord) -> str:
    """Return verdict, advice and warnings."""
    name = record.verdict.replace(" ", "-")
    text = f"<p class='word'>{VERDICTS[record.verdict]}</p><p>{escape(record.advice)}</p>"
    return (
        "<section class='verdict"
        f" {name}'>{text}</section>{bullets('Note', record.warnings, 'warnings')}"
    )


def ranges(record: walls.WallRecord) -> str:
    """Return bars that show this bench within the paper's ranges."""
    bars = [
        _bar_in_cm("distance", record.distance_m, walls.DISTANCE_RANGE_M, 45.0),
        range_bar(
            "facing angle",
            record.facing_deg,
            walls.FACING_RANGE_DEG,
            walls.TOLERANCE_DEG,
            "degrees",
            90.0,
        ),
    ]
    if record.occluder is not None:
        bars.append(_bar_in_cm("occluder's gap", record.occluder.gap_m, walls.GAP_RANGE_M, 30.0))
    return f"<section><h2>Where the bench is in the paper's ranges</h2>{''.join(bars)}</section>"


def _bar_in_cm(name: str, value_m: float, allowed_m: tuple[float, float], end_cm: float) -> str:
    low_cm, high_cm = (100.0 * end for end in allowed_m)
    return range_bar(
        name, 100.0 * value_m, (low_cm, high_cm), 100.0 * walls.TOLERANCE_M, "cm", end_cm
    )


def measures(record: walls.WallRecord) -> str:
    """Return the measured quantities with the half width of each 95 % interval."""
    hint = ""
    if record.range_offset_std_m is None:
        hint = "<p>Range offset not measured: give --tape-m, or --board and --square-mm.</p>"
    rows = table(walls.wall_facts(record), ("", "measured (± 95 %)", "meaning"))
    return f"<section><h2>What was measured</h2>{rows}{hint}</section>"


def board(record: walls.WallRecord) -> str:
    """Return the measurement by the printed board beside the record's; empty without a board."""
    found = record.board
    if found is None:
        return ""
    rows = list(zip(QUANTITIES, _quantities(found), _quantities(record), strict=True))
    used = {
        "both": "depth and board together",
        "depth": "the depth alone",
        "board": "the board alone",
    }[found.used]
    size = "measured on the print" if found.measured else "as drawn, not measured on the print"
    printed = (
        f"{found.printed.squares_x} x {found.printed.squares_y} squares of"
        f" {found.printed.square_mm:.2f} mm"
    )
    facts = (
        f"{walls.board_agreement(found, record.range_offset_m)} The record's plane is of {used}."
        f" {found.corners} corners of {printed} ({size}),"
        f" {found.residual_px:.2f} pixels RMS off; stretched by {100.0 * found.stretch:+z.2f} %,"
        f" bowed by {1e3 * found.bow_m:+z.2f} mm."
    )
    compared = table(rows, ("", "by the board (± 95 %)", "in the record"))
    causes = bullets("Possible causes", found.causes)
    return f"<section><h2>By a printed board</h2>{compared}<p>{escape(facts)}</p>{causes}</section>"


QUANTITIES = ("distance", "facing angle", "yaw", "pitch")


def _quantities(by: walls.BoardRecord | walls.WallRecord) -> tuple[str, ...]:
    """Return QUANTITIES with their intervals."""
    return (
        walls.with_mm(by.distance_m, by.distance_std_m),
        walls.with_degrees(by.facing_deg, by.facing_std_deg),
        walls.with_degrees(by.yaw_deg, by.yaw_std_deg),
        walls.with_degrees(by.pitch_deg, by.pitch_std_deg),
    )


NOT_KNOWN = (
    "Not known: which way up the camera is. A bench is symmetric about the lidar's height, so that"
    " no image shows it, and pictures of a camera upside down are too, with every check content."
    " Look: is the thread of its screw down? To record the answer, measure again with --upright."
)
TURNED = (
    "Pictures turn with the camera: their top is the side that is up in the camera's own image. On"
    " the wall, x still points from the lidar's foot to the object's side, and y to that top."
)


def way_up(record: walls.WallRecord) -> str:
    """Return in words which way up the camera is, and how that is known."""
    if record.way_up == "unknown" and record.gravity_m_s2 is None:
        return NOT_KNOWN
    if record.way_up == "unknown":
        return "The camera looks steeply up or down, so that no side of its pictures is up."
    if record.gravity_m_s2 is None:
        text = f"The camera is {record.way_up}, as its owner said: gravity was not measured."
    else:
        roll = walls.roll_deg(record.gravity_m_s2)
        text = (
            f"The camera is {record.way_up}: by gravity it is rolled by {roll:+z.1f}° about its"
            " optical axis. live and replay compare with that."
        )
    return text if record.way_up == "upright" else f"{text} {TURNED}"


def device(wall: walls.MeasuredWall) -> str:
    """Return the camera, its settings and temperatures, those of the newer measurement where the
    occluder was found after the wall.
    """
    record = wall.record
    reference = wall.reference
    pinhole = record.rig.pinhole
    settings_then = record.settings
    celsius_then = record.temperatures_c
    span: Mapping[str, float] = {}
    if reference is not None:
        settings_then = reference.settings or settings_then
        celsius_then = reference.celsius or celsius_then
        span = reference.celsius_span
    facts = {
        "camera": record.camera,
        "serial": record.serial or "not known",
        "firmware": record.firmware or "not known",
        "depth image": f"{pinhole.width} x {pinhole.height} pixels",
    }
    celsius = {name: f"{value:.1f} °C" for name, value in celsius_then.items()}
    for name in celsius.keys() & span.keys():
        celsius[name] += f", changed by {span[name]:.1f}"
    settings = {name: f"{value:g}" for name, value in settings_then.items()}
    parts = [("Device", facts), ("Temperatures", celsius), ("Settings", settings)]
    tables = "".join(
        f"<div><h3>{name}</h3>{pairs(values)}</div>" for name, values in parts if values
    )
    return (
        "<section><h2>What it was measured with</h2>"
        f"<div class='columns'>{tables}</div><p>{escape(way_up(record))}</p></section>"
    )


def usage(record: walls.WallRecord, record_file: str) -> str:
    """Return the files that belong together, and the commands that use them."""
    facts = {"record": record_file, "rig's checksum": record.beam_rig.checksum}
    if record.reference:
        facts |= {"bare wall's reference": record.reference, "its SHA-256": record.reference_sha256}
    name = shlex.quote(record_file)
    pictures = pictures_command(record, f"--wall {name}")
    lines = commands([pictures, f"nlos-cam render cup --rig {name}"])
    use = (
        "Keep the files together. The first command shows the hidden object; the second renders for"
        " this bench."
    )
    return f"<section><h2>Files and use</h2>{pairs(facts)}<p>{use}</p>{lines}</section>"
