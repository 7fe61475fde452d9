"""`nlos-cam live --budget-ms`: the setting that keeps a delay on this machine, found by measuring, and told."""

from pathlib import Path
from typing import Annotated

import typer

BudgetMs = Annotated[
    float | None,
    typer.Option("--budget-ms", min=0.1, help="Choose the most accurate setting whose delay stays below so much."),
]
Tradeoff = Annotated[
    Path | None,
    typer.Option("--tradeoff", help="What `tradeoff reconstruct` measured, for --budget-ms; else beside the weights."),
]
