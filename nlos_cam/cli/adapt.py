"""The command `adapt`: from a calibrated bench to weights of its own."""

from __future__ import annotations

import os
import shlex
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import nlos_calibration as walls
import typer
from nlos_calibration.errors import CalibrationError
from nlos_models import load_record
from nlos_models.errors import CheckpointError

from nlos_cam import adapt as adaptation
from nlos_cam import bench as benches
from nlos_cam import camera as cameras
from nlos_cam import dataset, forecast, objects, reconstruct, render
from nlos_cam import evaluate as evaluation
from nlos_cam.cli import common
from nlos_cam.cli.benches import bench_or_rig, names_folder
from nlos_cam.cli.dataset import Backend, rendering_farm
from nlos_cam.cli.train import watched_run
from nlos_cam.errors import OutputExistsError
from nlos_cam.files import checksums_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from nlos_cam.frames import LidarMaps

PAGE = "adapt.html"
LOCKED_WORK = "locked"
MAX_MINUTES = 6000
MAX_FRAMES = 10**8
WORK = "adapt"
WEIGHTS = "weights"


class _Subject(NamedTuple):
    """A bench, or a rig alone, that weights are made for."""

    name: str
    own: Path | None
    """The bench's folder."""
    folder: Path | None
    """The same, where the bench shall use the weights."""
    rig: walls.Rig
    measured: walls.MeasuredWall | None

    @property
    def option(self) -> str:
        """It as other commands take it."""
        return f"{'--bench' if self.own else '--rig'} {shlex.quote(self.name)}"


def adapt(
    bench: Annotated[
        str,
        typer.Argument(
            metavar="BENCH", help="Bench folder, wall record, rig file or name of a packaged rig."
        ),
    ],
    minutes: Annotated[
        float,
        typer.Option(
            "--minutes",
            min=1,
            max=MAX_MINUTES,
            help="Minutes of work in all; more go on from fewer.",
        ),
    ] = 10.0,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of the work and the weights (default: in the bench)."),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(
            "--weights",
            help="Start weights (default: of direct, wide and any those that serve the bench best).",
        ),
    ] = None,
    ray: Annotated[
        str | None,
        typer.Option("--ray", help="Ray cluster that renders: auto, HOST:PORT, local."),
    ] = None,
    backend: Backend = "cpu",
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, help="Processes that render (default: as many as cores)."),
    ] = None,
    accelerator: Annotated[
        Literal["auto", "cpu", "cuda"],
        typer.Option("--accelerator", help="Device of the training; auto: a GPU if there is one."),
    ] = "auto",
    frames: Annotated[
        int | None,
        typer.Option(
            "--frames",
            min=4,
            max=MAX_FRAMES,
            help="Study: read locked differences (object in less object out) of this many frames.",
        ),
    ] = None,
    radiometry: Annotated[
        Literal["paper", "lambertian"] | None,
        typer.Option("--radiometry", help="With --frames: radiometry (default: lambertian)."),
    ] = None,
    pulse_ns: Annotated[
        float | None,
        typer.Option("--pulse-ns", min=0, max=100, help="With --frames: the pulse (default: 1)."),
    ] = None,
    material: Annotated[
        Literal["matt", "glossy", "retroreflective"] | None,
        typer.Option("--material", help="With --frames: the objects' material (default: matt)."),
    ] = None,
    overwrite: common.Overwrite = False,
    json: common.Json = False,
) -> None:
    """Make weights for one bench: render objects for exactly its rig, then train on with them.

    Killed at any moment, the same command goes on. More --minutes go on from what is there. Labelled
    recordings of known objects in BENCH/recordings are used too.
    """
    # Before torch is loaded, which reads it. Threads that spin while they wait for a busy core hold
    # up the others: beside any other work two of them trained a fifth of what one does.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    own = Path(bench) if names_folder(bench) else None
    folder = own if out is None else None
    rig, measured = bench_or_rig(bench)
    subject = _Subject(bench, own, folder, rig, measured)
    locked = _locked(frames, radiometry, material, given=pulse_ns is not None)
    home = out or folder or Path(f"adapted-{rig.name}")
    work = home / (LOCKED_WORK if locked else WORK)
    if not overwrite and not locked:
        _refuse_others(home / WEIGHTS, work)
    sensor = adaptation.bench_sensor(measured)
    if locked:
        sensor = sensor.model_copy(update={"pulse_ns": 1.0 if pulse_ns is None else pulse_ns})
    optional: dict[str, Any] = {"workers": workers} if workers else {}
    job = adaptation.Adaptation(
        rig,
        adaptation.calibration_spread(measured).within(rig),
        work,
        weights,
        sensor,
        farm=rendering_farm(ray, backend, workers),
        accelerator=accelerator,
        locked=locked,
        recordings=_recordings(own) if own and not locked else None,
        begin_again=overwrite,
        **optional,
    )
    try:
        with common.interrupted_by_signals():  # a library may turn it into another error
            result = adaptation.adapt(
                job,
                minutes,
                _measure_on(job),
                tracked=common.tracked,
                watch=watched_run,
                on_message=common.say,
            )
    except KeyboardInterrupt:
        common.exit_interrupted(f"what was made is kept in {work}; give the same command to go on")
    target = result.weights
    kept = result.is_better if locked else _is_worth_keeping(result, folder)
    if kept and not locked:
        target = _install(result, folder, home / WEIGHTS)
    with common.interrupted_by_signals(f"the weights are in {target}; the page is not written"):
        expected = None if locked else _forecast(rig, folder)
    use = [] if locked else [_use_command(subject, result, target, kept=kept)]
    more = _go_on_command(
        bench,
        min(2 * result.plan.minutes, MAX_MINUTES),
        {
            "--frames": locked and locked.frames,
            "--radiometry": locked and locked.radiometry,
            "--pulse-ns": f"{sensor.pulse_ns:g}" if locked else None,
            "--material": (material or "matt") if locked else None,
            "--out": out,
            "--weights": weights,
            # the pace that the plan was made with is that of these
            "--ray": ray,
            "--backend": backend if backend != "cpu" else None,
            "--workers": workers,
            "--accelerator": accelerator if accelerator != "auto" else None,
        },
    )
    _report(result, target, [*use, more], work / PAGE, expected, kept=kept, as_json=json)


