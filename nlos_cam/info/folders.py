"""Descriptions of folders, known by a file that each kind holds."""

import csv
import re
import shlex
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from nlos_models import RECORD, TRAINING_LOG, load_record

from nlos_cam.bench import MANIFEST, is_bench, load_bench
from nlos_cam.camera import pictures_command, source_to_name
from nlos_cam.errors import RecordingError
from nlos_cam.files import CHECKSUMS, TEXT_LIMIT, damaged_files, read_bounded
from nlos_cam.info.files import (
    Description,
    count,
    describe_bag,
    describe_npz,
    problem_of,
    read_json,
)
from nlos_cam.reconstruct import rig_in_words
from nlos_cam.recording import FRAME_GLOB, FRAME_STEM
from nlos_cam.report import estimate_in_words


def describe_bench(folder: Path, verify: bool) -> Description | None:
    """Describe a bench folder from its record; its checksums are always compared, those of its
    weights' tensors only to `verify`.
    """
    if not is_bench(folder):
        return None
    bench = load_bench(folder)
    record = bench.record
    quoted = shlex.quote(str(folder))
    facts = {"camera": record.camera.serial or "not known"}
    following = [pictures_command(bench.measured.record, f"--bench {quoted}")]
    for name, measured in bench.stations.items():
        wall = measured.record
        facts[f"station {name}"] = (
            f"{1e3 * wall.distance_m:.1f} mm and {wall.facing_deg:.1f} degrees from the wall, occluder"
            f" {wall.occluder.source if wall.occluder else 'not measured'}"
        )
        facts[f"verdict on {name}"] = f"{wall.verdict}: {wall.advice}"
        if wall.occluder is None:
            source = source_to_name(bench.measured.record)
            following.insert(0, f"nlos-cam calibrate --occluder {quoted} {source}")
    facts["weights"] = "its own" if bench.weights else "none: the shipped ones are used"
    created = f"{record.created:%Y-%m-%d %H:%M:%S} UTC"
    changed = f"{record.changed:%Y-%m-%d %H:%M:%S} UTC"
    return Description(
        "bench",
        facts | {"changed": changed},
        created,
        record.program,
        _checksum_problem(bench.weights) if verify and bench.weights else "",
        "checksums of all files" if verify else "checksums of all files but the tensors'",
        following,
    )


def describe_dataset(folder: Path, verify: bool) -> Description:
    """Describe a dataset from the heads of its shards."""
    from nlos_cam.dataset import check_arrays, shard_origin, shards_of

    shards = shards_of(folder)
    plan = shards[0].plan
    (version, command) = shard_origin(shards[0].path)
    objects = sum(len(shard.seeds) for shard in shards)
    span = shards[-1].seeds.stop - shards[0].seeds.start
    facts = {
        "objects": f"{objects} in {count(len(shards), 'shard')}",
        "seeds": f"{shards[0].seeds.start} to {shards[-1].seeds.stop - 1}"
        + (", with gaps" if objects < span else ""),
        "kind": "color" if plan.textures else "depth",
        "rig": "many, of all that the paper allows" if plan.rigs else plan.rig.name,
    }
    problem = problem_of(lambda: [check_arrays(shard) for shard in shards]) if verify else ""
    others = {shard.path.name for shard in shards if shard.provenance != shards[0].provenance}
    if others and not problem:
        facts["other plans"] = f"{count(len(others), 'shard')}, such as {min(others)}"
    quoted = shlex.quote(str(folder))
    task = "direct" if plan.rigs else "compressor"
    following = [
        f"nlos-cam evaluate --dataset {quoted}",
        f"nlos-cam train {task} --dataset {quoted} --help",
    ]
    checked = (
        "checksums of all arrays" if verify else "checksums of plans and seeds; --verify reads all"
    )
    return Description(
        "dataset", facts, "", f"nlos-cam {version}: {command}", problem, checked, following
    )


def describe_weights(folder: Path, _verify: bool) -> Description:
    """Describe weights from their record; the checksums of their files, some 50 MB, are always
    compared.
    """
    record = load_record(folder)
    quoted = shlex.quote(str(folder))
    facts = {
        "rig": f"{rig_in_words(record)} {record.rig_checksum}",
        "input": record.input,
        "runs": ", ".join(
            f"{recipe.task} ({count(recipe.epochs, 'epoch')})" for recipe in record.runs
        )
        or "none",
        "networks": ", ".join(sorted(path.stem for path in folder.glob("*.safetensors"))) or "none",
        "uncertainty": "yes" if (folder / "doubt.json").exists() else "no",
    }
    facts |= {name: f"{value:.3g}" for name, value in record.figures.items()}
    problem = _checksum_problem(folder)
    if not problem and facts["networks"] == "none":
        problem = f"{folder} holds no networks (*.safetensors): copy the weights again"
    following = [
        f"nlos-cam evaluate --weights {quoted}",
        f"nlos-cam live --camera sim --weights {quoted}",
    ]
    made_by = record.program
    return Description(
        "weights", facts, "", made_by, problem, f"checksums in {CHECKSUMS}", following
    )


