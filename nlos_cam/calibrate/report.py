"""The report beside a wall's record: one HTML file that says whether the bench is right, and what to move if not.

The pieces of HTML that the report on a measured wall is made of: the page, tables, lists, a bar with a marker.

The words of the report on a measured wall as HTML: verdict, ranges, measures, board, device, files, use.
"""

import base64
import shlex
from collections.abc import Iterable, Mapping
from html import escape
from string import Template

from nlos_calibration import (
    DISTANCE_RANGE_M,
    FACING_RANGE_DEG,
    GAP_RANGE_M,
    INTERVAL_STDS,
    TOLERANCE_DEG,
    TOLERANCE_M,
    BoardRecord,
    MeasuredWall,
    WallRecord,
)

from nlos_cam.calibrate.report_drawings import bench_picture, footprint_picture
from nlos_cam.calibrate.report_maps import Picture, wall_maps

BAR_WIDTH, BAR_MARGIN = 640.0, 20.0
STYLE = """
:root { color-scheme: light dark; --ink: #1c1c1c; --paper: #fff; --faint: #d8d8d8; --good: #1a7f5a; --bad: #b3360b;
  --doubt: #8a6100; --allowed: #7fc8a9; --link: #08519c; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8e8; --paper: #16181b; --faint: #3a3f45;
  --allowed: #2d7a5c; --link: #9ecae1; } }
* { box-sizing: border-box; print-color-adjust: exact; -webkit-print-color-adjust: exact; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 980px; margin: 0 auto; padding: 1.5rem 1rem 4rem;
  color: var(--ink); background: var(--paper); }
h1 { font-size: 1.6rem; margin: 0; } h2 { font-size: 1.2rem; margin: 2rem 0 .5rem; }
h3 { font-size: 1rem; margin: .5rem 0; }
.under { margin: 0 0 1rem; opacity: .8; }
.verdict { color: #fff; border-radius: .6rem; padding: .8rem 1.2rem; font-size: 1.15rem; }
.verdict p { margin: 0; overflow-wrap: anywhere; } .verdict .word { font-size: 1.9rem; font-weight: 700; }
.good { background: var(--good); } .out-of-range { background: var(--bad); } .doubtful { background: var(--doubt); }
.warnings { border-left: .4rem solid var(--doubt); padding: .1rem 1rem; margin: 1rem 0; }
.bar { margin: .6rem 0 0; } svg { width: 100%; max-width: 680px; display: block; font-size: 14px; }
svg text { fill: var(--ink); } .rail { fill: var(--faint); } .allowed { fill: var(--allowed); }
.inside { fill: var(--ink); } .outside { fill: #e0480f; stroke: var(--ink); }
table { border-collapse: collapse; } th, td { text-align: left; vertical-align: top; padding: .15rem 1rem .15rem 0;
  border-bottom: 1px solid var(--faint); overflow-wrap: anywhere; } tbody th { font-weight: 600; min-width: 8rem; }
.numbers td:nth-child(2) { white-space: nowrap; }
.columns { display: flex; flex-wrap: wrap; gap: 0 2.5rem; }
figure { margin: 1.5rem 0; break-inside: avoid; } figcaption { margin-top: .4rem; }
img { max-width: 100%; height: auto; background: #fff; border-radius: .4rem; display: block; }
pre { border: 1px solid var(--faint); border-radius: .4rem; padding: .6rem 1rem; overflow-x: auto; }
section, tr { break-inside: avoid; } @media print { body { max-width: none; font-size: 11pt; padding: 0; } }
"""
PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title><style>$style</style></head>
<body><header><h1>$title</h1><p class="under">$under</p></header>
<main>$body</main></body>
</html>
""")


def page(title: str, under: str, parts: Iterable[str]) -> str:
    """A whole document, which needs nothing but itself; title and what is under it are text, the parts HTML."""
    return PAGE.substitute(title=escape(title), under=escape(under), style=STYLE, body="\n".join(parts))


def pictured(picture: Picture) -> str:
    """A picture with its title and caption; the caption alone where there is nothing to draw."""
    title, caption = escape(picture.title), escape(picture.caption)
    if picture.png is None:
        return f"<section><h2>{title}</h2><p>{caption}</p></section>"
    data = base64.b64encode(picture.png).decode("ascii")
    image = f"<img alt='{title}' src='data:image/png;base64,{data}'>"
    return f"<figure><h2>{title}</h2>{image}<figcaption>{caption}</figcaption></figure>"


def table(rows: Iterable[tuple[str, ...]], head: tuple[str, ...]) -> str:
    """Rows of text, of which the first cell names the row."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    return f"<table class='numbers'><thead><tr>{top}</tr></thead><tbody>{''.join(map(_row, rows))}</tbody></table>"


