"""Document: the content of a report, written as an HTML page and as Markdown."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Literal

from nlos_cam.report import html
from nlos_cam.report.html import Picture

State = Literal["good", "doubtful", "out-of-range"]
"""Class of a banner's color in the style sheet."""


@dataclass(frozen=True)
class Banner:
    """Result in a few words, and advice; the color says whether it can be relied on."""

    state: State
    headline: str
    advice: str


@dataclass(frozen=True)
class Table:
    """Rows of text below a head; the first cell names the row."""

    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


@dataclass(frozen=True)
class Facts:
    """Values by name."""

    values: Mapping[str, str]


@dataclass(frozen=True)
class Bullets:
    """Sentences under a name; drawn only if there are any."""

    name: str
    items: Sequence[str]


@dataclass(frozen=True)
class Commands:
    """Command lines to go on with."""

    lines: Sequence[str]


Block = str | Banner | Table | Facts | Bullets | Commands
"""Part of a section; text is a paragraph."""


@dataclass(frozen=True)
class Section:
    """Blocks under a title; without a title they follow the page's head."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Document:
    """Report: title, a line below it, sections and pictures in order."""

    title: str
    subtitle: str
    parts: Sequence[Section | Picture]

    def as_html(self) -> str:
        """Return one self-contained page."""
        return html.page(self.title, self.subtitle, map(_part_html, self.parts))

    def as_markdown(self) -> str:
        """Return the text as Markdown, with links to the pictures' files."""
        blocks = [f"# {self.title}", self.subtitle]
        for part in self.parts:
            blocks += _part_markdown(part)
        return "\n\n".join(block for block in blocks if block) + "\n"


def write_document(document: Document, page: Path) -> None:
    """Write the page, and beside it a .md file of its text."""
    # A recording's name may hold bytes that are no UTF-8.
    texts = {".html": document.as_html(), ".md": document.as_markdown()}
    for suffix, text in texts.items():
        page.with_suffix(suffix).write_bytes(text.encode(errors="backslashreplace"))


def _part_html(part: Section | Picture) -> str:
    if isinstance(part, Picture):
        return html.figure(part)
    title = f"<h2>{escape(part.title)}</h2>" if part.title else ""
    return f"<section>{title}{''.join(map(_block_html, part.blocks))}</section>"


def _block_html(block: Block) -> str:
    match block:
        case Banner():
            words = f"<p class='word'>{escape(block.headline)}</p><p>{escape(block.advice)}</p>"
            return f"<section class='verdict {block.state}'>{words}</section>"
        case Table():
            return html.table(block.rows, block.head, "figures")
        case Facts():
            return html.pairs(block.values)
        case Bullets():
            return html.bullets(block.name, block.items, "warnings")
        case Commands():
            return html.commands(block.lines)
        case _:
            return f"<p>{escape(block)}</p>"


def _part_markdown(part: Section | Picture) -> list[str]:
    if isinstance(part, Picture):
        return [
            f"## {part.title}",
            f"![{part.title}]({part.file})" if part.file else "",
            part.caption,
        ]
    return [f"## {part.title}" if part.title else "", *map(_block_markdown, part.blocks)]


def _block_markdown(block: Block) -> str:
    match block:
        case Banner():
            return f"**{block.headline}.** {block.advice}"
        case Table():
            lines = [block.head, ("---",) * len(block.head), *block.rows]
            return "\n".join(f"| {' | '.join(line)} |" for line in lines)
        case Facts():
            return "\n".join(f"- {name}: {value}" for name, value in block.values.items())
        case Bullets():
            return "\n".join(f"- {block.name}: {item}" for item in block.items)
        case Commands():
            return "\n".join(["```sh", *block.lines, "```"])
        case _:
            return block
