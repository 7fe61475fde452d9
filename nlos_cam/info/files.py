"""Description of a file or folder, and readers of single files."""

import csv
import json
import re
import shlex
import tomllib
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
from nlos_calibration import load_measured, load_rig, load_wall
from nlos_models.training import load_recipe

from nlos_cam.bench import load_bench_record
from nlos_cam.camera import pictures_command, source_to_name
from nlos_cam.errors import NlosCamError, RecordingError
from nlos_cam.files import read_arrays, read_bounded, read_toml, with_commit
from nlos_cam.objects import TRUTH_SUFFIX
from nlos_cam.view import SESSION_MARK

MAX_TEXT_BYTES = 16 << 20
MAX_HEAD_BYTES = 64 << 10
"""Of a .ply file."""


@dataclass(frozen=True)
class Description:
    """Content of a file or folder in a few facts. A reader of a damaged one gives the facts that it
    could read.
    """

    kind: str
    facts: Mapping[str, str] = field(default_factory=dict[str, str])
    """Name and value with unit, in the order to print them."""
    created: str = ""
    """As the content says it; empty where it does not."""
    made_by: str = ""
    """Program, version and command, as far as the content says them."""
    problem: str = ""
    """Reason why it is not whole, with the remedy; empty where it is."""
    checked: str = ""
    """Extent of the check."""
    next: Sequence[str] = ()
    """Command lines to go on with."""
    bytes: int = 0
    """Size of the file, or of all files in the folder."""


def program_of(versions: Mapping[str, str]) -> str:
    """Return the program that wrote a sidecar, by its versions."""
    return with_commit(f"nlos-cam {versions.get('nlos-cam', '')}", versions.get("commit", ""))


def size_of(path: Path) -> int:
    """Return the bytes of a file, or of all files in a folder."""
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    return sum(file.stat().st_size for file in files)


def count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def problem_of(check: Callable[[], object]) -> str:
    """Return the error of a check in words; empty if it passes."""
    try:
        check()
    except NlosCamError as error:
        return str(error)
    return ""


def describe_bag(path: Path, verify: bool) -> Description:
    """Describe a recording from its index, or with `verify` from every message."""
    from nlos_cam.camera import FORMATS, OPTIONAL
    from nlos_cam.recording import load_sidecar, open_recording, sidecar_path

    bag = open_recording(path)
    facts = {
        "device": " ".join(bag.device.get(name, "") for name in ("name", "serial_number")).strip()
        or "not known"
    }
    if longest := max(
        bag.streams.values(), key=lambda info: info.frames if info.format else 0, default=None
    ):
        facts["duration"] = f"{bag.duration_s(longest.name):.1f} s"
    for name, info in bag.streams.items():
        size = f"{info.intrinsics.width} x {info.intrinsics.height}"
        form = info.format or f"{info.encoding} (not readable)"
        facts[name] = (
            f"{count(info.frames, 'frame')}, {info.frames_per_s} per second, {size}, {form}"
        )
    created = made_by = ""
    if sidecar_path(path).exists():
        try:
            sidecar = load_sidecar(sidecar_path(path))
            created = f"{sidecar.started:%Y-%m-%d %H:%M:%S} UTC"
            made_by = program_of(sidecar.versions)
            facts |= {
                "label": sidecar.label or "none",
                "camera": sidecar.camera,
                "state": sidecar.state,
            }
        except (RecordingError, KeyError) as error:
            facts["sidecar"] = f"not readable: {error}"
    problem = problem_of(bag.check) if verify else ""
    quoted = shlex.quote(str(path))
    is_lidar = all(
        stream in bag.streams and bag.streams[stream].format == form
        for stream, form in FORMATS.items()
        if stream not in OPTIONAL
    )
    following = [] if not bag.streams else [f"nlos-cam export {quoted}"]
    if is_lidar and not problem:
        following = [f"nlos-cam replay {quoted} --out replayed", *following]
    return Description(
        "recording of a lidar" if is_lidar else "recording of a RealSense camera",
        facts,
        created,
        made_by,
        problem,
        "every message" if verify else "index; --verify reads every message",
        following,
    )


