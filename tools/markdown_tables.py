"""Figures with their intervals as Markdown tables."""

from collections.abc import Mapping, Sequence

from nlos_cam.evaluate.report import in_words


def as_lines(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in [head, ["---"] * len(head), *rows])


def told(figure: Mapping[str, float | None]) -> str:
    """A difference, **bold** where its interval leaves 0 out."""
    low, high = figure["low"], figure["high"]
    apart = low is not None and high is not None and not low <= 0 <= high
    return f"**{in_words(figure)}**" if apart else in_words(figure)
