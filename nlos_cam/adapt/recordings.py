"""Recordings of known objects as the second stage of an adaptation: the transfer of SI 4.

Whole objects are held out: from other poses of an object that it was trained on, a network would
know it again. Some decide which epoch is kept, others alone whether the result is.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from nlos_calibration import TOLERANCE_DEG, TOLERANCE_M, Rig
from nlos_models import training

from nlos_cam import dataset as data
from nlos_cam.errors import RecordingError, SceneError
from nlos_cam.files import read_toml
from nlos_cam.objects import TRUTH_SUFFIX
from nlos_cam.reconstruct import differences_of
from nlos_cam.recording import load_sidecar, sidecar_path

RECORDINGS = "recordings"
"""Folder of a bench with labelled recordings."""
RECIPE = "direct-transfer"
MIN_OBJECTS = 3
MAX_SIMULATED_LOSS = 0.1
"""Silhouette IoU on simulated test objects that a fit to recordings may cost: they are another
bench than the real one, and the judged recordings may be few."""
JUDGED_EVERY = 3
"""Every third object is held out to judge the result."""
VALIDATION_EVERY = 4
"""Of the others, every fourth is held out to choose the epoch."""
MIN_FRAMES = 2
"""Least that a network trains on."""
DIGITS = 12
TRUTHS = ".bag", ".json", ".toml", ".npy", ".stl", ".obj", ".ply"
Part = Literal["adaptation", "validation", "judged"]


@dataclass(frozen=True)
class Recordings:
    """Labelled recordings of known objects on one bench."""

    folder: Path
    by_label: Mapping[str, Sequence[Path]]
    """Recordings of each object, in the order of their labels."""
    open_bench: data.OpenBench
    """Opens the bench for a recording's camera."""
    digest: str
    """Hexadecimal digits that change with the recordings and what is said of their objects."""

    def part(self, part: Part) -> list[Path]:
        """Return the recordings of a part; no object is in two."""
        parts = parts_of(list(self.by_label))
        return [path for label in parts[part] for path in self.by_label[label]]


def iou_of(figures: Mapping[str, Any]) -> float:
    """Return the silhouette IoU from the figures of weights (figures.json)."""
    return figures["silhouette_iou"]["value"]


@dataclass(frozen=True)
class Transfer:
    """Result of a transfer to recordings."""

    folder: Path
    parts: Mapping[Part, Sequence[str]]
    """Labels of the objects in each part."""
    recordings: int
    start: dict[str, Any]
    """Figures of the start weights, aligned, on the judged recordings."""
    before: dict[str, Any]
    """Figures of the weights that were fitted, on the same."""
    after: dict[str, Any]
    simulated_loss: float = 0.0
    """Silhouette IoU that the fit costs on the simulated test objects on the bench."""

    @property
    def is_nearer(self) -> bool:
        """True if the fit has a larger silhouette IoU on the judged objects than the weights before
        it, and no smaller one than the start weights, which after a few minutes of adaptation may
        still be the better ones.
        """
        after = iou_of(self.after)
        return after > iou_of(self.before) and after >= iou_of(self.start)

    @property
    def is_better(self) -> bool:
        """True if the fit helped, and costs at most MAX_SIMULATED_LOSS in simulation."""
        return self.is_nearer and self.simulated_loss <= MAX_SIMULATED_LOSS


def parts_of(labels: Sequence[str]) -> dict[Part, list[str]]:
    """Return the objects of each part, by their places in the alphabet: more recordings of them
    change nothing.
    """
    judged = [*labels][JUDGED_EVERY - 1 :: JUDGED_EVERY]
    others = [label for label in labels if label not in judged]
    validation = others[::VALIDATION_EVERY]
    adaptation = [label for label in others if label not in validation]
    return {"adaptation": adaptation, "validation": validation, "judged": judged}


def find_recordings(
    folder: Path, rig: Rig, open_bench: data.OpenBench, on_message: Callable[[str], None]
) -> Recordings | None:
    """Return the labelled recordings of a folder that were made on a rig; None where there are
    none, or of too few objects, with a message.
    """
    if not folder.is_dir():
        return None
    # Before they are listed: the work on recordings that are added meanwhile has another digest.
    digest = _digest_of(folder)
    by_label: dict[str, list[Path]] = {}
    for path in sorted(folder.glob("*.bag")):
        try:
            sidecar = load_sidecar(sidecar_path(path))
        except RecordingError as error:
            on_message(f"note: {path} is left out: {error}")
            continue
        label = sidecar.label
        if sidecar.rig and not _is_as_before(sidecar.rig, rig):
            on_message(
                f"note: {path} is left out: lidar, occluder or object box have moved since, as this"
                " bench was calibrated again or its box edited; record its object once more"
            )
        elif label:
            by_label.setdefault(label, []).append(path)
        else:
            on_message(f"note: {path} is left out: it has no label")
    if 0 < len(by_label) < MIN_OBJECTS:
        on_message(
            f"note: {folder} holds recordings of {len(by_label)} objects: from {MIN_OBJECTS} on,"
            " weights are fitted to them and judged on others"
        )
    if len(by_label) < MIN_OBJECTS:
        return None
    return Recordings(folder, dict(sorted(by_label.items())), open_bench, digest)


