"""`nlos-cam board`: print a board that tells the wall where the lidar's depth does not."""

from pathlib import Path
from typing import Annotated

import typer
from nlos_calibration.board import BOARDS, PAPER_MM, Paper

from nlos_cam.calibrate.board_pdf import write_sheet
from nlos_cam.cli.common import Json, Overwrite, finish, output_path

Out = Annotated[Path | None, typer.Option("--out", help="The PDF to write.")]
OnPaper = Annotated[Paper, typer.Option("--paper", help="What it will be printed on.")]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(board)


def board(out: Out = None, paper: OnPaper = "a4", overwrite: Overwrite = False, json: Json = False) -> None:
    """Write a ChArUco board as a PDF to scale, to be glued to the wall for `nlos-cam calibrate --wall --board`."""
    path = output_path(out, "board", ".pdf", overwrite=overwrite)
    write_sheet(path, paper)
    printed = BOARDS[paper]
    squares = f"{printed.squares_x} x {printed.squares_y} squares of {printed.square_mm:g} mm"
    text = (
        f"{squares} on {paper}\n"
        "print at 100 % with a laser printer (dye ink is white in infrared), and measure the bar: 100 mm\n"
        f"wrote {path}"
    )
    result = {"out": str(path), "paper": paper, "page_mm": list(PAPER_MM[paper]), **printed.model_dump()}
    finish(result, as_json=json, text=text)
