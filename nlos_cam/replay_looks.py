"""What a replay leaves to look at, where it was asked for: its view as a file, still pictures, a video."""

from collections.abc import Generator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from nlos_cam.bench import Bench
from nlos_cam.processing import Step
from nlos_cam.samples import Samples
from nlos_cam.view.viewer import Moment, Viewer

VIEW, VIDEO, STILL, STILLS = "view.rrd", "replay.webm", "still-{:06d}.png", "still-*.png"


@dataclass(frozen=True)
class Looks:
    """What was asked for."""

    bench: Bench
    view: bool = False
    stills: int = 0
    video: bool = False

    @contextmanager
    def into(self, folder: Path) -> Generator["Looking"]:
        """Takes steps while entered; stills, which are of a run's beginning to its end, are drawn when it ends."""
        with ExitStack() as entered:
            viewers: list[Viewer] = []
            if self.view:
                from nlos_cam.view.saved_view import SavedView

                saved = SavedView(folder / VIEW, self.bench.rig, self.bench.measured, keeps_all=True)
                viewers.append(entered.enter_context(saved))
            if self.video:
                from nlos_cam.view.film import Film

                viewers.append(entered.enter_context(Film(folder / VIDEO, self.bench.rig)))
            looking = Looking(viewers, Samples(self.stills) if self.stills else None)
            yield looking
        if looking.samples:
            self._draw_stills(folder, [moment_of(step) for step in looking.samples.chosen()])
        looking.made = {path.name for path in _looks_in(folder)}

    def _draw_stills(self, folder: Path, moments: list[Moment]) -> None:
        from nlos_cam.view.still import Still

        for moment in moments:
            Still(self.bench.rig, moments[0]).save(folder / STILL.format(moment.frame.frame_number), moment)


class Looking:
    """Shows each step to whoever looks."""

    def __init__(self, viewers: list[Viewer], samples: Samples | None) -> None:
        self._viewers, self.samples = viewers, samples
        self.made: set[str] = set()
        """The names of what there is to look at, once all of it is drawn."""

    def forget_others(self, out: Path) -> None:
        """Remove from a folder what an earlier replay left to look at: it is of other frames."""
        for path in _looks_in(out):
            if path.name not in self.made:
                path.unlink()

    def add(self, step: Step, celsius: Mapping[str, float]) -> None:
        if self._viewers:
            moment = moment_of(step, celsius)
            for viewer in self._viewers:
                viewer.show(moment)
        if self.samples:
            self.samples.add(step)


def _looks_in(folder: Path) -> list[Path]:
    return [folder / name for name in (VIEW, VIDEO) if (folder / name).exists()] + list(folder.glob(STILLS))


def moment_of(step: Step, celsius: Mapping[str, float] = MappingProxyType({})) -> Moment:
    """A step of a recording at the time when it was recorded; its latency is what its own stages took."""
    took_s = sum(seconds for name, seconds in step.stages_s.items() if name != "wait")
    return Moment(
        step.frame,
        step.reconstruction,
        published_s=step.frame.timestamp_s,
        latency_s=took_s,
        difference=step.difference,
        warnings=step.warnings,
        verdict=step.verdict,
        check=step.check,
        stages_s=step.stages_s,
        celsius=celsius,
    )