def pairs(facts: Mapping[str, str]) -> str:
    """Names and values."""
    return f"<table><tbody>{''.join(map(_row, facts.items()))}</tbody></table>"


def _row(cells: tuple[str, ...]) -> str:
    name, *others = map(escape, cells)
    return f"<tr><th>{name}</th>{''.join(f'<td>{cell}</td>' for cell in others)}</tr>"


def bullets(name: str, items: Iterable[str], of_class: str = "") -> str:
    """A list of sentences under a name; empty where there are none."""
    told = "".join(f"<li>{escape(item)}</li>" for item in items)
    return f"<section class='{of_class}'><h3>{escape(name)}</h3><ul>{told}</ul></section>" if told else ""


def range_bar(name: str, value: float, allowed: tuple[float, float], tolerance: float, unit: str, most: float) -> str:
    """A range as a bar, with a marker where the value is; beyond the scale the marker stands at its end."""
    low, high = allowed
    inside = low - tolerance <= value <= high + tolerance
    left, right, at = (_place(each, most) for each in (low, high, min(max(value, 0.0), most)))
    colour, state = ("inside", "inside") if inside else ("outside", "too small" if value < low else "too large")
    told = f"{name}: {value:.1f} {unit}, {state} ({low:.0f} to {high:.0f} {unit})"
    ends = "".join(
        f"<text x='{x:.0f}' y='46' text-anchor='middle'>{each:.0f} {unit}</text>"
        for x, each in ((left, low), (right, high))
    )
    return (
        f"<p class='bar'><b>{escape(told)}</b></p><svg viewBox='0 0 680 52' role='img' aria-label='{escape(told)}'>"
        f"<rect x='{BAR_MARGIN:.0f}' y='14' width='{BAR_WIDTH:.0f}' height='14' rx='7' class='rail'/>"
        f"<rect x='{left:.1f}' y='14' width='{right - left:.1f}' height='14' class='allowed'/>{ends}"
        f"<path d='M {at:.1f} 28 l -9 -24 h 18 z' class='{colour}'/></svg>"
    )


def _place(value: float, most: float) -> float:
    return BAR_MARGIN + BAR_WIDTH * value / most


VERDICTS = {
    "good": "✔ Good: the bench can be used",
    "out of range": "✘ Out of range: the wall is measured, but the bench has to be moved",
    "doubtful": "? Doubtful: the wall may be elsewhere than measured",
}
"""Words and a sign beside the colour, for those who do not see it."""
MIN_REPORTED = 0.001
Row = tuple[str, str, str]
"""What, how much, what that means."""


def verdict(record: WallRecord) -> str:
    """The banner: the verdict, the advice, and the warnings."""
    name = record.verdict.replace(" ", "-")
    banner = f"<p class='word'>{VERDICTS[record.verdict]}</p><p>{escape(record.advice)}</p>"
    return f"<section class='verdict {name}'>{banner}</section>{bullets('Note', record.warnings, 'warnings')}"


def ranges(record: WallRecord) -> str:
    """Where this bench lies in the paper's ranges, as bars."""
    bars = [
        _bar_in_cm("distance", record.distance_m, DISTANCE_RANGE_M, 45.0),
        range_bar("facing angle", record.facing_deg, FACING_RANGE_DEG, TOLERANCE_DEG, "degrees", 90.0),
    ]
    if record.occluder is not None:
        bars.append(_bar_in_cm("occluder's gap", record.occluder.gap_m, GAP_RANGE_M, 30.0))
    return f"<section><h2>Where the bench is in the paper's ranges</h2>{''.join(bars)}</section>"


def _bar_in_cm(name: str, value_m: float, allowed_m: tuple[float, float], most_cm: float) -> str:
    low_cm, high_cm = (100.0 * end for end in allowed_m)
    return range_bar(name, 100.0 * value_m, (low_cm, high_cm), 100.0 * TOLERANCE_M, "cm", most_cm)


