"""Some steps of a run, spread evenly over it, however long it gets.

What a replay leaves to look at, where it was asked for: its view as a file, still pictures, a video.

A picture of some frames of a run side by side: what the lidar saw, and what came of it.
"""

from collections.abc import Generator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from nlos_cam.reconstruct import CalibratedRig, FrameResult
from nlos_cam.view import MAX_UNCERTAINTY_M, Moment, Viewer


class Samples:
    """Steps spread evenly over a run of unknown length: every n-th is kept, and n doubles as the run goes on."""

    def __init__(self, most: int) -> None:
        self._most, self._stride, self._seen = most, 1, 0
        self._kept: list[FrameResult] = []

    def add(self, step: FrameResult) -> None:
        if self._seen % self._stride == 0:
            self._kept.append(step)
        self._seen += 1
        if len(self._kept) > 2 * self._most:
            self._kept, self._stride = self._kept[::2], self._stride * 2

    def chosen(self) -> list[FrameResult]:
        """At most `most` steps, first and last kept one included."""
        count = min(self._most, len(self._kept))
        return [self._kept[i] for i in np.linspace(0, len(self._kept) - 1, count).round().astype(int)]


VIEW, VIDEO, STILL, STILLS = "view.rrd", "replay.webm", "still-{:06d}.png", "still-*.png"


@dataclass(frozen=True)
class Looks:
    """What was asked for."""

    bench: CalibratedRig
    view: bool = False
    stills: int = 0
    video: bool = False

    @contextmanager
    def into(self, folder: Path) -> Generator["Looking"]:
        """Takes steps while entered; stills, which are of a run's beginning to its end, are drawn when it ends."""
        with ExitStack() as entered:
            viewers: list[Viewer] = []
            if self.view:
                from nlos_cam.view import RrdFile

                saved = RrdFile(folder / VIEW, self.bench.rig, self.bench.measured, keeps_all=True)
                viewers.append(entered.enter_context(saved))
            if self.video:
                from nlos_cam.view import VideoFile

                viewers.append(entered.enter_context(VideoFile(folder / VIDEO, self.bench.rig)))
            looking = Looking(viewers, Samples(self.stills) if self.stills else None)
            yield looking
        if looking.samples:
            self._draw_stills(folder, [moment_of(step) for step in looking.samples.chosen()])
        looking.made = {path.name for path in _looks_in(folder)}

    def _draw_stills(self, folder: Path, moments: list[Moment]) -> None:
        from nlos_cam.view import Still

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

    def add(self, step: FrameResult, celsius: Mapping[str, float]) -> None:
        if self._viewers:
            moment = moment_of(step, celsius)
            for viewer in self._viewers:
                viewer.show(moment)
        if self.samples:
            self.samples.add(step)


def _looks_in(folder: Path) -> list[Path]:
    return [folder / name for name in (VIEW, VIDEO) if (folder / name).exists()] + list(folder.glob(STILLS))


def moment_of(step: FrameResult, celsius: Mapping[str, float] = MappingProxyType({})) -> Moment:
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


USUAL_PERCENT = 95
Images = list[NDArray[np.float32]]


def draw_sheet(path: Path, chosen: list[FrameResult]) -> None:
    """A picture of some frames, one column each with its verdict: lidar depth, infrared, difference, hidden depth.

    And its uncertainty; what there is none of is left out.
    """
    from matplotlib.figure import Figure

    looks = _looks(chosen)
    figure = Figure(figsize=(2.2 * len(chosen) + 1, 6.5 * len(looks) / 3), layout="constrained")
    rows = figure.subplots(len(looks), len(chosen), squeeze=False)
    for axes, (title, (colours, (low, high), images)) in zip(rows, looks.items(), strict=True):
        drawn = [axis.imshow(image, colours, vmin=low, vmax=high) for axis, image in zip(axes, images, strict=True)]
        figure.colorbar(drawn[0], ax=list(axes), label=title)
        for axis in axes:
            axis.set_axis_off()
    for axis, step in zip(rows[0], chosen, strict=True):
        axis.set_title("\n".join([f"frame {step.frame.frame_number}", *([step.verdict] if step.verdict else [])]))
    figure.savefig(path, dpi=80)


def _looks(chosen: list[FrameResult]) -> dict[str, tuple[str, tuple[float, float], Images]]:
    """The rows of the sheet: by title, their colours, limits and images."""
    depths_m, intensities = [step.maps.depth_m for step in chosen], [step.maps.intensity for step in chosen]
    differences_mm = [1e3 * step.difference.depth_m for step in chosen if step.difference]
    hidden_m = [step.reconstruction.depth_m for step in chosen]
    uncertainties_mm = [
        np.where(np.isnan(made.depth_m), np.float32(np.nan), 1e3 * made.uncertainty_m)
        for made in (step.reconstruction for step in chosen)
        if made.uncertainty_m is not None
    ]
    looks = {
        "lidar depth (m)": ("turbo_r", _limits(depths_m), depths_m),
        "infrared (counts)": ("gray", _limits(intensities), intensities),
        "difference (mm)": ("coolwarm", _even_limits(differences_mm), differences_mm),
        "hidden depth (m)": ("inferno_r", _limits(hidden_m), hidden_m),
        "uncertainty (mm)": ("viridis", (0.0, 1e3 * MAX_UNCERTAINTY_M), uncertainties_mm),
    }
    return {title: look for title, look in looks.items() if look[2]}


def _limits(images: Images) -> tuple[float, float]:
    values = _finite(images)
    return (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)


def _even_limits(images: Images) -> tuple[float, float]:
    """About zero, and wide enough for most: an occluder is far from the bare wall."""
    values = _finite(images)
    most = float(np.percentile(np.abs(values), USUAL_PERCENT)) if values.size else 1.0
    return -most, most


def _finite(images: Images) -> NDArray[np.float32]:
    return np.concatenate([np.empty(0, np.float32), *(image[np.isfinite(image)] for image in images)])
