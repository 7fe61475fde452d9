"""Adaptation of the networks to one bench, from its rig to weights with their own verdicts.

The folder of an adaptation holds its plan, the objects, and a folder for each stage. Every step
leaves its result there and is not done again, so that a killed adaptation goes on where it was.
"""

import json
import os
import shutil
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import nlos_models as models
import torch
from nlos_models import training
from nlos_models.errors import CheckpointError

from nlos_cam import dataset as data
from nlos_cam.adapt.inputs import TrainingInputs
from nlos_cam.adapt.job import (
    EARLIER_QUALITY,
    HELD_OUT,
    JUDGED,
    NETWORK,
    OBJECTS,
    OUTLIERS,
    QUALITY,
    WEIGHTS,
    Adaptation,
    is_whole,
    render_set,
    render_training_objects,
    start_network,
)
from nlos_cam.adapt.pace import measure_pace
from nlos_cam.adapt.plan import (
    FIRST_OBJECTS,
    HELD_OUT_OBJECTS,
    PLAN,
    Plan,
    load_plan,
)
from nlos_cam.adapt.recordings import (
    MAX_SIMULATED_LOSS,
    RECORDINGS,
    Part,
    Recordings,
    Transfer,
    are_enough,
    fit_to_recordings,
    iou_of,
    parts_of,
    write_parts,
)
from nlos_cam.adapt.verdicts import train_uncertainty
from nlos_cam.errors import OutputExistsError, SceneError
from nlos_cam.files import (
    CHECKSUMS,
    TEXT_LIMIT,
    atomic_directory,
    checksums_of,
    claim,
    damaged_files,
    read_bounded,
)
from nlos_cam.reconstruct import check_alignable, weights_for
from nlos_cam.render import RENDERING_VERSION

NETWORK_FILE = f"{models.DIRECT}.safetensors"
PACKED = "packed"
BEFORE = "before"
START = "start"
SHIPPED = "shipped"
AFTER = "after"
SIMULATED = "simulated"
GUESS = "mean_object"
PARTS = "parts"
STAGE = "stage-{}"
REPORT = "report"
FIGURES = "figures.json"

Measure = Callable[[Path | None, Path, Path | None], None]
"""Measures weights (None: the shipped ones) on a dataset (None: the bench's test objects): writes
FIGURES and a report into a folder."""


@dataclass(frozen=True)
class AdaptResult:
    """Weights of a bench, with their figures."""

    weights: Path
    plan: Plan
    folders: list[Path]
    """Of the stages; the last one's holds the report of the weights."""
    before: dict[str, Any]
    """Figures of the start weights, aligned, on the 54 test objects on this bench; of a guess where
    the maps are locked differences, which the start weights cannot read."""
    after: dict[str, Any]
    was_there: bool
    """True where the adaptation of these minutes was finished before."""
    transfer: Transfer | None = None
    """Transfer to recordings of known objects; its weights are the result's if it is better."""
    shipped_iou: float | None = None
    """Silhouette IoU of the shipped weights that serve the rig best, where the start weights are
    others."""
    start: str = ""
    """Name or folder of the start weights."""

    @property
    def is_better(self) -> bool:
        """True if the weights serve the bench at least as well as those that it would have without
        them: the start weights, and the shipped ones.

        A few minutes' weights can be worse than aligned ones on a bench close to the start weights'
        rig.
        """
        return self.serves_as_well_as(max(iou_of(self.before), self.shipped_iou or 0.0))

    @property
    def shipped_are_better(self) -> bool:
        """True if the shipped weights that serve the rig best are better than the start weights."""
        return self.shipped_iou is not None and self.shipped_iou > iou_of(self.before)

    def serves_as_well_as(self, other_iou: float) -> bool:
        """Return whether the weights are as good as others with this silhouette IoU on the test
        objects on the bench.

        A fit to the bench's own recordings that helped counts more than simulated objects, up to
        MAX_SIMULATED_LOSS.
        """
        fitted = self.transfer is not None and self.transfer.is_better
        allowed = MAX_SIMULATED_LOSS if fitted else 0.0
        return iou_of(self.after) >= other_iou - allowed


