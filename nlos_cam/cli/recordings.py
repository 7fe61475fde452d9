"""`nlos-cam repair` and `nlos-cam export`: recover a damaged recording; write frames or hidden
surfaces as files.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Literal

import typer

from nlos_cam import recording as bags
from nlos_cam import replay as replays
from nlos_cam.cli import common
from nlos_cam.errors import RecordingError

DamagedBag = Annotated[
    Path, typer.Argument(metavar="F.BAG", help="Recording that was killed, cut short or damaged.")
]
NewBag = Annotated[Path | None, typer.Option("--out", help="Recording to write (.bag).")]
FirstPart = Annotated[
    Path | None,
    typer.Option(
        "--from",
        metavar="FIRST.BAG",
        help="Take the descriptions of the streams from this first part of a split recording.",
    ),
]
AnyBag = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        help="Recording of any RealSense camera, or with --object a replay's folder or its"
        " reconstruction.npz.",
    ),
]
Folder = Annotated[Path | None, typer.Option("--out", help="Folder to write.")]
As = Annotated[
    Literal["png", "npz"],
    typer.Option("--format", help="png: a 16-bit PNG per frame. npz: one file per stream."),
]
Ply = Annotated[
    bool,
    typer.Option(
        "--ply",
        help="Write a point cloud (PLY, metres, lidar frame) per frame, not for the first only.",
    ),
]
Streams = Annotated[
    str, typer.Option("--streams", help="Only these streams, separated by commas (default: all).")
]
Every = Annotated[int, typer.Option("--every", min=1, help="Only every Nth frame, counted.")]
AsObject = Annotated[
    str,
    typer.Option(
        "--object",
        metavar="FORMATS",
        help=(
            "Write each frame's hidden surface, wall frame, in metres: some of ply, glb, obj"
            " (meshes), csv, npz, points (a PLY without faces), separated by commas."
        ),
    ),
]
Ros2 = Annotated[
    Path | None,
    typer.Option(
        "--ros2",
        metavar="FOLDER",
        help="Write a bag of ROS 2 (rosbag2) with the topics of the driver realsense2_camera.",
    ),
]
RosStorage = Annotated[
    Literal["sqlite3", "mcap"],
    typer.Option("--storage", help="Storage of the bag of ROS 2: a .db3 or an .mcap."),
]
Metres = Annotated[
    bool,
    typer.Option(
        "--metres",
        help="Depth of the bag of ROS 2 in metres (32FC1): every bit kept, not rounded to mm.",
    ),
]
MAX_REPORTED = 5


def object_formats(text: str) -> list[str]:
    """Return the formats of --object. Raises typer.BadParameter for an unknown one."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if unknown := [name for name in names if name not in replays.OBJECT_FORMATS]:
        raise typer.BadParameter(
            f"--object {','.join(unknown)}: choose from {', '.join(replays.OBJECT_FORMATS)}"
        )
    return names


def repair(
    bag: DamagedBag,
    out: NewBag = None,
    take_from: FirstPart = None,
    overwrite: common.Overwrite = False,
    json: common.Json = False,
) -> None:
    """Write the undamaged part of a recording, with a new index, to a new file; the original is not
    changed.
    """
    if out is not None and out.suffix != ".bag":
        raise typer.BadParameter(f"--out {out}: the name of a recording must end in .bag")
    path = common.output_path(out, "repaired", ".bag", overwrite=overwrite)
    sidecar = bags.sidecar_path(path)
    common.output_path(sidecar, "", sidecar.suffix, overwrite=overwrite)
    with common.interrupted_by_signals(), common.tracked("repairing") as report:
        repaired = bags.repair_recording(bag, path, report, take_from=take_from)
    sidecar.unlink(missing_ok=True)  # of the recording that this one replaces
    result = {
        "recovered_frames": repaired.recovered_frames,
        "chunks": repaired.chunks,
        "damaged": len(repaired.damages),
        "out": str(path),
    }
    common.finish(result, as_json=json, text=_format_repair(repaired))


def _format_repair(repaired: bags.RepairResult) -> str:
    frames = ", ".join(f"{count} {stream}" for stream, count in repaired.recovered_frames.items())
    lost = sum(damage.bytes for damage in repaired.damages)
    lines = [f"Recovered {frames} frames ({repaired.chunks} chunks); lost {lost} bytes"]
    lines += [
        f"at byte {damage.position}: {damage.why}" for damage in repaired.damages[:MAX_REPORTED]
    ]
    if (more := len(repaired.damages) - MAX_REPORTED) > 0:
        lines.append(f"and damage at {more} more places")
    return "\n".join([*lines, f"Wrote {repaired.out}"])


