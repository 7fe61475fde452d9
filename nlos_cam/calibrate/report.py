"""Report on a measured wall: one HTML file with verdict, ranges, pictures, quantities, device and use."""

import base64
import shlex
from collections.abc import Iterable, Mapping
from html import escape
from string import Template

from nlos_calibration import (
    DISTANCE_RANGE_M,
    FACING_RANGE_DEG,
    GAP_RANGE_M,
    TOLERANCE_DEG,
    TOLERANCE_M,
    MeasuredWall,
    WallRecord,
    board_agreement,
    wall_facts,
    with_degrees,
    with_mm,
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
VERDICTS = {
    "good": "✔ Good: the bench can be used",
    "out of range": "✘ Out of range: the wall is measured, but the bench has to be moved",
    "doubtful": "? Doubtful: the wall may be elsewhere than measured",
}
"""Words and a sign beside the color, for readers who cannot tell the colors apart."""
NO_MAPS = Picture("Maps of the wall", "This record names no reference of the bare wall: there are no maps to draw.")


def report_html(wall: MeasuredWall, record_file: str) -> str:
    """Return the report on a wall whose record is called `record_file`: HTML that needs no other file, no network."""
    record = wall.record
    maps = [NO_MAPS] if wall.reference is None else wall_maps(record, wall.reference)
    subtitle = f"{record.created}, {record.camera}, {record.frames} frames of the bare wall"
    parts = [
        banner(record),
        ranges(record),
        _figure(bench_picture(record)),
        measures(record),
        board(record),
        _figure(footprint_picture(record)),
        *map(_figure, maps),
        device(wall),
        usage(record, record_file),
    ]
    return page(f"The bench as measured: {record_file}", subtitle, parts)


def page(title: str, subtitle: str, parts: Iterable[str]) -> str:
    """Return a self-contained document; title and subtitle are text, the parts HTML."""
    return PAGE.substitute(title=escape(title), under=escape(subtitle), style=STYLE, body="\n".join(parts))


def _figure(picture: Picture) -> str:
    title, caption = escape(picture.title), escape(picture.caption)
    if picture.png is None:
        return f"<section><h2>{title}</h2><p>{caption}</p></section>"
    data = base64.b64encode(picture.png).decode("ascii")
    image = f"<img alt='{title}' src='data:image/png;base64,{data}'>"
    return f"<figure><h2>{title}</h2>{image}<figcaption>{caption}</figcaption></figure>"


def _table(rows: Iterable[tuple[str, ...]], head: tuple[str, ...]) -> str:
    """Return rows of text as a table; the first cell names the row."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    return f"<table class='numbers'><thead><tr>{top}</tr></thead><tbody>{''.join(map(_row, rows))}</tbody></table>"


def _pairs(facts: Mapping[str, str]) -> str:
    return f"<table><tbody>{''.join(map(_row, facts.items()))}</tbody></table>"


def _row(cells: tuple[str, ...]) -> str:
    name, *others = map(escape, cells)
    return f"<tr><th>{name}</th>{''.join(f'<td>{cell}</td>' for cell in others)}</tr>"


def _bullets(name: str, items: Iterable[str], css_class: str = "") -> str:
    """Return a list of sentences under a heading; empty where there are none."""
    entries = "".join(f"<li>{escape(item)}</li>" for item in items)
    return f"<section class='{css_class}'><h3>{escape(name)}</h3><ul>{entries}</ul></section>" if entries else ""


def range_bar(name: str, value: float, allowed: tuple[float, float], tolerance: float, unit: str, end: float) -> str:
    """Return a bar from 0 to `end` with the allowed range and a marker at the value, or at the bar's nearer end."""
    low, high = allowed
    inside = low - tolerance <= value <= high + tolerance
    left, right, at = (BAR_MARGIN + BAR_WIDTH * each / end for each in (low, high, min(max(value, 0.0), end)))
    marker, state = ("inside", "inside") if inside else ("outside", "too small" if value < low else "too large")
    label = escape(f"{name}: {value:.1f} {unit}, {state} ({low:.0f} to {high:.0f} {unit})")
    ends = "".join(
        f"<text x='{x:.0f}' y='46' text-anchor='middle'>{each:.0f} {unit}</text>"
        for x, each in ((left, low), (right, high))
    )
    return (
        f"<p class='bar'><b>{label}</b></p><svg viewBox='0 0 680 52' role='img' aria-label='{label}'>"
        f"<rect x='{BAR_MARGIN:.0f}' y='14' width='{BAR_WIDTH:.0f}' height='14' rx='7' class='rail'/>"
        f"<rect x='{left:.1f}' y='14' width='{right - left:.1f}' height='14' class='allowed'/>{ends}"
        f"<path d='M {at:.1f} 28 l -9 -24 h 18 z' class='{marker}'/></svg>"
    )


def banner(record: WallRecord) -> str:
    """Return verdict, advice and warnings."""
    name = record.verdict.replace(" ", "-")
    text = f"<p class='word'>{VERDICTS[record.verdict]}</p><p>{escape(record.advice)}</p>"
    return f"<section class='verdict {name}'>{text}</section>{_bullets('Note', record.warnings, 'warnings')}"


def ranges(record: WallRecord) -> str:
    """Return bars that show this bench within the paper's ranges."""
    bars = [
        _bar_in_cm("distance", record.distance_m, DISTANCE_RANGE_M, 45.0),
        range_bar("facing angle", record.facing_deg, FACING_RANGE_DEG, TOLERANCE_DEG, "degrees", 90.0),
    ]
    if record.occluder is not None:
        bars.append(_bar_in_cm("occluder's gap", record.occluder.gap_m, GAP_RANGE_M, 30.0))
    return f"<section><h2>Where the bench is in the paper's ranges</h2>{''.join(bars)}</section>"


def _bar_in_cm(name: str, value_m: float, allowed_m: tuple[float, float], end_cm: float) -> str:
    low_cm, high_cm = (100.0 * end for end in allowed_m)
    return range_bar(name, 100.0 * value_m, (low_cm, high_cm), 100.0 * TOLERANCE_M, "cm", end_cm)


def measures(record: WallRecord) -> str:
    """Return the measured quantities with the half width of each 95 % interval."""
    hint = "" if record.range_offset_std_m is not None else "<p>Range offset not measured: give --tape-m.</p>"
    rows = _table(wall_facts(record), ("", "measured (± 95 %)", "meaning"))
    return f"<section><h2>What was measured</h2>{rows}{hint}</section>"


def board(record: WallRecord) -> str:
    """Return the measurement by the printed board beside the record's; empty without a board."""
    found = record.board
    if found is None:
        return ""
    rows = [
        (
            "distance",
            with_mm(found.distance_m, found.distance_std_m),
            with_mm(record.distance_m, record.distance_std_m),
        ),
        *(
            (name, *(with_degrees(getattr(by, f"{key}_deg"), getattr(by, f"{key}_std_deg")) for by in (found, record)))
            for name, key in (("facing angle", "facing"), ("yaw", "yaw"), ("pitch", "pitch"))
        ),
    ]
    used = {"both": "depth and board together", "depth": "the depth alone", "board": "the board alone"}[found.used]
    printed = f"{found.printed.squares_x} x {found.printed.squares_y} squares of {found.printed.square_mm:.2f} mm"
    facts = (
        f"{board_agreement(found)} The record's plane is of {used}. {found.corners} corners of {printed} "
        f"({'measured on the print' if found.measured else 'as drawn, not measured on the print'}), "
        f"{found.residual_px:.2f} pixels RMS off; stretched by {100.0 * found.stretch:+z.2f} %, "
        f"bowed by {1e3 * found.bow_m:+z.2f} mm."
    )
    compared = _table(rows, ("", "by the board (± 95 %)", "in the record"))
    causes = _bullets("Possible causes", found.causes)
    return f"<section><h2>By a printed board</h2>{compared}<p>{escape(facts)}</p>{causes}</section>"


def device(wall: MeasuredWall) -> str:
    """Return the camera, its settings and temperatures."""
    record, reference = wall.record, wall.reference
    pinhole = record.rig.pinhole
    span = reference.celsius_span if reference is not None else {}
    facts = {
        "camera": record.camera,
        "serial": record.serial or "not known",
        "firmware": record.firmware or "not known",
        "depth image": f"{pinhole.width} x {pinhole.height} pixels",
    }
    celsius = {
        name: f"{value:.1f} °C" + (f", changed by {span[name]:.1f}" if name in span else "")
        for name, value in record.temperatures_c.items()
    }
    settings = {name: f"{value:g}" for name, value in record.settings.items()}
    parts = [("Device", facts), ("Temperatures", celsius), ("Settings", settings)]
    tables = "".join(f"<div><h3>{name}</h3>{_pairs(values)}</div>" for name, values in parts if values)
    return f"<section><h2>What it was measured with</h2><div class='columns'>{tables}</div></section>"


def usage(record: WallRecord, record_file: str) -> str:
    """Return the files that belong together, and the commands that use them."""
    facts = {"record": record_file, "rig's checksum": record.rig.checksum}
    if record.reference:
        facts |= {"bare wall's reference": record.reference, "its SHA-256": record.reference_sha256}
    name, kind = shlex.quote(record_file), record.camera.split(":", maxsplit=1)[0]
    camera = {"sim": "sim", "bag": "l515"}.get(kind, shlex.quote(record.camera))
    commands = f"nlos-cam live --camera {camera} --wall {name}\nnlos-cam render cup --rig {name}"
    use = "Keep the files together. The first command shows the hidden object live; the second renders for this bench."
    return f"<section><h2>Files and use</h2>{_pairs(facts)}<p>{use}</p><pre>{escape(commands)}</pre></section>"