def adapt(
    job: Adaptation,
    minutes: float,
    measure: Measure,
    *,
    tracked: data.Tracked = data.untracked,
    watch: training.Watch | None = None,
    on_message: Callable[[str], None] = print,
) -> AdaptResult:
    """Bring the weights of a bench to `minutes` of work in all, and return them with their figures.

    A call for more minutes goes on from the weights of the earlier ones. Raises FileBusyError where
    another adaptation works in the folder, SceneError where the folder is another bench's,
    KeyboardInterrupt where it was stopped: the same call goes on.
    """
    job.folder.mkdir(parents=True, exist_ok=True)
    with claim(job.folder, inside=True), _all_cores():
        job = _with_first_start(job)
        plan = _plan_for(job, minutes, tracked)
        job = replace(job, spread=plan.spread, sensor=plan.sensor, seed=plan.seed)
        folders = [job.folder / _stage_name(number) for number in range(len(plan.stages))]
        before = {} if job.locked else _figures(measure, job.start_folder, job.folder / BEFORE)
        if job.recordings and not job.locked:
            # Now, since one that cannot be used is an error, before minutes of training.
            parts = _parts_of(job.recordings, folders[-1], tracked)
            if not are_enough(parts):
                on_message(f"note: {job.recordings.folder} holds too few frames: nothing is fitted")
                job = replace(job, recordings=None)
        _train_stages(job, plan, folders, tracked, watch, on_message)
        if job.locked:
            was_there = _stored_figures(folders[-1] / REPORT) is not None
            after = _figures(measure, folders[-1] / NETWORK, folders[-1] / REPORT)
            guess = after["baselines"][GUESS]
            return AdaptResult(folders[-1] / NETWORK, plan, folders, guess, after, was_there)

        transfer = _transfer(job, folders[-1], measure, tracked, watch)
        last = transfer.folder if transfer and transfer.is_better else folders[-1]
        was_there = _stored_figures(last / REPORT) is not None
        train_uncertainty(job, plan, last, tracked, watch)
        after = _figures(measure, last / WEIGHTS, last / REPORT)
        return AdaptResult(
            last / WEIGHTS,
            plan,
            folders,
            before,
            after,
            was_there,
            transfer,
            _shipped_iou(job, plan, measure),
            str(job.start or job.start_folder.name),
        )


def _shipped_iou(job: Adaptation, plan: Plan, measure: Measure) -> float | None:
    """Return the silhouette IoU of the shipped weights that serve the rig best; None where they are
    the start weights, which are measured anyway.
    """
    shipped = weights_for(job.rig)
    checksum = _checksum(shipped / NETWORK_FILE)
    if checksum == plan.start:
        return None
    # of another version of the program they are others
    folder = job.folder / f"{SHIPPED}-{checksum[:12]}"
    return iou_of(_figures(measure, shipped, folder))


def _with_first_start(job: Adaptation) -> Adaptation:
    """Return the adaptation with the shipped weights that its folder's work began from, where none
    were asked for.
    """
    plan = load_plan(job.folder)
    if job.start or plan is None or job.locked or (job.begin_again and _other_than(job, plan)):
        return job
    folders = [models.shipped_folder(name) for name in models.SHIPPED]
    began = [
        folder
        for folder in folders
        if (path := folder / NETWORK_FILE).exists() and _checksum(path) == plan.start
    ]
    return replace(job, began_from=began[0]) if began else job


@contextmanager
def _all_cores() -> Generator[None]:
    """Let torch compute with a thread for each core until the end of the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(os.cpu_count() or 1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _stage_name(number: int) -> str:
    return STAGE.format(number + 1)


def _other_than(job: Adaptation, plan: Plan) -> str:
    """Return why a plan's objects are not those of an adaptation; empty where they are."""
    if plan.rig_checksum != job.rig.checksum:
        return "to another rig: the bench was calibrated again since"
    if plan.rendering_version != RENDERING_VERSION:
        return "of another version of nlos-cam, whose renderer differs"
    return ""