def _digest_of(folder: Path) -> str:
    """Return `Recordings.digest` of the files in a folder as they are now."""
    digest = hashlib.sha256()
    here = [path for path in sorted(folder.iterdir()) if path.suffix in TRUTHS]
    for path in (*here, *_meshes_elsewhere(here)):
        with path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").hexdigest()
        digest.update(f"{path.name} {content}\n".encode())
    return digest.hexdigest()[:DIGITS]


def _meshes_elsewhere(files: Sequence[Path]) -> Iterator[Path]:
    """Yield the meshes in other folders that truth files name."""
    for path in files:
        if not path.name.endswith(TRUTH_SUFFIX):
            continue
        try:
            mesh = (path.parent / str(read_toml(path).get("file", ""))).resolve()
        except (OSError, ValueError):  # an error when the recording is read
            continue
        if mesh.is_file() and mesh.parent != path.parent.resolve():
            yield mesh


def _is_as_before(recorded: Rig, rig: Rig) -> bool:
    """Return whether two calibrations can be of one bench that has not moved."""
    apart = differences_of(recorded, rig)
    # The truth of a recording counts from the box in which its object stood.
    moved_m = max(apart.distance_m, apart.occluder_m, apart.box_m)
    turned_deg = max(apart.turned_deg, apart.view_deg)
    return moved_m <= TOLERANCE_M and turned_deg <= TOLERANCE_DEG


def write_parts(found: Recordings, folder: Path, tracked: data.Tracked) -> dict[Part, Path]:
    """Write each part as a dataset into a folder, unless it is whole there; return their folders.

    Raises RecordingError for a recording of which the truth is not known.
    """
    folders: dict[Part, Path] = {}
    for part, labels in parts_of(list(found.by_label)).items():
        folders[part] = folder / part
        if _is_whole(folder / part, labels):
            continue
        frames = 1 if part == "judged" else data.FRAMES_PER_RECORDING
        with tracked(f"reading recordings ({part})") as on_progress:
            labelled = data.read_labelled(
                found.part(part),
                wall=found.open_bench,
                frames=frames,
                on_progress=on_progress,
            )
        data.write_shards(labelled, folder / part)
    return folders


def are_enough(parts: Mapping[Part, Path]) -> bool:
    """Return whether the datasets of recordings hold frames enough to train on."""
    return len(data.open_dataset(parts["adaptation"])) >= MIN_FRAMES


def _is_whole(folder: Path, labels: Sequence[str]) -> bool:
    """Return whether a folder holds a dataset of the objects with these labels, with all its shards
    undamaged.
    """
    try:
        dataset = data.open_dataset(folder)
        for shard in dataset.shards:
            data.check_arrays(shard)
        found = dataset.column("category").tolist()
    except RecordingError:
        return False
    # the seeds number the frames of a part
    return dataset.seeds == set(range(len(dataset))) and set(found) == set(labels)


def fit_to_recordings(
    start: Path,
    parts: Mapping[Part, Path],
    out: Path,
    accelerator: Literal["auto", "cpu", "cuda"],
    watch: training.Watch,
) -> None:
    """Fine-tune the network in `start` on recordings in SI 4's two phases: all layers, then the
    last ones.

    A run that was stopped goes on.
    """
    recipe = training.load_recipe(training.packaged_recipes()[RECIPE])
    if not isinstance(recipe, training.TransferRecipe):
        raise SceneError(f"{RECIPE} is no recipe of a transfer")
    recipe = recipe.of_objects(len(data.open_dataset(parts["adaptation"])))
    # all of them, since those beyond the recipe's number would be whole objects
    recipe = recipe.model_copy(update={"held_out": len(data.open_dataset(parts["validation"]))})
    network, trained = training.transfer_start(recipe, start, partial=False, on_report=data.ignore)
    maps = data.read_maps(recipe, parts["adaptation"], parts["validation"], None, start=trained)
    record = maps.record_run(recipe, out, trained.runs, start, trained=trained)
    fabric = training.open_fabric(recipe, accelerator=accelerator)
    origin = training.digest_of(network, maps.digest)
    run = training.TrainingRun(recipe, out, record, origin, watch=watch)
    training.run_transfer(fabric, run, network, None, maps.training, maps.held_out)
