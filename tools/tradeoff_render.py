"""What accuracy costs in time on the default scene: docs/renderer.json and docs/images/tradeoff.png (no arguments).

Prints the table of docs/accuracy.md. Most of the time goes to brute force, which sums every path.
"""

import json
from pathlib import Path

from nlos_cam.evaluate.render_tradeoff import as_markdown, as_table, draw, facts, measure, settings
from nlos_cam.render.scene_file import paper_scene

DOCS = Path(__file__).parents[1] / "docs"


def main() -> None:
    """Measure, write, print."""
    scene = paper_scene().scene_at(0)
    size, rows = facts(scene), list(measure(scene))
    table = as_table(size, rows, len(settings(scene)))
    (DOCS / "renderer.json").write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
    draw(DOCS / "images" / "tradeoff.png", rows, f"airplane: {size.patches} patches, {size.beams_on_wall} beams")
    print(as_markdown(table))


if __name__ == "__main__":
    main()