def _use_command(
    subject: _Subject, result: adaptation.AdaptResult, target: Path, *, kept: bool
) -> str:
    """Return the command that uses new weights, or the better ones that they do not replace."""
    pictures = f"nlos-cam live --camera l515 {subject.option}"
    if subject.measured:
        pictures = cameras.pictures_command(subject.measured.record, subject.option)

    if subject.folder and kept:
        return pictures
    if subject.folder and _has_weights_of_another_rig(subject.folder):
        better = _better_weights(result, subject.rig)
        return f"{pictures} --weights {shlex.quote(better)}"
    return f"nlos-cam evaluate {subject.option} --weights {shlex.quote(str(target))}"


def _go_on_command(bench: str, minutes: float, options: Mapping[str, Any]) -> str:
    """Return the command that goes on with more minutes, with the options that have a value."""
    words = [f"nlos-cam adapt {shlex.quote(bench)} --minutes {minutes:g}"]
    words += [
        f"{option} {shlex.quote(str(value))}"
        for option, value in options.items()
        if value is not None
    ]
    return " ".join(words)


def _forecast(rig: walls.Rig, folder: Path | None) -> benches.ForecastRecord:
    """Return the forecast for a rig: that which its bench holds already, else a new one."""
    stored = benches.load_bench(folder, weights=False).forecast if folder else None
    if stored:
        return stored
    return benches.ForecastRecord.of(forecast.forecast(rig, quick=True))


def _recordings(folder: Path) -> adaptation.Recordings | None:
    """Return the labelled recordings in a bench folder, if there are any. Raises RecordingError at
    once for one whose object is not known, which would end the work within some minutes.
    """
    loaded = benches.load_bench(folder, weights=False)
    recordings = folder / adaptation.RECORDINGS
    found = adaptation.find_recordings(recordings, loaded.rig, loaded.for_camera, common.say)
    if found:
        dataset.check_truths(found.by_label, loaded.rig)
    return found


def _measure_on(job: adaptation.Adaptation) -> adaptation.Measure:
    """Return what measures weights on the bench's test objects, which it renders once, or on a
    dataset.
    """

    @cache
    def test_objects() -> evaluation.HeldOutObjects:
        if job.locked:
            return _locked_objects(job, job.locked)
        return evaluation.rendered_objects(job.rig, tracked=common.tracked, sensor=job.sensor)

    def measure(weights: Path | None, folder: Path, objects: Path | None) -> None:
        found = evaluation.evaluate(
            weights, objects or test_objects(), nearest=False, tracked=common.tracked
        )
        evaluation.write_report(folder, found, evaluation.as_figures(found))

    return measure


def _is_worth_keeping(result: adaptation.AdaptResult, bench: Path | None) -> bool:
    """Return whether weights are as good as those that they would replace: as the start weights,
    and as the bench's own.
    """
    in_use = benches.iou_in_use(bench) if bench else None
    return result.is_better and (in_use is None or result.serves_as_well_as(in_use))


def _better_weights(result: adaptation.AdaptResult, rig: walls.Rig) -> str:
    """Return the name or folder of the better ones of start weights and shipped weights."""
    return reconstruct.weights_for(rig).name if result.shipped_are_better else result.start


def _better_words(result: adaptation.AdaptResult) -> str:
    """Return which weights are better than those of an adaptation that is not kept."""
    if result.is_better:
        return "weights in use (more --minutes help)"
    if result.shipped_are_better:
        return f"shipped weights ({result.shipped_iou:.3f}; more --minutes help)"
    return "start weights (more --minutes help)"


def _has_weights_of_another_rig(bench: Path) -> bool:
    """Return whether a bench's own weights are of a rig that it was before."""
    try:
        own = benches.load_bench(bench).weights
    except CalibrationError:  # they are damaged, and named so by other commands
        return False
    return own is not None and benches.iou_in_use(bench) is None


