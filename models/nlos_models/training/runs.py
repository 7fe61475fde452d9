"""Training runs: starting weights, output folder and record, and one function per task that trains
and saves.
"""

import os
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from lightning_fabric import Fabric

from nlos_cam.files import OutputExistsError, claim, damaged_files, program_name
from nlos_models.arrays import Float16
from nlos_models.checkpoint import load_network, load_pipeline
from nlos_models.direct import DirectNetwork
from nlos_models.errors import CheckpointError, TrainingError
from nlos_models.export import export_folder
from nlos_models.pipeline import RemappingNetwork, new_vae
from nlos_models.quality import UNCERTAINTY_FILES, QualityRecord
from nlos_models.records import (
    DIRECT,
    PAPER,
    RECORD,
    SIMULATION_ONLY,
    UNCERTAINTY_RECORD,
    WATCHED,
    CheckpointRecord,
    UncertaintyRecord,
    checksum_of_watched,
    load_record,
    weights_folder,
)
from nlos_models.training import checkpoints
from nlos_models.training.data import MapSet, MapSource
from nlos_models.training.direct import NormalSource, train_direct, transfer_direct
from nlos_models.training.loop import Running
from nlos_models.training.quality import OnFit, QualitySet, fit_quality, write_quality
from nlos_models.training.recipe import (
    CompressorRecipe,
    DirectRecipe,
    MapRecipe,
    Recipe,
    TransferRecipe,
    UncertaintyRecipe,
    VaeRecipe,
    maps_of,
)
from nlos_models.training.run_files import Scores, has_state, read_finished, write_finished
from nlos_models.training.tasks import (
    PHASES,
    Start,
    figures_of,
    run,
    train_compressor,
    train_transfer,
    train_vae,
)
from nlos_models.training.uncertainty import UncertaintySet, calibrate, train_uncertainty
from nlos_models.uncertainty_network import save_uncertainty_network
from nlos_models.vae import Encoder, ResVae

FITTED = "fitted"
"""Folder, in a transfer's output, of new weights that are worse than those that it started from."""


@contextmanager
def unwatched(running: Running, recipe: Recipe, name: str) -> Generator[Running]:
    """Run to the end without progress or interruption."""
    del recipe, name
    yield running


Watch = Callable[[Running, Recipe, str], AbstractContextManager[Running]]
"""Adds progress and interruption to a run, given its name; called in each process, so it has to be
picklable.
"""


R = TypeVar("R", bound=Recipe)


@dataclass(frozen=True)
class TrainingRun(Generic[R]):
    """Parameters of a run besides its data and its starting weights."""

    recipe: R
    out: Path
    record: CheckpointRecord
    """Record of the weights that the run makes, without figures."""
    origin: str = ""
    """`digest_of` starting weights and data; see `Running`."""
    tensorboard: bool = False
    compiled: bool = False
    watch: Watch = unwatched
    earlier_origin: str | None = None
    """See `Running`."""

    def watched(self, fabric: Fabric, name: str) -> AbstractContextManager[Running]:
        """Open progress and interruption for a run of this name."""
        running = Running(
            fabric,
            tensorboard=self.tensorboard,
            compiled=self.compiled,
            origin=self.origin,
            earlier_origin=self.earlier_origin,
        )
        return self.watch(running, self.recipe, name)

    @contextmanager
    def claimed(self, fabric: Fabric) -> Generator[None]:
        """Hold `out` until the run's weights are saved and its states removed: a second run that
        began between the two would train again. Raises FileBusyError where another run has it.
        """
        if not fabric.is_global_zero:  # one process writes
            yield
            return
        self.out.mkdir(parents=True, exist_ok=True)
        with claim(self.out, inside=True):
            yield

    def finished(self) -> Scores | None:
        """Return the figures of this run where it has ended already, with its weights in `out`.

        Raises RecipeError where the run that ended there had another origin, CheckpointError where
        its weights are missing or damaged.
        """
        if not (self.out / RECORD).exists():
            return None
        figures = read_finished(self.out, self.origin, self.earlier_origin)
        # The states are gone by now: a run whose weights were lost cannot go on from them, and its
        # figures alone would pass for a success.
        if figures is not None:
            for folder in (self.out, self.out / FITTED):
                if damaged := damaged_files(folder):
                    raise CheckpointError(
                        f"{folder / damaged[0]} is missing or damaged: delete {self.out} to train"
                        " again"
                    )
        return figures

    def finish(self, figures: Scores, parts: Iterable[str] = ()) -> None:
        """Remove the states of a run whose weights are saved, and keep its figures."""
        write_finished(self.out, self.origin, figures, parts)

    def with_figures(self, figures: Scores) -> CheckpointRecord:
        """Return the record with the held-out figures."""
        return self.record.model_copy(update={"figures": figures})