def describe_mesh(path: Path, _verify: bool) -> Description:
    """Describe a mesh, or a point cloud of `export`, by its triangles or points and its size."""
    from nlos_cam.objects import read_mesh

    if points := _points_alone(path):
        problem = _missing_points(path)
        return Description("point cloud", {"points": points}, problem=problem, checked="all of it")
    triangles = read_mesh(path).triangles
    corners = triangles.reshape(-1, 3)
    size = " x ".join(f"{side:.4g}" for side in np.ptp(corners, axis=0))
    facts = {"triangles": str(len(triangles)), "size": f"{size} (x, y, z, in the file's unit)"}
    following = [f"nlos-cam render {shlex.quote(str(path))}"]
    return Description("mesh", facts, checked="all of it", next=following)


def _points_alone(path: Path) -> str:
    """Return the number of points of a .ply without faces; empty for any other file."""
    with path.open("rb") as file:
        head, end, _ = file.read(MAX_HEAD_BYTES).partition(b"end_header")
    vertices = re.search(rb"^element vertex (\d+)", head, re.MULTILINE)
    if not (head.startswith(b"ply") and end and vertices) or b"element face" in head:
        return ""
    return vertices[1].decode()


def _missing_points(path: Path) -> str:
    """Return what is missing of a .ply of points; empty if it is whole."""
    import plyfile

    try:
        plyfile.PlyData.read(str(path))
    except (plyfile.PlyParseError, ValueError):
        return f"{path} is cut short or damaged: export it again"
    return ""


REPLAYED = "result of a replay"
ARRAYS = (
    ({"depth_m", "verdict", "origin_m"}, REPLAYED),
    ({"depth_m", "reference_sha256"}, "difference maps of a replay"),
    ({"object_depth_m", "margin", "radiometry"}, "rendering"),
    ({"lidar_depth_m", "infrared", "verdict"}, "frame saved from the live page"),
    ({"inliers", "map_depth_m", "facts"}, "reference of a bare wall"),
    ({"pixels", "frame_number", "timestamp_s"}, "exported stream"),
    ({"vertices_m", "faces"}, "mesh of a hidden surface"),
    ({"time_s", "mean", "std", "facts"}, "turn of a detection"),
)
"""Names that all files of a kind have."""
COUNTED = {
    "frame_number",
    "timestamp_s",
    "verdict",
    "object_depth_m",
    "facts",
    "vertices_m",
    "faces",
}
"""Arrays that are read, each up to MAX_ARRAY_BYTES."""
READ = COUNTED | {"rig_name", "rig_checksum", "radiometry"}
MAX_ARRAY_BYTES = 256 << 20


def describe_npz(path: Path, verify: bool) -> Description:
    """Describe arrays of `replay`, `render`, `calibrate` or `export`, by their names."""
    try:
        with ZipFile(path) as file:
            names = {Path(name).stem for name in file.namelist()}
            if any(
                each.file_size > MAX_ARRAY_BYTES
                for each in file.infolist()
                if Path(each.filename).stem in COUNTED
            ):
                raise RecordingError(
                    f"{path} holds more than {MAX_ARRAY_BYTES >> 20} MiB of numbers: make it again"
                )
            bad = file.testzip() if verify else None
        kind, facts, following = _kind_of_arrays(path, names, read_arrays(path, names & READ))
    except (
        BadZipFile,
        OSError,
        ValueError,
        LookupError,
        TypeError,
        NotImplementedError,
        zlib.error,
    ) as error:
        if isinstance(error, OSError) and error.errno:
            raise
        raise RecordingError(f"{path} is cut short or damaged ({error}): make it again") from error
    problem = f"{path} is damaged (the checksum of {bad} differs): make it again" if bad else ""
    checked = "checksums of all arrays" if verify else "list of arrays; --verify reads all"
    return Description(kind, facts, "", "", problem, checked, following)


