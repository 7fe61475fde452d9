"""Media of a replay: contact sheet of some frames, saved view, still pictures, video."""

import shutil
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from nlos_cam import view as view_package  # loads its heavy parts when they are used
from nlos_cam.live.object_files import ObjectFiles
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import CalibratedRig, FrameResult
from nlos_cam.report import figure_of
from nlos_cam.view import MAX_UNCERTAINTY_M, Moment, Viewer

VIEW = "view.html"
VIDEO = "replay.webm"
STILL = "still-{:06d}.png"
STILLS = "still-*.png"
OBJECT = "object"
"""Folder of the hidden objects' files."""
USUAL_PERCENT = 95
Images = list[NDArray[np.float32]]


class FrameSampler:
    """Sample of results spread evenly over a run of unknown length: every n-th, where n doubles as
    the run goes on.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._stride = 1
        self._count = 0
        self._results: list[FrameResult] = []

    def add(self, result: FrameResult) -> None:
        if self._count % self._stride == 0:
            self._results.append(result)
        self._count += 1
        if len(self._results) > 2 * self._size:
            self._results = self._results[::2]
            self._stride = self._stride * 2

    def results(self) -> list[FrameResult]:
        """Return at most `size` results in order, the first one included."""
        count = min(self._size, len(self._results))
        return [
            self._results[i]
            for i in np.linspace(0, len(self._results) - 1, count).round().astype(int)
        ]


class ReplayMedia:
    """Requested media of one replay: its view as a file, a number of stills, a video, the hidden
    objects' files.

    Give `add` the results while `into` is entered, which opens and closes the files; the stills,
    spread over the whole run, are drawn at its end.
    """

    def __init__(
        self,
        bench: CalibratedRig,
        *,
        view: bool = False,
        stills: int = 0,
        video: bool = False,
        objects: Sequence[str] = (),
        every: int = 1,
    ) -> None:
        self._bench = bench
        self._view = view
        self.video = video
        self._formats = objects
        self._every = every
        self._objects: ObjectFiles | None = None
        self._viewers: list[Viewer] = []
        self._stills = FrameSampler(stills) if stills else None
        self._names: set[str] = set()

    @contextmanager
    def into(self, folder: Path) -> Generator[None]:
        """Write the media into a folder; after an error there are no stills."""
        rig = self._bench.rig
        if self._view:
            self._viewers.append(
                view_package.SessionFile(folder / VIEW, rig, self._bench.measured, keeps_all=True)
            )
        if self.video:
            self._viewers.append(view_package.VideoFile(folder / VIDEO, rig))
        if self._formats:
            self._objects = ObjectFiles(
                folder / OBJECT, object_box(rig), self._formats, self._every
            )
        with view_package.Viewers(self._viewers):
            yield
        if self._stills:
            moments = [moment_of(result) for result in self._stills.results()]
            for moment in moments:
                view_package.Still(rig, moments[0]).save(
                    folder / STILL.format(moment.frame.frame_number), moment
                )
        self._names = {path.name for path in _media_in(folder)}

    def add(self, result: FrameResult, celsius: Mapping[str, float]) -> None:
        if self._viewers:
            moment = moment_of(result, celsius)
            for viewer in self._viewers:
                viewer.show(moment)
        if self._stills:
            self._stills.add(result)
        if self._objects:
            made = result.reconstruction
            self._objects.add(result.frame.frame_number, made.depth_m, made.uncertainty_m)

    def remove_stale(self, out: Path) -> None:
        """Remove the media of an earlier replay from a folder."""
        for path in _media_in(out):
            if path.name not in self._names:
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def _media_in(folder: Path) -> list[Path]:
    return [folder / name for name in (VIEW, VIDEO, OBJECT) if (folder / name).exists()] + list(
        folder.glob(STILLS)
    )


def moment_of(result: FrameResult, celsius: Mapping[str, float] = MappingProxyType({})) -> Moment:
    """Return the moment of a recorded frame, at its timestamp; the latency is the sum of its
    stages.
    """
    return Moment(
        result.frame,
        result.reconstruction,
        published_s=result.frame.timestamp_s,
        latency_s=sum(seconds for name, seconds in result.stages_s.items() if name != "wait"),
        difference=result.difference,
        warnings=result.warnings,
        verdict=result.verdict,
        check=result.check,
        stages_s=result.stages_s,
        celsius=celsius,
    )


def draw_contact_sheet(path: Path, results: list[FrameResult]) -> None:
    """Draw some frames side by side, a column each: lidar depth, infrared, difference, hidden
    depth, uncertainty.

    The title of a column is its verdict; rows without any image are left out.
    """
    rows = _rows(results)
    figure = figure_of(2.2 * len(results) + 1, 6.5 * len(rows) / 3)
    grid = figure.subplots(len(rows), len(results), squeeze=False)
    for axes, (title, (colormap, (low, high), images)) in zip(grid, rows.items(), strict=True):
        drawn = [
            axis.imshow(image, colormap, vmin=low, vmax=high)
            for axis, image in zip(axes, images, strict=True)
        ]
        figure.colorbar(drawn[0], ax=list(axes), label=title)
        for axis in axes:
            axis.set_axis_off()
    for axis, result in zip(grid[0], results, strict=True):
        verdict = [result.verdict] if result.verdict else []
        axis.set_title("\n".join([f"frame {result.frame.frame_number}", *verdict]))
    figure.savefig(path, dpi=80)


def _rows(results: list[FrameResult]) -> dict[str, tuple[str, tuple[float, float], Images]]:
    """Return color map, limits and images of each row of the sheet, by title."""
    depths_m = [each.maps.depth_m for each in results]
    intensities = [each.maps.intensity for each in results]
    differences_mm = [1e3 * each.difference.depth_m for each in results if each.difference]
    reconstructions = [each.reconstruction for each in results]
    hidden_m = [each.depth_m for each in reconstructions]
    uncertainties_mm = [
        np.where(np.isnan(each.depth_m), np.float32(np.nan), 1e3 * each.uncertainty_m)
        for each in reconstructions
        if each.uncertainty_m is not None
    ]
    rows = {
        "lidar depth (m)": ("turbo_r", _limits(depths_m), depths_m),
        "infrared (counts)": ("gray", _limits(intensities), intensities),
        "difference (mm)": ("coolwarm", _symmetric_limits(differences_mm), differences_mm),
        "hidden depth (m)": ("inferno_r", _limits(hidden_m), hidden_m),
        "uncertainty (mm)": ("viridis", (0.0, 1e3 * MAX_UNCERTAINTY_M), uncertainties_mm),
    }
    return {title: row for title, row in rows.items() if row[2]}


def _limits(images: Images) -> tuple[float, float]:
    values = _finite(images)
    return (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)


def _symmetric_limits(images: Images) -> tuple[float, float]:
    """Return limits about zero that contain USUAL_PERCENT of the values: an occluder is far from
    the bare wall.
    """
    values = _finite(images)
    limit = float(np.percentile(np.abs(values), USUAL_PERCENT)) if values.size else 1.0
    return -limit, limit


def _finite(images: Images) -> NDArray[np.float32]:
    return np.concatenate(
        [np.empty(0, np.float32), *(image[np.isfinite(image)] for image in images)]
    )