def measures(record: WallRecord) -> str:
    """What was measured, with the half width of each 95 % interval."""
    rows = [*_pose_rows(record), *_offset_rows(record), *_occluder_rows(record), *_quality_rows(record)]
    if record.footprint_share is not None:
        rows.append(("view on the wall", f"{record.footprint_share:.1%}", "share of the map's 64 x 80 cells"))
    return f"<section><h2>What was measured</h2>{table(rows, ('', 'measured (± 95 %)', 'meaning'))}</section>"


def _pose_rows(record: WallRecord) -> list[Row]:
    yaw, pitch = _degrees(record.yaw_deg, record.yaw_std_deg), _degrees(record.pitch_deg, record.pitch_std_deg)
    return [
        ("distance", _metres(record.distance_m, record.distance_std_m), "from the lidar to the wall, along its normal"),
        ("facing angle", _degrees(record.facing_deg, record.facing_std_deg), "between optical axis and wall's normal"),
        ("yaw", yaw, "to the side; positive turns the axis towards the object (+x)"),
        ("pitch", pitch, "positive looks up"),
    ]


def _offset_rows(record: WallRecord) -> list[Row]:
    if record.range_offset_std_m is None:
        return [("range offset", "not measured", "give the distance by tape with --tape-m")]
    amount = f"{1e3 * record.range_offset_m:+z.2f} mm{_plus_minus(record.range_offset_std_m, 'mm', 1e3)}"
    causes = {"origin": "the beams' origin lies so far before the glass", "depth": "each depth lacks it"}
    meaning = causes.get(record.range_offset_cause or "", "to be added to the lidar's depth")
    return [("range offset", amount, f"{meaning}; it is in the distance")]


def _occluder_rows(record: WallRecord) -> list[Row]:
    if record.occluder is None:
        return []
    found = record.occluder
    edge, gap = _metres(found.x_m, found.x_std_m), _metres(found.gap_m, found.gap_std_m)
    rows = [
        (f"occluder's edge ({found.source})", edge, "along the wall from the lidar's foot"),
        (f"occluder's gap ({found.source})", gap, "between its edge and the wall"),
    ]
    leans = "against the wall's normal; positive leans away from the lidar's foot"
    return rows if found.tilt_deg is None else [*rows, ("occluder's tilt", f"{found.tilt_deg:+z.2f}°", leans)]


def _quality_rows(record: WallRecord) -> list[Row]:
    if record.residual_m is None:
        return [("depth", "refused", "the plane is the board's alone: the depth says nothing about the wall")]
    measured: list[tuple[str, float | None, str, float, str]] = [
        ("residual", record.residual_m, "{:.2f} mm RMS", 1e3, "distance of the pixels used from the plane"),
        ("on the plane", record.inlier_fraction, "{:.1f} %", 100.0, "of the pixels with depth; the rest is left out"),
        ("noise", record.noise_scale, "{:.2f} times nominal", 1.0, "of one depth sample; 1 is as it should be"),
        ("ripples", record.ripple_m, "{:.2f} mm RMS", 1e3, "of parts of the wall off the plane, beyond noise"),
        ("bend", record.bend_m, "{:.2f} mm", 1e3, "between planes through half of the view and through all of it"),
        ("bend", record.bend_deg, "{:.2f} degrees", 1.0, "the same as an angle"),
    ]
    return [(name, form.format(scale * at), what) for name, at, form, scale, what in measured if at is not None]


def board(record: WallRecord) -> str:
    """What the printed board said, beside what the record says; empty where none was asked for."""
    found = record.board
    if found is None:
        return ""
    both = [
        ("distance", (found.distance_m, found.distance_std_m), (record.distance_m, record.distance_std_m)),
        ("facing angle", (found.facing_deg, found.facing_std_deg), (record.facing_deg, record.facing_std_deg)),
        ("yaw", (found.yaw_deg, found.yaw_std_deg), (record.yaw_deg, record.yaw_std_deg)),
        ("pitch", (found.pitch_deg, found.pitch_std_deg), (record.pitch_deg, record.pitch_std_deg)),
    ]

    def told(name: str, value: float, std: float | None) -> str:
        return _metres(value, std) if name == "distance" else _degrees(value, std)

    rows = [(name, told(name, *by), told(name, *ours)) for name, by, ours in both]
    used = {"both": "depth and board together", "depth": "the depth alone", "board": "the board alone"}[found.used]
    compared = table(rows, ("", "by the board (± 95 %)", "in the record"))
    print_of = f"{found.printed.squares_x} x {found.printed.squares_y} squares of {found.printed.square_mm:.2f} mm"
    facts = (
        f"{_disagreement(found)} The record's plane is of {used}. {found.corners} corners of {print_of} "
        f"({'measured on the print' if found.measured else 'as drawn, not measured on the print'}), "
        f"{found.residual_px:.2f} pixels RMS off; stretched by {100.0 * found.stretch:+z.2f} %, "
        f"bowed by {1e3 * found.bow_m:+z.2f} mm."
    )
    causes = bullets("What may lie behind it", found.causes)
    return f"<section><h2>By a printed board</h2>{compared}<p>{escape(facts)}</p>{causes}</section>"