def _plan_for(job: Adaptation, minutes: float, tracked: data.Tracked) -> Plan:
    """Return the folder's plan, extended to `minutes`, or a new one after a measurement of the
    machine.
    """
    plan = load_plan(job.folder)
    other = _other_than(job, plan) if plan else ""
    if other and not job.begin_again:
        raise SceneError(
            f"{job.folder} is an adaptation {other}; give --overwrite to begin again, or another"
            " --out"
        )
    # without a plan, what is there may be another rig's too
    if job.begin_again and (plan is None or other):
        _forget(job.folder)
        plan = None
    if plan is None:
        if not job.locked:  # before minutes of measuring and rendering
            check_alignable(job.rig, models.load_record(job.start_folder))
        with tracked("measuring the pace of this machine") as on_progress:
            pace = measure_pace(job, on_progress)
        plan = Plan(
            rig_checksum=job.rig.checksum,
            spread=job.spread,
            sensor=job.sensor,
            seed=job.seed,
            pace=pace,
            start=_start_checksum(job),
            locked=job.locked,
            rendering_version=RENDERING_VERSION,
        )
    if (plan.locked, plan.sensor.pulse_ns) != (job.locked, job.sensor.pulse_ns):
        raise SceneError(
            f"{job.folder} began with other --frames, --radiometry, --pulse-ns or --material: repeat"
            " these, or choose another --out"
        )
    # the shipped weights of another version are no change of mind, once they are trained on
    has_begun = is_whole(job.folder / _stage_name(0) / NETWORK, models.NETWORK_ONNX)
    if (job.start or not has_begun) and plan.start != _start_checksum(job):
        raise SceneError(
            f"{job.folder} began from other start weights than {job.start or 'the shipped ones'}:"
            " give those as --weights, or delete or rename that folder to begin again"
        )
    plan = plan.extended(minutes)
    plan.save(job.folder)
    return plan


def _forget(folder: Path) -> None:
    """Delete all files of an adaptation. The plan goes last: while it is there, a call that was
    stopped here begins again.
    """
    of_its_rig = (BEFORE, OBJECTS, HELD_OUT, JUDGED, QUALITY, EARLIER_QUALITY, OUTLIERS)
    numbered = (*folder.glob(STAGE.format("*")), *folder.glob(f"{SHIPPED}-*"))
    for made in (*(folder / name for name in of_its_rig), *numbered):
        if made.exists():
            shutil.rmtree(made)
    (folder / PLAN).unlink(missing_ok=True)


def _start_checksum(job: Adaptation) -> str:
    """Return the checksum of the start weights. Raises SceneError for no direct network."""
    folder = job.start_folder
    try:
        return _checksum(folder / NETWORK_FILE)
    except OSError as error:
        raise SceneError(
            f"the start weights {folder} are no direct network: choose others with --weights"
        ) from error