def record_run(
    recipe: Recipe,
    out: Path,
    rig: tuple[str, str],
    before: list[Recipe],
    *starts: Path | None,
    bench: Mapping[str, Any] | None = None,
    bare_wall_counts: float | None = None,
) -> CheckpointRecord:
    """Return the record of the weights that a recipe makes after the runs `before`; `rig` is its
    (name, checksum).

    `bench` are the fields of that rig where it is not packaged, which another machine does not know
    by its name. `bare_wall_counts` are those of the brightest bare wall in training, where they are
    not the simulated sensor's.

    Raises OutputExistsError where the run would write over a file, over a folder that it starts
    from, or over other weights.
    """
    # Before an hour of training, not after it: the same checks as at the end.
    record = CheckpointRecord.of([*before, recipe], rig, maps_of(recipe))
    if bench is not None:
        record = record.model_copy(update={"rig": dict(bench)})
    record = record.model_copy(update={"bare_wall_counts": bare_wall_counts})
    if os.path.lexists(out) and not out.is_dir():
        raise OutputExistsError(
            f"{out} is a file, but --out must be a directory: choose another --out"
        )
    if out.resolve() in {start.resolve() for start in starts if start}:
        raise OutputExistsError(
            f"{out} holds the weights that this run starts from: choose another --out"
        )
    # A transfer that made things worse has its own weights there, and the earlier ones in `out`.
    own = out / FITTED if (out / FITTED / RECORD).exists() else out
    if (own / RECORD).exists():
        earlier = load_record(own).model_copy(update={"figures": {}, "program": ""})
        # Records of before 2026-11-28 name neither the rig of a file nor the light of training.
        unnamed = {
            name: None for name in ("rig", "bare_wall_counts") if getattr(earlier, name) is None
        }
        if earlier != record.model_copy(update=unnamed):
            raise OutputExistsError(f"{out} holds weights from another run: choose another --out")
    return record.model_copy(update={"program": program_name()})


def record_uncertainty_run(
    recipe: UncertaintyRecipe, out: Path, watched: Path, kinds: list[str]
) -> UncertaintyRecord:
    """Return the record of an uncertainty network that watches the weights in a folder and learns
    kinds of outliers.

    Raises OutputExistsError where `out` is that folder, or holds other weights, or an uncertainty
    network that is not of a run which was stopped while it saved.
    """
    same = out.resolve() == watched.resolve()
    made = (out / UNCERTAINTY_RECORD).exists() and not has_state(out)
    if same or made or _holds_other_weights(out, watched):
        raise OutputExistsError(f"{out} holds weights already: choose another --out")
    return UncertaintyRecord(
        watches=checksum_of_watched(watched), recipe=recipe, program=program_name(), learnt=kinds
    )


def _holds_other_weights(out: Path, watched: Path) -> bool:
    """Return whether a folder holds a record or weights that are not copies of those of another."""
    # A run that was stopped while it saved leaves copies: it may be repeated.
    for name in (RECORD, f"{DIRECT}.safetensors", *WATCHED):
        own = out / name
        if not own.exists():
            continue
        theirs = watched / name
        if not theirs.exists() or own.read_bytes() != theirs.read_bytes():
            return True
    return False


def run_vae(
    fabric: Fabric,
    training: TrainingRun[VaeRecipe],
    start: ResVae | None,
    images: Float16,
    held_out: Float16,
) -> Scores:
    """Train a VAE and save it; return its held-out figures."""
    with training.claimed(fabric):
        if (ended := training.finished()) is not None:
            return ended
        with training.watched(fabric, "VAE") as running:
            vae, figures = train_vae(
                training.recipe, images, held_out, training.out, running, start
            )
        if fabric.is_global_zero:
            checkpoints.save_vae(training.out, vae, training.with_figures(figures))
            training.finish(figures)
        return figures


def run_compressor(
    fabric: Fabric,
    training: TrainingRun[CompressorRecipe],
    start: Start,
    maps: MapSource,
    held_out: MapSet,
) -> Scores:
    """Train a compressor and save it with its decoder; return its held-out figures."""
    with training.claimed(fabric):
        if (ended := training.finished()) is not None:
            return ended
        recipe = training.recipe
        with training.watched(fabric, "compressor") as running:
            pipeline, figures = train_compressor(
                recipe, start, maps, held_out, training.out, running
            )
        if fabric.is_global_zero:
            encoder = start.vae.encoder if start.vae and recipe.steps != "one" else None
            checkpoints.save_pipeline(
                training.out, pipeline, training.with_figures(figures), encoder
            )
            _export(training)
            training.finish(figures)
        return figures


