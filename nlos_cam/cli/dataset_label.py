"""`dataset label`: labelled recordings to training maps."""

from pathlib import Path
from typing import Annotated

import typer

from nlos_cam.cli.common import Json, Overwrite, finish, output_path, tracked
from nlos_cam.cli.dataset_command import command_of
from nlos_cam.dataset.labelled import FRAMES_EACH, read_labelled, recordings_in, write_shards

Recordings = Annotated[Path, typer.Argument(metavar="DIR", help="A folder of recordings, each with its label.")]
Wall = Annotated[
    Path | None,
    typer.Option("--wall", help="The bench's wall record, the one that `live` is given: corrects the maps."),
]
Each = Annotated[int, typer.Option("--frames", min=1, help="Of each recording, evenly spread over it.")]


def add_label(data: typer.Typer) -> None:
    """Add the command to the group `dataset`."""
    data.command("label")(label)


def label(
    context: typer.Context,
    recordings: Recordings,
    out: Annotated[Path, typer.Option("--out", help="The dataset's folder.")],
    wall: Wall = None,
    frames: Each = FRAMES_EACH,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Make a dataset of labelled recordings of known objects: maps of single frames, and what was hidden meanwhile.

    A label is the name of a test object, or of files beside the recordings: LABEL.truth.toml (with the
    fields of a scene file's object; of the mesh LABEL.stl, .obj or .ply, unless it names another), or LABEL.npy (a
    depth map).
    """
    folder = output_path(out, "dataset", "", overwrite=overwrite)
    found = recordings_in(recordings)
    with tracked("reading recordings") as on_progress:
        labelled = read_labelled(found, wall=wall, frames=frames, on_progress=on_progress)
    write_shards(labelled, folder, command_of(context, "label"))
    labels = sorted(set(labelled.label))
    rig = {"rig_name": labelled.rig.name, "rig_checksum": labelled.rig.checksum}
    result = {"out": str(folder), "samples": len(labelled.label), "recordings": len(found), "labels": labels, **rig}
    text = f"{len(labelled.label)} samples of {len(labels)} objects in {len(found)} recordings: {folder}"
    finish(result, as_json=json, text=text)
