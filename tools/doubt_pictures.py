"""The reliability plot: what uncertainty promises against what errors are."""

from pathlib import Path
from typing import Any

SETS = {"test_objects": "54 test objects", "held_out_objects": "held-out objects"}


def draw_reliability(path: Path, result: dict[str, Any]) -> None:
    """Expected against observed error, stated against observed coverage, and the same of where there is a surface."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4), layout="constrained")
    errors, covers, surfaces = figure.subplots(1, 3)
    for name, label in SETS.items():
        rows = result[name]
        errors.plot(*_columns(rows["reliability"], "expected_mm", "observed_mm"), "o-", label=label)
        covers.plot(*_columns(rows["coverage"], "level", "observed"), "o-", label=label)
        surfaces.plot(*_columns(rows["surface"], "expected", "observed"), "o-", label=label)
    titles = (
        (errors, "expected error (mm)", "observed error (mm)"),
        (covers, "stated coverage of an interval", "observed coverage"),
        (surfaces, "stated probability of a surface", "observed share"),
    )
    for axes, x, y in titles:
        most = max(axes.get_xlim()[1], axes.get_ylim()[1]) if axes is errors else 1.0
        axes.plot([0, most], [0, most], "k:", label="perfect")
        axes.set(xlabel=x, ylabel=y, xlim=(0, most), ylim=(0, most))
        axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _columns(rows: list[dict[str, float]], *names: str) -> list[list[float]]:
    return [[row[name] for row in rows] for name in names]
