"""Fill in docs/gallery.md: tables from docs/figures.json and docs/limits.json, and docs/images/failures.png.

`--tables` leaves the picture, which takes the networks, as it is. Run it after `nlos-cam evaluate` and tools/limits.py.
"""

import json
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration.arrays import Float32, Float64
from nlos_calibration.rig import load_rig
from nlos_models.metrics import silhouette_iou

from nlos_cam.evaluate.metrics import BARS
from nlos_cam.evaluate.report import in_words
from nlos_cam.evaluate.subjects import SeededObject, Subject, as_map_set, echoes_of, reconstruct_all, sense, truth_of
from nlos_cam.files import file_when_whole
from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects.benchmark import test_set
from nlos_cam.objects.depth_map import object_box
from nlos_cam.reconstruct.pipeline import load_networks

DOCS = Path(__file__).parents[1] / "docs"
PAGE, PICTURE = DOCS / "gallery.md", DOCS / "images" / "failures.png"
WORST = 6
NEAR_M, FAR_M = 0.16, 0.24


def by_kind(figures: Mapping[str, Any]) -> str:
    """Every kind of object, the worst first."""
    kinds: dict[str, Any] = figures["per_category"]
    worst_first = sorted(kinds, key=lambda kind: kinds[kind]["silhouette_iou"]["value"])
    rows = [f"| {kind} | {' | '.join(in_words(kinds[kind][name]) for name in BARS)} |" for kind in worst_first]
    bars = f"| **the bar** | {' | '.join(f'{bar:g}' for bar in BARS.values())} |"
    mean = f"| **all 54** | {' | '.join(in_words(figures[name]) for name in BARS)} |"
    return "\n".join([f"| kind | {' | '.join(BARS)} |", "| --- " * (1 + len(BARS)) + "|", *rows, mean, bars]) + "\n"


def by_limit(limits: Mapping[str, Any]) -> str:
    """Every way of taking something away that may be what limits."""
    names = "silhouette_iou", "foreground_rmse_mm"
    rows = [
        f"| {row['name']} | {row['tells']} | {' | '.join(in_words(row['figures'][name]) for name in names)} |"
        for row in limits["rows"]
    ]
    return "\n".join([f"| what | how | {' | '.join(names)} |", "| --- " * 4 + "|", *rows]) + "\n"


def filled(text: str, tables: Mapping[str, str]) -> str:
    """The page with its tables, each between `<!-- name -->` and `<!-- end -->`."""
    for name, table in tables.items():
        place = re.compile(rf"(?<=<!-- {name} -->\n).*?(?=<!-- end -->)", re.DOTALL)
        text = place.sub(lambda _, new=table: new, text, count=1)  # an empty place would match twice
    return text


def unlike_training() -> list[SeededObject]:
    """Things that no training object is like, and nothing at all."""
    y, x = (np.mgrid[:OBJECT_PIXELS, :OBJECT_PIXELS] - (OBJECT_PIXELS - 1) / 2) / OBJECT_PIXELS
    radius = np.hypot(x, y)
    shapes = {
        "a ring": np.where(abs(radius - 0.3) < 0.06, NEAR_M, np.nan),
        "two posts": np.where((abs(abs(x) - 0.25) < 0.06) & (abs(y) < 0.4), NEAR_M, np.nan),
        "a slanted plate": np.where(np.maximum(abs(x), abs(y)) < 0.35, (NEAR_M + FAR_M) / 2 + 0.15 * x, np.nan),
        "a wall of steps": np.where(abs(y) < 0.4, np.where(np.floor(8 * x) % 2 == 0, NEAR_M, FAR_M), np.nan),
        "nothing": np.full_like(x, np.nan),
    }
    return [SeededObject(name, name, depth_m.astype(np.float32)) for name, depth_m in shapes.items()]


def seen(subjects: Sequence[Subject]) -> tuple[Float32, Float32, Float64]:
    """What the shipped networks make of objects (n, 64, 64), the truth, and the silhouettes' IoU."""
    rig = load_rig("paper-rig")
    truth = truth_of(subjects, object_box(rig))
    maps = as_map_set(sense(echoes_of(subjects, rig, lambda *_: None), rig), truth)
    image = reconstruct_all(load_networks(), maps)
    return image, truth, silhouette_iou(image, truth)


def draw(path: Path, rows: Sequence[tuple[str, Sequence[Subject], Float32, Float32, Float64]]) -> None:
    """Truth above reconstruction, a block of two rows for each of `rows`."""
    from matplotlib.figure import Figure

    columns = max(len(subjects) for _, subjects, *_ in rows)
    figure = Figure(figsize=(1.35 * columns, 3.1 * len(rows)), layout="constrained")
    for part, (title, subjects, image, truth, iou) in zip(
        np.atleast_1d(figure.subfigures(len(rows))), rows, strict=True
    ):
        part.suptitle(title, fontsize=10)
        axes = part.subplots(2, columns)
        for axis in axes.flat:
            axis.set_axis_off()
        for k, subject in enumerate(subjects):
            for axis, picture in zip(axes[:, k], (truth[k], image[k]), strict=True):
                axis.imshow(picture, cmap="magma", vmin=0, vmax=1)
            axes[0, k].set_title(subject.name, fontsize=8)
            axes[1, k].set_title("no truth to meet" if not truth[k].any() else f"IoU {iou[k]:.2f}", fontsize=7)
    with file_when_whole(path) as part_path:
        figure.savefig(part_path, dpi=90, format="png")


def main() -> int:
    """Fill the page, and draw the picture."""
    figures, limits = (
        json.loads((DOCS / name).read_text(encoding="utf-8")) for name in ("figures.json", "limits.json")
    )
    tables = {"by kind": by_kind(figures), "by limit": by_limit(limits)}
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8"), tables), encoding="utf-8")
    if "--tables" not in sys.argv:
        fixed, others = test_set(object_box(load_rig("paper-rig"))), unlike_training()
        image, truth, iou = seen(fixed)
        worst = np.argsort(iou, kind="stable")[:WORST]
        rows = [
            ("the six worst of the 54 test objects", [fixed[k] for k in worst], image[worst], truth[worst], iou[worst]),
            ("unlike anything trained on, and nothing at all", others, *seen(others)),
        ]
        draw(PICTURE, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