def _install(result: adaptation.AdaptResult, bench: Path | None, target: Path) -> Path:
    """Copy the weights to where they are used, and return that folder."""
    if bench:
        return benches.write_weights(bench, result.weights, result.after["silhouette_iou"]["value"])
    adaptation.install(result.weights, target)
    return target


def _report(
    result: adaptation.AdaptResult,
    target: Path,
    commands: list[str],
    page: Path,
    expected: benches.ForecastRecord | None,
    *,
    kept: bool,
    as_json: bool,
) -> None:
    """Write the page, and print what the minutes brought."""
    rows = _rows(result.before, result.after)
    transfer = result.transfer
    recorded = _rows(transfer.before, transfer.after) if transfer else ()
    tables = adaptation.Tables(rows, recorded, expected)
    adaptation.write_page(result, tables, commands, page, kept=kept)
    _, before, after = rows[0]
    state = "was finished before" if result.was_there else "done"
    outcome = f"; weights in {target}"
    if not kept and not result.plan.locked:
        better = _better_words(result)
        outcome = f", worse than the {better}: not used, the weights in use stay ({target})"
    text = f"{state}: {rows[0][0]} {before} -> {after} on this bench{outcome}; report {page}"
    if expected and expected.hidden_share:
        text += f"; {forecast.hidden_words(expected.hidden_share)}"
    facts: dict[str, Any] = {
        "out": str(target),
        "kept": kept,
        "report": str(page),
        "minutes": result.plan.minutes,
        "objects": result.plan.stages[-1].objects,
        "expected_iou": expected and expected.expected_iou,
        "hidden_share": expected and expected.hidden_share,
        "before": result.before,
        "after": result.after,
        "shipped_iou": result.shipped_iou,
    }
    if transfer:
        text += f"; {adaptation.transfer_words(transfer)}"
        facts["transfer"] = {
            "kept": transfer.is_better,
            "recordings": transfer.recordings,
            "objects": transfer.parts,
            "start": transfer.start,
            "before": transfer.before,
            "after": transfer.after,
        }
    common.finish(facts, as_json=as_json, text=text)


def _locked(
    frames: int | None,
    radiometry: Literal["paper", "lambertian"] | None,
    material: forecast.MaterialName | None,
    *,
    given: bool,
) -> adaptation.Locked | None:
    """Return the locked differences of the options; None without --frames. Raises
    typer.BadParameter.
    """
    if frames is None:
        if given or radiometry or material:
            raise typer.BadParameter(
                "--radiometry, --pulse-ns and --material are of locked differences: give --frames"
            )
        return None
    return adaptation.Locked(
        frames=frames,
        radiometry=radiometry or "lambertian",
        material=forecast.MATERIALS[material or "matt"],
    )


def _locked_objects(
    job: adaptation.Adaptation, locked: adaptation.Locked
) -> evaluation.HeldOutObjects:
    """Return the test objects as locked differences with the noise of their frames."""
    box = objects.object_box(job.rig)
    subjects = objects.benchmark_objects(box)
    pulse_ns = job.sensor.pulse_ns
    surface = locked.material.surface
    differences: list[LidarMaps] = []
    with common.tracked("rendering test objects") as on_progress:
        for subject in subjects:
            scene = render.Scene(
                job.rig, subject.depth_m, surface, locked.radiometry, pulse_ns=pulse_ns
            )
            differences.append(dataset.locked_difference(scene, job.sensor))
            on_progress(len(differences), len(subjects))
    maps = evaluation.as_map_set(differences, evaluation.truth_of(subjects, box))
    noise = adaptation.LockedNoise.of(job.rig, job.sensor, locked)
    return evaluation.HeldOutObjects(
        f"{len(subjects)} test objects, locked differences of {locked.frames} frames",
        [subject.name for subject in subjects],
        [subject.category for subject in subjects],
        noise.added_to(maps),
        dataset.DatasetPlan(job.rig, dataset.TEST_SEED, job.sensor),
        [job.rig] * len(subjects),
    )


def _rows(before: dict[str, Any], after: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the name of each metric with its text before and after."""
    return [
        (
            evaluation.LABELS[metric],
            evaluation.format_interval(before[metric]),
            evaluation.format_interval(after[metric]),
        )
        for metric in evaluation.TARGETS
    ]


def _was_adapted(weights: Path) -> bool:
    """Return whether weights in a bench were written there by an adaptation, also by one whose work
    is gone.
    """
    try:
        return benches.TEST_IOU in load_record(weights).figures
    except CheckpointError:
        return False


def _refuse_others(target: Path, work: Path) -> None:
    """Raise OutputExistsError where the bench has weights that no adaptation in `work` made."""
    if not target.exists() or _was_adapted(target):
        return
    # the network's file: a bench adds its rig to the record
    ours = [
        checksums_of(folder).get(adaptation.NETWORK_FILE)
        for folder in work.glob(f"stage-*/**/{WEIGHTS}")
    ]
    if checksums_of(target).get(adaptation.NETWORK_FILE, "") not in ours:
        raise OutputExistsError(
            f"{target} holds weights that were not made here: move them, or give --overwrite"
        )
