"""HTML of a report: the page and its parts; no scripts, no other files, no network."""

import base64
import io
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from html import escape
from math import floor, log10
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from nlos_cam.files import program_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 100
WIDE_PIXELS = 900
STYLE = """
:root { color-scheme: light dark; --ink: #1c1c1c; --paper: #fff; --faint: #d8d8d8;
  --good: #1a7f5a; --bad: #b3360b;
  --doubt: #8a6100; --allowed: #7fc8a9; --link: #08519c; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8e8; --paper: #16181b; --faint: #3a3f45;
  --allowed: #2d7a5c; --link: #9ecae1; } }
* { box-sizing: border-box; print-color-adjust: exact; -webkit-print-color-adjust: exact; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 980px; margin: 0 auto;
  padding: 1.5rem 1rem 4rem;
  color: var(--ink); background: var(--paper); }
h1 { font-size: 1.6rem; margin: 0; overflow-wrap: anywhere; } h2 { font-size: 1.2rem;
  margin: 2rem 0 .5rem; }
h3 { font-size: 1rem; margin: .5rem 0; }
.under { margin: 0 0 1rem; opacity: .8; }
.verdict { color: #fff; border-radius: .6rem; padding: .8rem 1.2rem; font-size: 1.15rem; }
.verdict p { margin: 0; overflow-wrap: anywhere; }
.verdict .word { font-size: 1.9rem; font-weight: 700; line-height: 1.2; }
.good { background: var(--good); } .out-of-range { background: var(--bad); }
  .doubtful { background: var(--doubt); }
.warnings { border-left: .4rem solid var(--doubt); padding: .1rem 1rem; margin: 1rem 0; }
.bar { margin: .6rem 0 0; } svg { width: 100%; max-width: 680px; display: block; font-size: 14px; }
svg text { fill: var(--ink); } .rail { fill: var(--faint); } .allowed { fill: var(--allowed); }
.inside { fill: var(--ink); } .outside { fill: #e0480f; stroke: var(--ink); }
table { border-collapse: collapse; margin: .5rem 0; }
th, td { text-align: left; vertical-align: top; padding: .15rem 1rem .15rem 0;
  border-bottom: 1px solid var(--faint); overflow-wrap: anywhere; } tbody th { font-weight: 600;
  min-width: 8rem; }
.numbers td:nth-child(2) { white-space: nowrap; } .wide { overflow-x: auto; }
  .wide img { min-width: 40rem; }
.figures td { white-space: nowrap; font-variant-numeric: tabular-nums; }
.figures th { overflow-wrap: normal; } .figures tbody th { min-width: 11rem; }
.columns { display: flex; flex-wrap: wrap; gap: 0 2.5rem; }
figure { margin: 1.5rem 0; break-inside: avoid; } figcaption { margin-top: .4rem; }
img { max-width: 100%; height: auto; background: #fff; border-radius: .4rem; display: block; }
pre { border: 1px solid var(--faint); border-radius: .4rem; padding: .6rem 1rem; overflow-x: auto; }
section, tr { break-inside: avoid; } @media print { body { max-width: none; font-size: 11pt;
  padding: 0; } }
"""
PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title><style>$style</style></head>
<body><header><h1>$title</h1><p class="under">$under</p></header>
<main>$body</main><footer class="under">$program</footer></body>
</html>
""")


@dataclass(frozen=True)
class Picture:
    """Picture of a report; `png` is None where there is nothing to draw, and the caption says
    why.
    """

    title: str
    caption: str
    png: bytes | None = None
    file: str = ""
    """Name of the file beside the report that holds the same picture; empty where there is none."""

    @property
    def is_wide(self) -> bool:
        """True if a narrow screen should scroll the picture instead of shrinking it."""
        if self.png is None:
            return False
        width = int.from_bytes(self.png[16:20], "big")  # from the PNG's header
        return width > WIDE_PIXELS


def saved_picture(title: str, caption: str, path: Path, page: Path | None = None) -> Picture:
    """Return a PNG file as a picture of a report, which lies beside it or at `page`."""
    name = path.name if page is None else os.path.relpath(path, page.parent)
    return Picture(title, caption, path.read_bytes(), name)


def estimate_in_words(
    value: float | None, low: float | None, high: float | None, digits: int | None = None
) -> str:
    """Format an estimate and its interval, by default with two digits of the half width, "0.696
    (0.660 to 0.731)"; of one object "0.696 (one object: no interval)".
    """
    if value is None:
        return "none"
    if low is None or high is None:
        return f"{value:.{3 if digits is None else digits}f} (one object: no interval)"
    if digits is None:
        digits = min(max(1 - floor(log10((high - low) / 2)), 0), 3) if high > low else 3
    return f"{value:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def figure_of(width_in: float, height_in: float) -> "Figure":
    """Return an empty figure with automatic layout."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def png(figure: "Figure") -> bytes:
    """Return the figure as a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()


def page(title: str, subtitle: str, parts: Iterable[str]) -> str:
    """Return a self-contained document; title and subtitle are text, the parts HTML."""
    return PAGE.substitute(
        title=escape(title),
        under=escape(subtitle),
        style=STYLE,
        body="\n".join(parts),
        program=escape(program_name()),
    )


def figure(picture: Picture) -> str:
    title = escape(picture.title)
    caption = escape(picture.caption)
    if picture.png is None:
        return f"<section><h2>{title}</h2><p>{caption}</p></section>"
    data = base64.b64encode(picture.png).decode("ascii")
    image = f"<img alt='{title}' src='data:image/png;base64,{data}'>"
    if picture.is_wide:
        image = f"<div class='wide'>{image}</div>"
    return f"<figure><h2>{title}</h2>{image}<figcaption>{caption}</figcaption></figure>"


def table(
    rows: Iterable[tuple[str, ...]], head: tuple[str, ...], css_class: str = "numbers"
) -> str:
    """Return rows of text as a table; the first cell names the row."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = f"<thead><tr>{top}</tr></thead><tbody>{''.join(map(_row, rows))}</tbody>"
    return f"<div class='wide'><table class='{css_class}'>{body}</table></div>"


def pairs(facts: Mapping[str, str]) -> str:
    return f"<table><tbody>{''.join(map(_row, facts.items()))}</tbody></table>"


def _row(cells: tuple[str, ...]) -> str:
    name, *others = map(escape, cells)
    return f"<tr><th>{name}</th>{''.join(f'<td>{cell}</td>' for cell in others)}</tr>"


def bullets(name: str, items: Iterable[str], css_class: str = "") -> str:
    """Return a list of sentences under a heading; empty where there are none."""
    entries = "".join(f"<li>{escape(item)}</li>" for item in items)
    if not entries:
        return ""
    return f"<section class='{css_class}'><h3>{escape(name)}</h3><ul>{entries}</ul></section>"


def commands(lines: Iterable[str]) -> str:
    joined = "\n".join(lines)
    return f"<pre>{escape(joined)}</pre>"