def _kind_of_arrays(
    path: Path, names: set[str], arrays: Any
) -> tuple[str, dict[str, str], list[str]]:
    """Return kind, facts and next commands. Raises what numpy raises for damaged arrays."""
    quoted = shlex.quote(str(path))
    following = list[str]()
    facts = {"rig": f"{arrays['rig_name']} {arrays['rig_checksum']}"} if "rig_name" in names else {}
    kind = next((kind for needed, kind in ARRAYS if needed <= names), "arrays of another program")
    facts |= _frames(arrays) if {"frame_number", "timestamp_s"} <= names else {}
    if kind == REPLAYED:
        verdicts, counts = np.unique(arrays["verdict"], return_counts=True)
        facts["verdicts"] = ", ".join(
            f"{verdict or 'none'} {n}" for verdict, n in zip(verdicts, counts, strict=True)
        )
        following = [f"nlos-cam export {quoted} --object ply,glb,csv"]
    elif "object_depth_m" in names:
        known = np.isfinite(arrays["object_depth_m"])
        facts |= {
            "radiometry": str(arrays["radiometry"]),
            "object": f"{known.sum()} of {known.size} pixels",
        }
    elif "inliers" in names:
        known = json.loads(str(arrays["facts"]))
        facts |= {"frames": str(known.get("frames")), "serial": known.get("serial") or "not known"}
        following = [f"nlos-cam info {shlex.quote(str(path.with_suffix('.toml')))}"]
    elif "lidar_depth_m" in names:
        facts["verdict"] = str(arrays["verdict"]) or "none"
    elif "vertices_m" in names:
        facts |= {"vertices": str(len(arrays["vertices_m"])), "faces": str(len(arrays["faces"]))}
    else:
        facts["arrays"] = ", ".join(sorted(names))
    return kind, facts, following


def _frames(arrays: Any) -> dict[str, str]:
    """Return number and duration of frames; of a single one its arrays are numbers."""
    numbers = np.atleast_1d(arrays["frame_number"])
    times_s = np.atleast_1d(arrays["timestamp_s"])
    if not len(numbers):
        return {"frames": "none"}
    span_s = times_s[-1] - times_s[0]
    return {
        "frames": f"{len(numbers)}, numbers {numbers[0]} to {numbers[-1]}",
        "duration": f"{span_s:.1f} s",
    }


def describe_toml(path: Path, verify: bool) -> Description | None:
    """Describe a wall record, scene, rig, recipe, object or settings file, by its keys. A record's
    reference is read only to `verify`.
    """
    try:
        keys = read_toml(path)
    except UnicodeDecodeError as error:
        raise _binary(path) from error
    except tomllib.TOMLDecodeError as error:
        raise RecordingError(
            f"{path} is not TOML ({error}): correct it, or write it again"
        ) from error
    if path.name.endswith(TRUTH_SUFFIX):
        named = keys.get("category") or keys.get("file") or "the mesh beside it"
        facts = {"object": str(named)}
        return Description("object of labelled recordings", facts, checked="that it is TOML")
    if {"created", "verdict"} & set(keys):
        return _bench_record(path) if "bench_version" in keys else _wall(path, verify)
    readers = (
        ({"task"}, _recipe),
        ({"lidar", "base"}, _rig),
        ({"rig", "object", "motion", "sensor", "faults", "radiometry"}, _scene),
    )
    for marks, reader in readers:
        if marks & set(keys):
            return reader(path)
    if path.name == "nlos-cam.toml":
        return Description(
            "settings",
            {key: str(value) for key, value in keys.items()},
            checked="that it is TOML; `nlos-cam config` checks names and values",
            next=["nlos-cam config"],
        )
    return None


def _recipe(path: Path) -> Description:
    recipe = load_recipe(path)
    facts = {"task": recipe.task, "epochs": str(recipe.epochs)}
    following = [f"nlos-cam train {recipe.task} --help"]
    return Description("training recipe", facts, checked="all fields", next=following)