def run_direct(
    fabric: Fabric,
    training: TrainingRun[DirectRecipe],
    start: DirectNetwork | None,
    source: NormalSource,
    held_out: MapSet,
) -> Scores:
    """Train a direct network and save it; return its held-out figures."""
    with training.claimed(fabric):
        if (ended := training.finished()) is not None:
            return ended
        with training.watched(fabric, "direct network") as running:
            network, figures = train_direct(
                training.recipe, source, held_out, training.out, running, start
            )
        checkpoints.save_direct(training.out, network, training.with_figures(figures))
        _export(training)
        training.finish(figures)
        return figures


def run_transfer(
    fabric: Fabric,
    training: TrainingRun[TransferRecipe],
    network: RemappingNetwork | DirectNetwork,
    encoder: Encoder | None,
    maps: MapSource,
    held_out: MapSet,
    start: Path | None = None,
) -> dict[str, Scores]:
    """Fine-tune weights on recordings and save them; return their held-out figures before and
    after.

    Where the held-out loss has not fallen, `out` gets a copy of the weights in the folder `start`
    (None: of no whole weights, and the new ones are kept), and the new ones lie in its FITTED.
    """
    # The same held-out maps before and after, so that their difference is the transfer's.
    before = figures_of(run(network.to(fabric.device).eval(), held_out), held_out.image)
    with training.claimed(fabric):
        if (ended := training.finished()) is not None:
            return {"before": before, "after": ended}
        with training.watched(fabric, "transfer") as running:
            if isinstance(network, DirectNetwork):
                network, after = transfer_direct(
                    training.recipe, network, maps, held_out, training.out, running
                )
            else:
                network, after = train_transfer(
                    training.recipe, network, encoder, maps, held_out, training.out, running
                )
        if fabric.is_global_zero:
            keeps_start = start is not None and not is_better(after, before)
            folder = training.out / FITTED if keeps_start else training.out
            if isinstance(network, DirectNetwork):
                checkpoints.save_direct(folder, network, training.with_figures(after))
            else:
                checkpoints.save_pipeline(folder, network, training.with_figures(after), encoder)
            _export(training, folder)
            if start and keeps_start:
                checkpoints.copy_weights(start, training.out)
            training.finish(after, PHASES)
        return {"before": before, "after": after}


def is_better(after: Scores, before: Scores) -> bool:
    """Return True if the held-out loss, which also selects the epoch, has fallen."""
    return after["held_out_loss"] < before["held_out_loss"]


def run_uncertainty(
    fabric: Fabric,
    training: TrainingRun[UncertaintyRecipe],
    about: UncertaintyRecord,
    watched: Path,
    samples: UncertaintySet,
    held_out: UncertaintySet,
) -> Scores:
    """Train, calibrate and save an uncertainty network beside the weights it watches; return its
    held-out figures.
    """
    with training.claimed(fabric):
        with training.watched(fabric, "uncertainty network") as running:
            network, figures = train_uncertainty(
                training.recipe, samples, held_out, training.out, running
            )
        # On held-out maps: a network is surer of those that it was trained on.
        fitted = calibrate(network, held_out)
        if fabric.is_global_zero:
            record = about.model_copy(update={**asdict(fitted), "figures": figures})
            save_uncertainty_network(training.out, network, record, watched)
            _export(training)
            training.finish(figures)
        return {**figures, "error_scale": fitted.error_scale, "outside_above": fitted.outside_above}


def run_quality(weights: Path, samples: QualitySet, on_fit: OnFit) -> QualityRecord:
    """Fit the quality model of the uncertainty network in a folder, and write it beside that
    network; `on_fit` as for `fit_quality`.
    """
    record = fit_quality(samples, checksum_of_watched(weights, UNCERTAINTY_FILES), on_fit)
    write_quality(weights, record)
    return record


def _export(training: TrainingRun[Any], folder: Path | None = None) -> None:
    """Write the graphs for inference without torch beside new weights, by default in `out`; those
    of color stay in torch.
    """
    if not training.record.color:
        export_folder(folder or training.out)


def vae_start(
    recipe: VaeRecipe | CompressorRecipe, weights: Path | None
) -> tuple[ResVae, list[Recipe]]:
    """Load the VAE that a recipe starts from (default: the paper's) and the runs that made it."""
    _check_same_color(recipe, weights)
    folder = weights_folder(weights, PAPER)
    if recipe.start == "decoder":
        torch.manual_seed(recipe.seed)
        # Target latents from the encoder, decoder from the pipeline, which has trained on.
        vae = new_vae(color=recipe.colour)
        pipeline, record = load_pipeline(folder)
        # A new encoder for a decoder that is given: the shipped weights come without theirs.
        vae.decoder = pipeline.decoder
    else:
        vae, record = checkpoints.load_vae(folder)
    return vae, record.vae_runs