def _checksum(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()


def _transfer(
    job: Adaptation,
    stage: Path,
    measure: Measure,
    tracked: data.Tracked,
    watch: training.Watch | None,
) -> Transfer | None:
    """Fit a stage's network to recordings of known objects, unless that was done; None without
    recordings.
    """
    found = job.recordings
    if found is None:
        return None
    folder = _transfer_folder(found, stage)
    parts = _parts_of(found, stage, tracked)
    network = folder / NETWORK
    if not is_whole(network, models.NETWORK_ONNX):
        fit_to_recordings(
            stage / NETWORK, parts, network, job.accelerator, watch or training.unwatched
        )

    judged = parts["judged"]
    transfer = Transfer(
        folder,
        parts_of(list(found.by_label)),
        recordings=sum(map(len, found.by_label.values())),
        start=_figures(measure, job.start_folder, folder / START, judged),
        before=_figures(measure, stage / NETWORK, folder / BEFORE, judged),
        after=_figures(measure, network, folder / AFTER, judged),
    )
    if not transfer.is_nearer:
        return transfer
    before = _figures(measure, stage / NETWORK, stage / SIMULATED)
    after = _figures(measure, network, folder / SIMULATED)
    return replace(transfer, simulated_loss=iou_of(before) - iou_of(after))


def _transfer_folder(found: Recordings, stage: Path) -> Path:
    """Return the folder of a transfer to recordings, in that of its stage."""
    return stage / f"{RECORDINGS}-{found.digest}"


def _parts_of(found: Recordings, stage: Path, tracked: data.Tracked) -> dict[Part, Path]:
    """Return the datasets of recordings, which are written into their transfer's folder once."""
    return write_parts(found, _transfer_folder(found, stage) / PARTS, tracked)


def _train_stages(
    job: Adaptation,
    plan: Plan,
    folders: Sequence[Path],
    tracked: data.Tracked,
    watch: training.Watch | None,
    on_message: Callable[[str], None],
) -> None:
    """Train the networks of a plan's stages that are not whole yet, each in its folder."""
    for number, stage in enumerate(plan.stages):
        on_message(
            f"stage {number + 1} of {len(plan.stages)}: {stage.objects} objects,"
            f" {stage.samples} samples"
        )
        if not is_whole(folders[number] / NETWORK, models.NETWORK_ONNX):
            _train_network(job, plan, number, tracked, watch)
        # Gigabytes, which are made again from the objects if needed.
        shutil.rmtree(folders[number] / PACKED, ignore_errors=True)


def _train_network(
    job: Adaptation,
    plan: Plan,
    number: int,
    tracked: data.Tracked,
    watch: training.Watch | None,
) -> None:
    """Render a stage's objects, then train its network on from the stage before."""
    stage = plan.stages[number]
    before = job.folder / _stage_name(number - 1) / NETWORK if number else job.start_folder
    recipe = stage.recipe()
    out = job.folder / _stage_name(number) / NETWORK
    start, runs = start_network(recipe, before)
    if job.locked:
        inputs = TrainingInputs.of_locked(job.rig, job.sensor, job.locked)
    else:
        inputs = TrainingInputs.of_maps(job.rig, job.sensor, models.load_record(before))
    held_out = render_set(job, HELD_OUT, data.HELD_OUT_SEED, HELD_OUT_OBJECTS, tracked)
    render_training_objects(job, stage.objects, tracked)

    if inputs.noise:
        objects = data.open_dataset(job.folder / OBJECTS, locked=True)
        first = objects.first(min(FIRST_OBJECTS, stage.objects))
        recipe = inputs.noise.fitted(recipe, start.normal, first)
    options = data.StoreOptions(
        normal=start.normal,
        trained=inputs.trained,
        shards=stage.objects // data.SHARD,
        maps_rig=inputs.maps_rig,
        locked=job.locked is not None,
    )
    with data.open_packed_maps([job.folder / OBJECTS], out.parent / PACKED, options) as source:
        record = training.record_run(
            recipe,
            out,
            inputs.rig,
            runs,
            before,
            bench=inputs.bench,
            bare_wall_counts=inputs.bare_wall_counts,
        )
        fabric = training.open_fabric(recipe, accelerator=job.accelerator)
        origin = training.digest_of(start, source.digest)
        run = training.TrainingRun(recipe, out, record, origin, watch=watch or training.unwatched)
        maps = source.held_out(held_out, HELD_OUT_OBJECTS)
        if inputs.noise:
            maps = inputs.noise.added_to(maps)
        training.run_direct(fabric, run, start, source, maps)


def _figures(
    measure: Measure, weights: Path | None, folder: Path, objects: Path | None = None
) -> dict[str, Any]:
    """Return the figures of weights on a dataset, measured once into a folder; again where they are
    damaged.
    """
    if (stored := _stored_figures(folder)) is not None:
        return stored
    measure(weights, folder, objects)
    return json.loads((folder / FIGURES).read_text(encoding="utf-8"))


def _stored_figures(folder: Path) -> dict[str, Any] | None:
    """Return the figures in a folder; None where there are none, or damaged ones."""
    try:
        found = json.loads(read_bounded(folder / FIGURES, TEXT_LIMIT))
        iou_of(found)
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None
    return found


def install(weights: Path, target: Path) -> None:
    """Copy an adaptation's weights to where the bench keeps its own, in one step.

    Raises OutputExistsError where `target` is a file, CheckpointError where the weights are
    damaged.
    """
    if target.exists() and not target.is_dir():
        raise OutputExistsError(f"{target} is a file, but weights are a folder: move it away")
    if damaged := damaged_files(weights):
        raise CheckpointError(
            f"{weights / damaged[0]} is missing or damaged, so {target} stays: adapt again"
        )
    with atomic_directory(target) as part:
        for name in (*checksums_of(weights), CHECKSUMS):
            shutil.copy2(weights / name, part / name)
