"""What becomes of kinds of objects that training never saw: docs/unseen_kinds.json, and a table for the docs.

`python tools/unseen_kinds.py WITHOUT WITH [--held-out DIR] [--left-out KIND,...]`: two folders of weights that were
trained alike but for the kinds, and held-out maps of every kind. Both are judged on the same maps, object by object.
"""

import json
from argparse import ArgumentParser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ablations import values_of
from markdown_tables import as_lines, told
from named_weights import errors_told, named
from nlos_models.checkpoint import load_pipeline
from nlos_models.inference import refuse_colour
from numpy.typing import NDArray

from nlos_cam.evaluate.metrics import BARS, PerObject, advantage, over_objects, plain
from nlos_cam.evaluate.report import in_words
from nlos_cam.evaluate.subjects import Judged, stored_objects

DOCS = Path(__file__).parents[1] / "docs"
LEFT_OUT = "airplane,table"


def loaded_values(folder: Path, judged: Judged) -> PerObject:
    """Every metric of every object, by the weights of a folder."""
    pipeline, record = load_pipeline(folder)
    refuse_colour(record, folder)
    return values_of(pipeline, record, judged)


def compared(
    without: PerObject, with_them: PerObject, categories: Sequence[str], left_out: Sequence[str]
) -> list[dict[str, Any]]:
    """A row for each kind that was left out, one for all others: both weights' figures, and what leaving out costs."""
    of = np.array(categories)
    if missing := sorted(set(left_out) - set(categories)):
        raise SystemExit(f"no {missing[0]} among the maps: name kinds of {', '.join(sorted(set(categories)))}")
    groups = {kind: of == kind for kind in left_out} | {"all others": ~np.isin(of, left_out)}
    return [_row(name, _of(without, chosen), _of(with_them, chosen)) for name, chosen in groups.items()]


def _of(values: PerObject, chosen: NDArray[np.bool_]) -> PerObject:
    return {metric: value[chosen] for metric, value in values.items()}


def _row(name: str, without: PerObject, with_them: PerObject) -> dict[str, Any]:
    return {
        "objects": name,
        "count": len(without["silhouette_iou"]),
        "without": plain(over_objects(without)),
        "with": plain(over_objects(with_them)),
        "without_better_by": plain(advantage(without, with_them)),
    }


def as_markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table for people."""
    cells = [
        [f"{row['objects']} ({row['count']})", said, *(how(row[of][metric]) for metric in BARS)]
        for row in rows
        for said, of, how in (
            ("never seen" if row["objects"] != "all others" else "seen", "without", in_words),
            ("seen", "with", in_words),
            ("difference", "without_better_by", told),
        )
    ]
    return as_lines(["objects", "in training", *BARS], cells)


def main() -> None:
    """Judge, compare, write, print."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("without", type=named)
    parser.add_argument("with_them", type=named, metavar="with")
    parser.add_argument("--held-out", type=Path, default=Path("data/held-out"))
    parser.add_argument("--left-out", default=LEFT_OUT, type=lambda text: text.split(","))
    parser.add_argument("--out", type=Path, default=DOCS)
    asked = parser.parse_args()
    with errors_told():
        judged = stored_objects(asked.held_out)
        values = [loaded_values(folder, judged) for _, folder in (asked.without, asked.with_them)]
    rows = compared(values[0], values[1], judged.categories, asked.left_out)
    table = {"left_out": asked.left_out, "rows": rows}
    (asked.out / "unseen_kinds.json").write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    print(as_markdown(rows))


if __name__ == "__main__":
    main()