def _checksum_problem(folder: Path) -> str:
    """Return the first file that is missing or differs from its checksum; empty if none does."""
    damaged = damaged_files(folder)
    if not damaged:
        return ""
    file = folder / damaged[0]
    if not file.exists():
        return f"{file} is missing: copy the weights again"
    return f"{file} is damaged (its checksum differs from {CHECKSUMS}): copy the weights again"


def describe_run(folder: Path, _verify: bool) -> Description:
    """Describe a training run from its log, and by the checksums of its weights once finished."""
    with (folder / TRAINING_LOG).open(encoding="utf-8", newline="") as file:
        rows = [*csv.DictReader(file)]
    finished = (folder / RECORD).exists()
    facts = {
        "epochs": str(len(rows)),
        "state": "finished" if finished else "not finished: the same command resumes",
    }
    if rows:
        facts |= {
            f"last {name}": value
            for name, value in rows[-1].items()
            if name and value and name != "epoch"
        }
    quoted = shlex.quote(str(folder))
    following = [f"nlos-cam evaluate --weights {quoted}"] if finished else []
    problem = _checksum_problem(folder) if finished else ""
    checked = f"log, checksums in {CHECKSUMS}" if finished else "log"
    return Description("training run", facts, "", "", problem, checked, following)


def _page_in(folder: Path) -> list[str]:
    """Return the command that shows a folder's report, where it has one."""
    page = folder / "report.html"
    return [f"open {shlex.quote(str(page))}"] if page.exists() else []


def describe_replay(folder: Path, verify: bool) -> Description:
    """Describe a replay from its result."""
    found = describe_npz(folder / "reconstruction.npz", verify)
    return Description(
        "replay",
        found.facts,
        "",
        "nlos-cam replay",
        found.problem,
        found.checked,
        [*_page_in(folder), *found.next],
    )


def describe_export(folder: Path, _verify: bool) -> Description:
    """Describe an export from its record."""
    record = _json(folder / "export.json")
    streams = record.get("streams", {})
    facts = {"recording": str(record.get("recording")), "every": f"{record.get('every', 1)}. frame"}
    for name in streams:
        images = len([*(folder / name).glob("*.png")])
        facts[name] = (
            f"{images} images"
            if images
            else "arrays"
            if (folder / f"{name}.npz").exists()
            else "left out"
        )
    facts["point clouds"] = str(len([*(folder / "points").glob("*.ply")]))
    return Description("export of a recording", facts, "", "nlos-cam export", "", "record")


def describe_figures(folder: Path, _verify: bool) -> Description:
    """Describe an evaluation from its figures."""
    figures = _json(folder / "figures.json")
    facts = {
        name: str(figures[name])
        for name in ("what", "objects", "weights", "rig", "runtime")
        if name in figures
    }
    if iou := figures.get("silhouette_iou"):
        facts["silhouette IoU"] = estimate_in_words(iou["value"], iou["low"], iou["high"], 3)
    following = _page_in(folder)
    return Description("evaluation", facts, "", "nlos-cam evaluate", "", "JSON", following)


def describe_tradeoff(folder: Path, _verify: bool) -> Description:
    """Describe a trade-off from its table."""
    table = _json(folder / "tradeoff.json")
    facts = {
        "machine": str(table.get("machine")),
        "complete": "yes" if table.get("complete") else "no: interrupted",
    }
    following = [f"open {shlex.quote(str(folder / 'tradeoff.html'))}"]
    return Description("trade-off", facts, "", "nlos-cam tradeoff", "", "JSON", following)


def _problem_of_arrays(paths: Sequence[Path]) -> str:
    """Return the first problem of .npz files, all of which is read; empty without one."""
    for path in paths:
        try:
            problem = describe_npz(path, verify=True).problem
        except RecordingError as error:
            problem = str(error)
        if problem:
            return problem
    return ""


