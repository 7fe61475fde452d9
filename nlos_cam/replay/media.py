"""Media of a replay: contact sheet of some frames, saved view, still pictures, video."""

import logging
import re
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from nlos_calibration.arrays import Float32

from nlos_cam import view as views
from nlos_cam.errors import OutputExistsError
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import CalibratedRig, FrameResult
from nlos_cam.recording import FRAME_STEM, FrameNames
from nlos_cam.replay.object_files import OBJECT_FILE, ObjectFiles
from nlos_cam.report import figure_of

log = logging.getLogger(__name__)

VIEW = "view.html"
VIDEO = "replay.webm"
STILL = "still-{}.png"
STILLS = re.compile(rf"still-{FRAME_STEM}\.png")
OBJECT = "object"
"""Folder of the hidden objects' files."""
USUAL_PERCENT = 95
Images = list[Float32]


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
            self._stride *= 2

    def results(self) -> list[FrameResult]:
        """Return at most `size` results in order, the first one included."""
        count = min(self._size, len(self._results))
        spread = np.linspace(0, len(self._results) - 1, count).round().astype(int)
        return [self._results[index] for index in spread]


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
        self._viewers: list[views.Viewer] = []
        self._stills = FrameSampler(stills) if stills else None
        self._names: set[Path] = set()
        """Files of this replay, relative to its folder."""

    @contextmanager
    def into(self, folder: Path) -> Generator[None]:
        """Write the media into a folder; after an error there are no stills."""
        rig = self._bench.rig
        session = None
        if self._view:
            session = views.SessionFile(folder / VIEW, rig, self._bench.measured, keeps_all=True)
            self._viewers.append(session)
        if self.video:
            self._viewers.append(views.VideoFile(folder / VIDEO))
        if self._formats:
            self._objects = ObjectFiles(
                folder / OBJECT, object_box(rig), self._formats, self._every
            )
        with views.Viewers(self._viewers):
            yield
        if session and session.problem:
            log.warning("%s", session.problem)
        if self._stills:
            moments = [views.Moment.recorded(result) for result in self._stills.results()]
            names = FrameNames()
            for moment in moments:
                path = folder / STILL.format(names.stem(moment.result.frame_number))
                views.Still(moments[0]).save(path, moment)
        self._names = {path.relative_to(folder) for path in _media_in(folder)}

    def add(self, result: FrameResult, celsius: Mapping[str, float]) -> None:
        if self._viewers:
            moment = views.Moment.recorded(result, celsius)
            for viewer in self._viewers:
                viewer.show(moment)
        if self._stills:
            self._stills.add(result)
        if self._objects:
            self._objects.add(result.frame_number, result.depth_m, result.uncertainty_m)

    def check_folder(self, out: Path, *, replayed: bool) -> None:
        """Raise OutputExistsError where the hidden objects' folder, which is replaced as a whole,
        holds what no replay wrote.
        """
        old = out / OBJECT
        if not self._formats or not old.is_dir():
            return
        for path in sorted(old.iterdir()):
            if not (replayed and OBJECT_FILE.fullmatch(path.name)):
                raise OutputExistsError(
                    f"{path} is not of a replay, and {old} would be replaced: move it, or choose"
                    " another --out"
                )

    def remove_stale(self, out: Path) -> None:
        """Remove the media of an earlier replay from a folder."""
        for path in _media_in(out):
            if path.relative_to(out) not in self._names:
                path.unlink()
        with suppress(OSError):  # there is none, or it holds something else
            (out / OBJECT).rmdir()


def _media_in(folder: Path) -> list[Path]:
    """Return the files in a folder that have the names of media."""
    stills = [path for path in folder.iterdir() if STILLS.fullmatch(path.name)]
    objects = [path for path in (folder / OBJECT).glob("*") if OBJECT_FILE.fullmatch(path.name)]
    named = [folder / VIEW, folder / VIDEO, *stills, *objects]
    return [path for path in named if path.is_file()]


class Row(NamedTuple):
    """Images of one kind, an image per frame, drawn at one scale."""

    title: str
    color_map: str
    limits: tuple[float, float]
    images: Images


def draw_contact_sheet(path: Path, results: list[FrameResult]) -> None:
    """Draw some frames side by side, a column each: lidar depth, infrared, difference, hidden
    depth, uncertainty.

    The title of a column is its verdict; rows without any image are left out.
    """
    rows = [row for row in _rows(results) if row.images]
    figure = figure_of(2.2 * len(results) + 1, 6.5 * len(rows) / 3)
    grid = figure.subplots(len(rows), len(results), squeeze=False)
    for axes, row in zip(grid, rows, strict=True):
        low, high = row.limits
        drawn = [
            axis.imshow(image, row.color_map, vmin=low, vmax=high)
            for axis, image in zip(axes, row.images, strict=True)
        ]
        figure.colorbar(drawn[0], ax=list(axes), label=row.title)
        for axis in axes:
            axis.set_axis_off()

    for axis, result in zip(grid[0], results, strict=True):
        title = f"frame {result.frame_number}"
        axis.set_title(f"{title}\n{result.verdict}" if result.verdict else title)
    figure.savefig(path, dpi=80)


def _rows(results: list[FrameResult]) -> list[Row]:
    lidar_cm = [100 * each.maps.depth_m for each in results]
    counts = [each.maps.intensity for each in results]
    differences_mm = [1e3 * each.difference.depth_m for each in results if each.difference]
    hidden_cm = [100 * each.depth_m for each in results]
    uncertainties_mm = [
        np.where(np.isnan(each.depth_m), np.float32(np.nan), 1e3 * each.uncertainty_m)
        for each in results
        if each.uncertainty_m is not None
    ]
    return [
        Row("lidar depth (cm)", "inferno_r", _limits(lidar_cm), lidar_cm),
        Row("infrared (counts)", "gray", _limits(counts), counts),
        Row("difference (mm)", "coolwarm", _symmetric_limits(differences_mm), differences_mm),
        Row("hidden depth (cm)", "inferno_r", _limits(hidden_cm), hidden_cm),
        Row("uncertainty (mm)", "viridis", (0.0, 1e3 * views.MAX_UNCERTAINTY_M), uncertainties_mm),
    ]


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


def _finite(images: Images) -> Float32:
    return np.concatenate(
        [np.empty(0, np.float32), *(image[np.isfinite(image)] for image in images)]
    )