def _rig(path: Path) -> Description:
    rig = load_rig(str(path))
    facts = {"name": rig.name, "checksum": rig.checksum, **_pose(rig)}
    following = [f"nlos-cam render cup --rig {shlex.quote(str(path))}"]
    return Description("rig", facts, checked="all fields", next=following)


def _scene(path: Path) -> Description:
    from nlos_cam.render import load_scene

    scene = load_scene(path)
    facts = {"name": scene.name, "rig": scene.rig.name, "radiometry": scene.radiometry}
    poses = f"{count(scene.motion.poses, 'pose')}, repeated" if scene.motion else "one pose"
    quoted = shlex.quote(str(path))
    following = [
        f"nlos-cam live --camera sim:{quoted}",
        f"nlos-cam capture --camera sim:{quoted} --out run.bag",
    ]
    return Description(
        "scene of the simulated camera",
        {**facts, "frames": poses},
        checked="all fields",
        next=following,
    )


def _bench_record(path: Path) -> Description:
    load_bench_record(path.parent)
    folder = shlex.quote(str(path.parent))
    return Description("record of a bench", checked="all fields", next=[f"nlos-cam info {folder}"])


def _wall(path: Path, verify: bool) -> Description:
    quoted = shlex.quote(str(path))
    record = load_wall(path)
    facts = {
        "verdict": f"{record.verdict}: {record.advice}",
        "camera": record.camera,
        "frames": str(record.frames),
    }
    facts |= {
        **_pose(record.rig),
        "occluder": record.occluder.source if record.occluder else "not measured",
    }
    problem = ""
    if record.reference:
        reference = path.with_name(record.reference)
        facts["reference"] = record.reference
        if not reference.exists():
            problem = f"its reference {reference} is missing: put it back, or calibrate again"
        elif verify:
            load_measured(path)
    following = [pictures_command(record, f"--wall {quoted}")]
    if record.occluder is None:
        following.append(
            f"nlos-cam calibrate --occluder {quoted} {source_to_name(record)} --out occluder.toml"
        )
    return Description(
        "wall record",
        facts,
        str(record.created),
        "nlos-cam calibrate",
        problem,
        "all fields and the reference" if verify else "all fields; --verify reads the reference",
        following,
    )


def _pose(rig: Any) -> dict[str, str]:
    return {
        "lidar": f"{1e3 * rig.lidar.distance_m:.1f} mm from the wall, facing {rig.facing_deg:.2f}°"
    }


def _text(path: Path) -> str:
    """Return a file's text. Raises RecordingError for a binary file, and OSError for one too long
    for a record.
    """
    try:
        return read_bounded(path, MAX_TEXT_BYTES).decode()
    except UnicodeDecodeError as error:
        raise _binary(path) from error


def _binary(path: Path) -> RecordingError:
    return RecordingError(f"{path} is a binary file, not a {path.suffix} file: check the name")


JSON_KINDS = {
    "alpha": "plan of a detection",
    "bars": "figures of an evaluation",
    "pace": "plan of an adaptation",
    "pareto_front": "table of a trade-off",
    "recording": "record of an export",
    "rig_checksum": "record of weights",
    "watches": "record of an uncertainty network",
}
"""Kinds of JSON files by a key that none has of those below it."""


def read_json(path: Path, text: str | bytes) -> Any:
    """Return the content of a JSON file from its text. Raises RecordingError where it is none."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RecordingError(
            f"{path} is not JSON ({error}): it is cut short or damaged; make it again"
        ) from error


def describe_json(path: Path, verify: bool) -> Description | None:
    """Describe a sidecar, or one of the program's other JSON files."""
    keys = read_json(path, _text(path))
    if isinstance(keys, dict) and {"state", "started"} <= set(keys):
        return _sidecar(path, verify)
    kinds = [kind for key, kind in JSON_KINDS.items() if isinstance(keys, dict) and key in keys]
    if not kinds:
        return None
    return Description(kinds[0], {}, checked="JSON")