def describe_adaptation(folder: Path, _verify: bool) -> Description:
    """Describe the work of `adapt` from its plan."""
    plan = _json(folder / ADAPTATION)
    stages = plan["stages"]
    minutes = sum(stage["minutes"] for stage in stages)
    done = sum((folder / f"stage-{n}" / "weights").exists() for n in range(1, len(stages) + 1))
    facts = {
        "rig's checksum": str(plan["rig_checksum"]),
        "minutes": f"{minutes:g} in {count(len(stages), 'stage')}, {done} done",
        "objects": str(stages[-1]["objects"]),
    }
    bench = shlex.quote(str(folder.parent))
    following = [f"nlos-cam adapt {bench} --minutes {minutes:g}"] if is_bench(folder.parent) else []
    if (page := folder / "adapt.html").exists():
        following.insert(0, f"open {shlex.quote(str(page))}")
    return Description("work of adapt", facts, "", "nlos-cam adapt", "", "plan", following)


def describe_detection(folder: Path, verify: bool) -> Description:
    """Describe a detection from its plan, or with `verify` from every turn too."""
    plan = _json(folder / "detection.json")
    paths = sorted(folder.glob("turn-*.npz"))
    problem = _problem_of_arrays(paths) if verify else ""
    turns = len(paths)
    facts = {name: str(plan[name]) for name in ("camera", "frames", "alpha", "control")}
    facts |= {"turns": f"{turns} of {plan['turns']}", "settings": str(len(plan["settings"]))}
    quoted = shlex.quote(str(folder))
    following = [f"nlos-cam detect {quoted}"]
    if (page := folder / "detection.html").exists():
        following.insert(0, f"open {shlex.quote(str(page))}")
    made_by = f"nlos-cam {plan['version']}: detect"
    checked = "plan, and checksums of all turns" if verify else "plan; --verify reads all turns"
    created = str(plan["created"])
    return Description("detection", facts, created, made_by, problem, checked, following)


def _json(path: Path) -> Mapping[str, Any]:
    """Return a JSON object. Raises RecordingError for anything else."""
    found = read_json(path, read_bounded(path, TEXT_LIMIT))
    if not isinstance(found, dict):
        raise RecordingError(f"{path} is not a JSON object: make it again")
    return found


def describe_recordings(folder: Path, verify: bool) -> Description:
    """Describe a folder of recordings, such as a bench's, from each one's index and sidecar."""
    paths = sorted(folder.glob("*.bag"))
    labels = Counter[str]()
    problem = ""
    for path in paths:
        try:
            found = describe_bag(path, verify)
        except RecordingError as error:
            problem = problem or str(error)
            continue
        problem = problem or found.problem
        labels[found.facts.get("label", "none")] += 1
    facts = {"recordings": str(len(paths))} | {
        f"labeled {label}" if label != "none" else "without a label": str(number)
        for label, number in sorted(labels.items())
    }
    checked = "every message" if verify else "indices; --verify reads every message"
    following = [f"nlos-cam info {shlex.quote(str(path))}" for path in paths[:1]]
    return Description("recordings", facts, "", "", problem, checked, following)


def describe_frame_files(folder: Path, _verify: bool) -> Description:
    """Describe a folder of files of single frames: images or point clouds of `export`, hidden
    objects of `replay` or `live`.
    """
    names = [path.name for path in folder.glob(FRAME_FILES)]
    numbers = sorted(int(re.split(r"\D", name, maxsplit=1)[0]) for name in names)
    endings = Counter(re.sub(FRAME_STEM, "", name, count=1) for name in names)
    facts = {ending: count(number, "file") for ending, number in sorted(endings.items())}
    facts["frames"] = f"{numbers[0]} to {numbers[-1]}"
    return Description("files of single frames", facts, checked="names of the files")


FRAME_FILES = f"{FRAME_GLOB}.*"
ADAPTATION = "plan.json"
"""Plan of `adapt` in its folder of work."""
FOLDERS: list[tuple[str, str, Callable[[Path, bool], Description | None]]] = [
    (MANIFEST, "bench", describe_bench),
    ("metadata.yaml", "recording", describe_bag),
    ("shard-*.h5", "dataset", describe_dataset),
    (TRAINING_LOG, "training run", describe_run),
    (RECORD, "weights", describe_weights),
    ("reconstruction.npz", "replay", describe_replay),
    ("export.json", "export of a recording", describe_export),
    ("figures.json", "evaluation", describe_figures),
    ("tradeoff.json", "trade-off", describe_tradeoff),
    ("detection.json", "detection", describe_detection),
    (ADAPTATION, "work of adapt", describe_adaptation),
    ("*.bag", "recordings", describe_recordings),
    (FRAME_FILES, "files of single frames", describe_frame_files),
]
"""File that each kind holds, kind and reader; the first that fits is taken."""