def export(
    bag: AnyBag,
    out: Folder = None,
    form: As = "png",
    ply: Ply = False,
    streams: Streams = "",
    every: Every = 1,
    as_object: AsObject = "",
    ros2: Ros2 = None,
    storage: RosStorage = "sqlite3",
    metres: Metres = False,
    overwrite: common.Overwrite = False,
    json: common.Json = False,
) -> None:
    """Write a recording's frames as files, or a replay's hidden surfaces for other programs."""
    if ros2 is not None:
        if out or form != "png" or ply or streams or every != 1 or as_object:
            raise typer.BadParameter("--ros2 writes a whole recording: drop the other options")
        folder = common.output_path(ros2, "ros2", "", overwrite=overwrite)
        _export_ros2(bag, folder, bags.RosOptions(storage, metres), as_json=json)
        return
    if metres or storage != "sqlite3":
        raise typer.BadParameter("--metres and --storage need --ros2")
    folder = common.output_path(out, "export", "", overwrite=overwrite)
    if (bag / replays.RESULT).is_file():
        bag = bag / replays.RESULT  # the folder of a replay stands for its result
    if bag.suffix == ".npz" or as_object:
        if form != "png" or ply or streams:
            raise typer.BadParameter(
                "hidden surfaces have no streams: drop --format, --ply and --streams"
            )
        _export_objects(bag, folder, object_formats(as_object), every, as_json=json)
        return
    names = [name.strip() for name in streams.split(",") if name.strip()]
    options = bags.ExportOptions(form, ply, names, every)
    recording = bags.open_recording(bag)
    total = sum(
        info.frames for name, info in recording.streams.items() if not names or name in names
    )
    with common.stop_on_signals() as stop, common.progress() as bar:
        task = bar.add_task("exporting", total=total)
        exported = bags.export_recording(
            recording, folder, options, stop=stop, on_frame=lambda: bar.advance(task)
        )
    if exported.damage:
        raise RecordingError(f"{exported.damage}; the frames before the damage are in {folder}")
    counts = dict(exported.frames)
    clouds = counts.pop("points", 0)
    text = ", ".join(f"{count} {name}" for name, count in counts.items()) + " images"
    text += f"; {clouds} point cloud{'' if clouds == 1 else 's'}" if clouds else ""
    common.finish(
        {"frames": exported.frames, "out": exported.out},
        as_json=json,
        text=f"{text}\nWrote {exported.out}",
    )
    if stop.is_set():
        common.exit_interrupted(f"{exported.out} holds the frames until then")


def _export_ros2(bag: Path, folder: Path, options: bags.RosOptions, *, as_json: bool) -> None:
    recording = bags.open_recording(bag)
    total = sum(info.frames for info in recording.streams.values())
    with common.stop_on_signals() as stop, common.progress() as bar:
        task = bar.add_task("exporting", total=total)
        exported = bags.export_ros2(
            recording, folder, options, stop=stop, on_frame=lambda: bar.advance(task)
        )
    if exported.damage:
        raise RecordingError(f"{exported.damage}; the frames before the damage are in {folder}")
    counts = ", ".join(f"{count} {name}" for name, count in exported.frames.items())
    unit = "metres (32FC1)" if options.metres else "millimetres (16UC1), rounded"
    text = f"{counts} images; depth in {unit}\nWrote {folder}"
    common.finish({"frames": exported.frames, "out": str(folder)}, as_json=as_json, text=text)
    if stop.is_set():
        common.exit_interrupted(f"{folder} holds the frames until then")


def _export_objects(
    result: Path, folder: Path, formats: list[str], every: int, *, as_json: bool
) -> None:
    if not formats:
        raise typer.BadParameter(
            f"{result}: give the formats of its hidden surfaces, as in --object ply,glb,csv"
        )
    if result.suffix == ".bag":
        raise typer.BadParameter(
            "--object needs a replay's result: nlos-cam replay"
            f" {shlex.quote(str(result))} --object ply,glb,csv"
        )
    with common.stop_on_signals() as stop, common.tracked("exporting") as on_frame:
        count = replays.export_objects(result, folder, formats, every, stop=stop, on_frame=on_frame)
    text = (
        f"Hidden surfaces of {count} frame{'' if count == 1 else 's'} as"
        f" {', '.join(formats)}\nWrote {folder}"
    )
    common.finish({"frames": {"objects": count}, "out": str(folder)}, as_json=as_json, text=text)
    if stop.is_set():
        common.exit_interrupted(f"{folder} holds the surfaces until then")
