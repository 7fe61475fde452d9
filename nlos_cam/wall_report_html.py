"""The pieces of HTML that the report on a measured wall is made of: the page, tables, lists, a bar with a marker."""

import base64
from collections.abc import Iterable, Mapping
from html import escape
from string import Template

from nlos_cam.wall_pictures import Picture

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
