"""Ways to train, side by side on the 54 test objects: docs/ablations.json and .md, docs/images/ablations.png.

`python tools/studies/ablations.py [NAME=]DIR [NAME=]DIR ... [--curve [NAME=]DIR ...] [--out docs]`: folders of weights,
compared with the first object by object. Those of --curve form a learning curve over the number of training objects.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import harness
from matplotlib.figure import Figure
from nlos_models import CheckpointRecord, load_record
from weights import values_of

from nlos_cam.evaluate import (
    LABELS,
    SMALLER_IS_BETTER,
    TARGETS,
    HeldOutObjects,
    PerObject,
    advantage,
    format_interval,
    over_objects,
    plain,
    rendered_objects,
    rig_of,
)

NOTES = """Means over objects and their bootstrap 95 % intervals. Differences are taken object by object, and
bootstrapped as such: positive is better, also where less is better, and **bold** where the interval leaves 0 out.
Objects and epochs are those of the last run: one that went on from earlier weights (two-then-joint) has theirs behind
it too."""


@dataclass(frozen=True)
class Trained:
    """Weights and their metrics for every object."""

    name: str
    record: CheckpointRecord
    values: PerObject

    @property
    def objects(self) -> int:
        """Number of objects that the compressor was trained on."""
        recipe = self.record.transfer_recipe or self.record.compressor_recipe
        return recipe.objects if recipe else 0

    @property
    def facts(self) -> dict[str, Any]:
        """Name, rig, input and recipe."""
        recipe = self.record.transfer_recipe or self.record.compressor_recipe
        facts = recipe.model_dump(include={"steps", "objects", "epochs", "seed"}) if recipe else {}
        return {"name": self.name, "rig": self.record.rig_name, "input": self.record.input, **facts}


def judged(folders: Mapping[str, Path], count: int | None = None) -> list[Trained]:
    """Judge all weights on the test objects, or on `count` random ones; objects of one rig are rendered once.

    Raises CheckpointError for weights of full color, and for folders without weights.
    """
    by_rig: dict[str, HeldOutObjects] = {}
    found = list[Trained]()
    for name, folder in folders.items():
        record = load_record(folder)
        rig = rig_of(record)
        if rig.checksum not in by_rig:
            by_rig[rig.checksum] = rendered_objects(rig, count)
        found.append(Trained(name, record, values_of(folder, by_rig[rig.checksum])))
    return found


def as_table(compared: Sequence[Trained], curve: Sequence[Trained]) -> dict[str, Any]:
    """Return the results for JSON."""
    first = compared[0]
    return {
        "objects": len(first.values["silhouette_iou"]),
        "against": first.name,
        "compared": [_row(one) | {"better_than_first": plain(advantage(one.values, first.values))} for one in compared],
        "learning_curve": [_row(one) for one in sorted(curve, key=lambda one: one.objects)],
    }


def _row(one: Trained) -> dict[str, Any]:
    return {**one.facts, **plain(over_objects(one.values))}


def as_markdown(table: Mapping[str, Any]) -> str:
    """Return docs/ablations.md."""
    parts = [f"# Ways to train, on {table['objects']} test objects", _figures(table["compared"])]
    if others := table["compared"][1:]:
        head = f"Better than {table['against']} by"
        rows = [
            [one["name"], *(harness.difference(one["better_than_first"][metric]) for metric in TARGETS)]
            for one in others
        ]
        parts.append(harness.table([head, *TARGETS], rows))
    if table["learning_curve"]:
        parts += ["## With more objects", _figures(table["learning_curve"])]
    return "\n\n".join([*parts, NOTES, "![every metric, by the way to train](images/ablations.png)"]) + "\n"


def _figures(rows: Sequence[Mapping[str, Any]]) -> str:
    head = ["weights", "steps", "input", "objects", "epochs", *TARGETS]
    facts = ("name", "steps", "input", "objects", "epochs")
    lines = [
        [*(str(row.get(fact, "")) for fact in facts), *(format_interval(row[metric]) for metric in TARGETS)]
        for row in rows
    ]
    return harness.table(head, lines)


def draw(table: Mapping[str, Any]) -> Figure:
    """Draw every metric with its interval for each of the weights, and below them the learning curve, if any."""
    compared, curve = table["compared"], table["learning_curve"]
    heights = [1.2 + 0.3 * len(compared), *([3.0] if curve else [])]
    figure = Figure(figsize=(13, sum(heights)), layout="constrained")
    rows = figure.subplots(len(heights), len(TARGETS), squeeze=False, height_ratios=heights)
    for column, metric in enumerate(TARGETS):
        _points(rows[0, column], compared, metric)
        if curve:
            _curve(rows[1, column], curve, metric)
    rows[0, 0].set_yticks(range(len(compared)), [row["name"] for row in compared])
    return figure


def _points(axis: Any, rows: Sequence[Mapping[str, Any]], metric: str) -> None:
    for k, row in enumerate(rows):
        if (value := row[metric]["value"]) is not None:
            axis.plot([row[metric]["low"], row[metric]["high"]], [k, k], color="tab:blue", linewidth=2, alpha=0.6)
            axis.plot(value, k, "o", color="tab:blue")
    axis.axvline(TARGETS[metric], color="tab:green", linestyle="--", linewidth=1)
    axis.set(title=LABELS[metric], xlabel=_better(metric), ylim=(len(rows) - 0.5, -0.5), yticks=range(len(rows)))
    axis.set_yticklabels([])
    axis.grid(alpha=0.3)


def _curve(axis: Any, rows: Sequence[Mapping[str, Any]], metric: str) -> None:
    known = [row for row in rows if row[metric]["value"] is not None]
    at = [row["objects"] for row in known]
    axis.plot(at, [row[metric]["value"] for row in known], "o-", color="tab:blue")
    axis.fill_between(at, *([row[metric][end] for row in known] for end in ("low", "high")), alpha=0.2)
    axis.axhline(TARGETS[metric], color="tab:green", linestyle="--", linewidth=1)
    axis.set(xscale="log", xlabel="objects trained on (log)", title=f"{LABELS[metric]}: {_better(metric)}")
    axis.grid(alpha=0.3)


def _better(metric: str) -> str:
    return f"{'less' if metric in SMALLER_IS_BETTER else 'more'} is better; dashed: wanted"


def compare(compared: Mapping[str, Path], curve: Mapping[str, Path], out: Path, count: int | None = None) -> str:
    """Judge all weights, write table, text and picture into a folder, and return the text."""
    found = {one.name: one for one in judged({**curve, **compared}, count)}
    table = as_table([found[name] for name in compared], [found[name] for name in curve])
    harness.write("ablations", table, out)
    harness.save("ablations", draw(table), out)
    text = as_markdown(table)
    (out / "ablations.md").write_text(text, encoding="utf-8")
    return text


def main() -> None:
    """Measure, write, print."""
    parser = harness.options(__doc__)
    parser.add_argument("weights", type=harness.named, nargs="+")
    parser.add_argument("--curve", type=harness.named, nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=harness.DOCS)
    asked = parser.parse_args()
    compared, curve = harness.by_name(asked.weights), harness.by_name(asked.curve)
    if clash := [name for name in curve if compared.get(name, curve[name]) != curve[name]]:
        raise SystemExit(f"two weights are called {clash[0]!r}: give them names with NAME=DIR")
    with harness.one_line_errors():
        print(compare(compared, curve, asked.out))


if __name__ == "__main__":
    main()
