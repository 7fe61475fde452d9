"""Fill in our measured row of docs/comparison.md (Table S3) from docs/figures.json and docs/tradeoff_reconstruct.json.

No arguments; `--check` only compares. Run it after `nlos-cam evaluate` and `nlos-cam tradeoff reconstruct`.
"""

import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from kept_page import keep

from nlos_cam.camera.streams import FRAMES_PER_S
from nlos_cam.evaluate.metrics import BARS
from nlos_cam.evaluate.report import in_words

DOCS = Path(__file__).parents[1] / "docs"
MEASURED = re.compile(r"(?<=<!-- measured -->\n).*(?=<!-- end of measured -->)", re.DOTALL)


def row(figures: Mapping[str, Any], cost: Mapping[str, Any]) -> str:
    """Our row, and the figures behind it."""
    pick = next(one for one in cost["settings"] if cost["recommended"].items() <= one.items())
    collection_ms = 1000 / FRAMES_PER_S
    told = "; ".join(f"{name} {in_words(figures[name])}" for name in BARS)
    cells = (
        "nlos-cam, measured",
        "simulated consumer lidar (L515): depth and intensity maps",
        f"{collection_ms:.0f} ms (one frame)",
        f"{pick['milliseconds']:.0f} ms ({pick['name']}; {cost['machine']})",
        "depth map 64 x 64 of one object",
    )
    head = (
        "| system | light and detector | collection | computation | what comes out |\n| --- | --- | --- | --- | --- |"
    )
    behind = f"On {figures['objects']} objects never trained on, mean and 95 % interval: {told}."
    return f"{head}\n| {' | '.join(cells)} |\n\n{behind}\n"


def main() -> int:
    """Write the row, or say that it is out of date."""
    page = DOCS / "comparison.md"
    figures, cost = (
        json.loads((DOCS / name).read_text(encoding="utf-8")) for name in ("figures.json", "tradeoff_reconstruct.json")
    )
    return keep(page, MEASURED.sub(lambda _: row(figures, cost), page.read_text(encoding="utf-8")))


if __name__ == "__main__":
    sys.exit(main())