def compressor_start(
    recipe: CompressorRecipe, vae_folder: Path | None, weights: Path | None
) -> tuple[Start, list[Recipe]]:
    """Load the networks that the recipe's steps start from and the runs that made them; none for
    steps = "one".
    """
    if recipe.steps == "one":
        return Start(), []
    if recipe.steps == "two":
        vae, vae_runs = vae_start(recipe, vae_folder)
        if recipe.start == "scratch":
            return Start(vae), vae_runs
        pipeline, runs = _pipeline_start(recipe, weights)
        return Start(vae, pipeline), [*(run for run in runs if run not in vae_runs), *vae_runs]
    pipeline, runs = _pipeline_start(recipe, weights)
    if not (encoder := checkpoints.load_encoder(weights)):
        if recipe.latent_weight:
            raise TrainingError(
                f"{weights_folder(weights, PAPER)} has no encoder to aim at: set latent_weight = 0"
                " in the recipe"
            )
        return Start(None, pipeline), runs
    vae = new_vae(color=recipe.colour)
    vae.encoder = encoder
    vae.decoder = pipeline.decoder
    return Start(vae, pipeline), runs


def direct_start(
    recipe: DirectRecipe, weights: Path | None
) -> tuple[DirectNetwork | None, list[Recipe]]:
    """Load the direct network that a recipe goes on from (default: the shipped one) and the runs
    that made it.

    Raises TrainingError for weights of another network, or one that the recipe's cannot hold.
    """
    if recipe.start == "scratch":
        return None, []
    folder = weights_folder(weights)
    network, record = load_network(folder)
    if not isinstance(network, DirectNetwork):
        raise TrainingError(f"{folder} does not hold a direct network: choose other --weights")
    _check_same_color(recipe, folder)
    size = network.size
    wanted = recipe.direct
    # Widths must agree, depths may grow: new blocks start as identities.
    grown = size.model_copy(update={"blocks": wanted.blocks, "mixers": wanted.mixers})
    if grown != wanted or wanted.blocks < size.blocks or wanted.mixers < size.mixers:
        raise TrainingError(
            f"{folder} holds a network that is not a part of the recipe's: {size} against {wanted}"
        )
    return network, record.runs


def transfer_weights(recipe: TransferRecipe, weights: Path | None) -> Path:
    """Return the folder of the weights that a transfer starts from: by default the paper's where
    the recipe aims at a latent, else the direct ones.
    """
    return weights_folder(weights, PAPER if recipe.latent_weight else DIRECT)


def transfer_start(
    recipe: TransferRecipe, weights: Path | None, *, partial: bool, on_report: Callable[[str], None]
) -> tuple[RemappingNetwork | DirectNetwork, CheckpointRecord]:
    """Load the networks in `transfer_weights`, and their record.

    If `partial`, only matching layers of the compressor are loaded, `on_report` is called with a
    summary of them, and the others are initialised from the recipe's seed.
    """
    folder = transfer_weights(recipe, weights)
    _check_fits(recipe, folder)
    if not partial:
        return load_network(folder)
    torch.manual_seed(recipe.seed)
    pipeline, record, report = checkpoints.load_pipeline_partly(folder)
    on_report(f"compressor: {report}")
    return pipeline, record


def _pipeline_start(
    recipe: CompressorRecipe, weights: Path | None
) -> tuple[RemappingNetwork, list[Recipe]]:
    _check_fits(recipe, weights)
    pipeline, record = load_pipeline(weights)
    return pipeline, record.runs


def _check_fits(recipe: MapRecipe, folder: Path | None) -> None:
    """Raise TrainingError unless weights and recipe agree in color, maps, latent and the
    compressor's width.
    """
    record = _check_same_color(recipe, folder)
    wrong = ""
    if record.input != recipe.maps:
        wrong = f"weights expect {record.input} but the recipe uses {recipe.maps}"
    elif isinstance(recipe, TransferRecipe) and recipe.latent_weight and record.direct_recipe:
        wrong = "weights are a direct network, without the latent that the recipe aims at"
    elif isinstance(recipe, CompressorRecipe) and record.width != recipe.width:
        wrong = f"weights have width {record.width:g} but the recipe asks for {recipe.width:g}"
    if wrong:
        raise TrainingError(f"{wrong}: choose a matching pair of --weights and --recipe")


def _check_same_color(recipe: Recipe, folder: Path | None) -> CheckpointRecord:
    """Return the weights' record; raise TrainingError unless weights and recipe are both of depth
    or both in color.
    """
    record = load_record(weights_folder(folder, PAPER))
    if record.color != recipe.colour:
        holds, wants = (
            f"color ({SIMULATION_ONLY})" if color else "depth"
            for color in (record.color, recipe.colour)
        )
        raise TrainingError(
            f"{weights_folder(folder, PAPER)} holds weights for {holds} but the recipe is for"
            f" {wants}: name others with --vae or --weights"
        )
    return record