def _disagreement(found: BoardRecord) -> str:
    if found.disagreement_m is None or found.disagreement_deg is None or found.disagreement_sigmas is None:
        return f"The depth was refused: {found.depth_refused}."
    return (
        f"The board's plane is {1e3 * found.disagreement_m:+z.2f} mm and {found.disagreement_deg:.3f}° from the "
        f"depth's: {found.disagreement_sigmas:.1f} standard deviations."
    )


def device(wall: MeasuredWall) -> str:
    """The camera, its settings and temperatures."""
    record, reference = wall.record, wall.reference
    pinhole = record.rig.pinhole
    span = reference.celsius_span if reference is not None else {}
    facts = {
        "date": f"{record.created}",
        "camera": record.camera,
        "serial": record.serial or "not known",
        "firmware": record.firmware or "not known",
        "frames averaged": f"{record.frames}",
        "depth image": f"{pinhole.width} x {pinhole.height} pixels",
    }
    celsius = {
        name: f"{value:.1f} °C" + (f", changed by {span[name]:.1f}" if name in span else "")
        for name, value in record.temperatures_c.items()
    }
    settings = {name: f"{value:g}" for name, value in record.settings.items()}
    parts = [("Device", facts), ("Temperatures", celsius), ("Settings", settings)]
    tables = "".join(f"<div><h3>{name}</h3>{pairs(what)}</div>" for name, what in parts if what)
    return f"<section><h2>What it was measured with</h2><div class='columns'>{tables}</div></section>"


def files(record: WallRecord, record_file: str) -> str:
    """Which files belong together, and how they are used."""
    facts = {"record": record_file, "rig's checksum": record.rig.checksum}
    if record.reference:
        facts |= {"bare wall's reference": record.reference, "its SHA-256": record.reference_sha256}
    name, kind = shlex.quote(record_file), record.camera.split(":", maxsplit=1)[0]
    camera = {"sim": "sim", "bag": "l515"}.get(kind, shlex.quote(record.camera))
    commands = f"nlos-cam live --camera {camera} --wall {name}\nnlos-cam render cup --rig {name}"
    use = "Keep the files together. The first command shows what is hidden, live; the second renders for this bench."
    return f"<section><h2>Files and use</h2>{pairs(facts)}<p>{use}</p><pre>{escape(commands)}</pre></section>"


def _plus_minus(std: float | None, unit: str, scale: float = 1.0) -> str:
    """The half width of the 95 % interval; nothing where it is not known."""
    if std is None:
        return ""
    half = INTERVAL_STDS * scale * std
    return (f" ± {half:.2g} {unit}" if half >= MIN_REPORTED else f" ± less than {MIN_REPORTED} {unit}").replace(
        " °", "°"
    )


def _metres(value_m: float, std_m: float | None) -> str:
    return f"{value_m:.4f} m{_plus_minus(std_m, 'mm', 1e3)}"


def _degrees(value_deg: float, std_deg: float | None) -> str:
    return f"{value_deg:z.2f}°{_plus_minus(std_deg, '°')}"


NO_MAPS = Picture("Maps of the wall", "This record names no reference of the bare wall: there are no maps to draw.")


def report(wall: MeasuredWall, record_file: str) -> str:
    """The report on a wall whose record is called `record_file`, as HTML that needs no other file and no network."""
    record = wall.record
    maps = [NO_MAPS] if wall.reference is None else wall_maps(record, wall.reference)
    under = f"{record.created}, {record.camera}, {record.frames} frames of the bare wall"
    parts = [
        verdict(record),
        ranges(record),
        pictured(bench_picture(record)),
        measures(record),
        board(record),
        pictured(footprint_picture(record)),
        *map(pictured, maps),
        device(wall),
        files(record, record_file),
    ]
    return page(f"The bench as measured: {record_file}", under, parts)