def _sidecar(path: Path, verify: bool) -> Description:
    from nlos_cam.recording import load_sidecar

    sidecar = load_sidecar(path)
    bag = path.with_suffix(".bag")
    facts = {"camera": sidecar.camera, "state": sidecar.state, "label": sidecar.label or "none"}
    if sidecar.summary and sidecar.summary.frames is not None:
        facts["frames"] = f"{sidecar.summary.frames}, {sidecar.summary.dropped or 0} dropped"
    problem = ""
    if not bag.exists():
        problem = f"its recording {bag} is missing: put it back beside this file"
    elif verify:
        problem = describe_bag(bag, verify).problem
    made_by = f"{program_of(sidecar.versions)} capture"
    following = [] if problem else [f"nlos-cam info {shlex.quote(str(bag))}"]
    created = f"{sidecar.started:%Y-%m-%d %H:%M:%S} UTC"
    return Description(
        "sidecar of a recording", facts, created, made_by, problem, "all fields", following
    )


def describe_log(path: Path, _verify: bool) -> Description | None:
    """Describe the log of a live run from all of its lines."""
    with path.open(encoding="utf-8", newline="") as file:
        lines = [line for line in file if line.endswith("\n")]  # a killed run may cut the last one
    if path.suffix == ".csv":
        table = csv.DictReader(lines)
        names = set(table.fieldnames or ())
        rows: list[dict[str, Any]] = [*table]
    else:
        rows = [json.loads(line) for line in lines]
        names = set(rows[0]) if rows else set[str]()
    if not {"frame_number", "published_s", "latency_ms"} <= names:
        return None
    whole = [row for row in rows if row["latency_ms"] not in {None, ""}]
    if not whole:
        return Description("log of a live run", {"frames": "0"}, "", "nlos-cam live")

    latency_ms = np.median([float(row["latency_ms"]) for row in whole])
    seconds = float(whole[-1]["published_s"]) - float(whole[0]["published_s"])
    facts = {"frames": str(len(rows)), "duration": f"{seconds:.1f} s"}
    facts["latency"] = f"{latency_ms:.1f} ms (median)"
    verdicts = Counter(row.get("verdict") or "no verdict" for row in whole)
    facts |= {verdict: count(number, "frame") for verdict, number in verdicts.items()}
    return Description("log of a live run", facts, "", "nlos-cam live", "", "all lines")


def describe_page(path: Path, _verify: bool) -> Description | None:
    """Describe a saved view or a report."""
    with path.open("rb") as file:
        head = file.read(1 << 14)
        file.seek(max(path.stat().st_size - 64, 0))
        end = file.read()
    if SESSION_MARK in head:
        return Description(
            "saved view", checked="head", next=[f"nlos-cam view {shlex.quote(str(path))}"]
        )
    if b'<p class="under">' not in head:
        return None
    title = head.partition(b"<title>")[2].partition(b"</title>")[0].decode("utf-8", "replace")
    problem = "" if b"</html>" in end else f"{path} is cut short: write the report again"
    return Description("report", {"title": title}, problem=problem, checked="head and end")


def describe_shard(path: Path, verify: bool) -> Description:
    """Describe a shard of a dataset; its heads have checksums."""
    from nlos_cam.dataset import check_arrays, read_head, shard_origin

    head = read_head(path)
    problem = problem_of(lambda: check_arrays(head)) if verify else ""
    version, command = shard_origin(path)
    seeds = f"{len(head.seeds)}, seeds {head.seeds.start} to {head.seeds.stop - 1}"
    facts = {"objects": seeds, "rig": head.plan.rig.name}
    made_by = f"nlos-cam {version}: {command}"
    checked = (
        "checksums of all arrays" if verify else "checksums of plan and seeds; --verify reads all"
    )
    following = [f"nlos-cam info {shlex.quote(str(path.parent))}"]
    return Description("dataset shard", facts, "", made_by, problem, checked, following)
