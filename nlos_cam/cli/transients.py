"""Options and output of `render --transient`: light over path length at points of the wall, in
tal's HDF5.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import nlos_calibration as walls
import typer

from nlos_cam import render as renderer
from nlos_cam import transients
from nlos_cam.cli.common import finish, output_path, tracked
from nlos_cam.errors import SceneError

if TYPE_CHECKING:
    from collections.abc import Sequence

TransientFile = Annotated[
    Path | None,
    typer.Option(
        "--transient",
        metavar="FILE.hdf5",
        help="Write the transient in tal's HDF5 instead of the maps; the options below are for it.",
    ),
]
CaptureName = Annotated[
    Literal["lidar", "confocal", "single", "exhaustive"],
    typer.Option(
        "--capture",
        help=(
            "lidar: scanned laser, one wide detector. confocal: the detector looks at the lit"
            " point. single: one laser point, scanned detector. exhaustive: all with all."
        ),
    ),
]
WallCells = Annotated[
    int | None,
    typer.Option(
        "--wall-cells",
        min=1,
        max=128,
        help="Points of the wall along each axis (default: 32; exhaustive: 8).",
    ),
]
WallExtent = Annotated[
    str | None,
    typer.Option(
        "--wall-extent",
        metavar="X0,X1,Y0,Y1",
        help="Part of the wall to scan, in meters (default: the rig's relay wall).",
    ),
]
LaserPoint = Annotated[
    str | None,
    typer.Option(
        "--laser", metavar="X,Y", help="Laser point of `single` in meters (default: the middle)."
    ),
]
BinMm = Annotated[
    float | None,
    typer.Option(
        "--bin-mm", help="Path length of a bin in mm; 10 mm are 33 ps (default: the device's)."
    ),
]
StartM = Annotated[
    float, typer.Option("--start-m", help="Path length in meters at which the first bin begins.")
]
Bins = Annotated[
    int | None, typer.Option("--bins", help="Number of bins (default: up to the longest path).")
]
WallToWall = Annotated[
    bool,
    typer.Option(
        "--wall-to-wall", help="Leave the first and the last leg, of the lidar, out of the paths."
    ),
]
Photons = Annotated[
    float | None,
    typer.Option(
        "--photons",
        help="Count photons with noise: this many, above 0, in the brightest histogram.",
    ),
]
Background = Annotated[
    float, typer.Option("--background", help="Further photons per bin, with --photons.")
]
NoiseSeed = Annotated[int, typer.Option("--noise-seed", min=0, help="Seed of the photons' noise.")]


class CaptureOptions(NamedTuple):
    """Options of the command line that only a transient takes, by their names."""

    capture: transients.CaptureKind = "lidar"
    wall_cells: int | None = None
    wall_extent: str | None = None
    laser: str | None = None
    bin_mm: float | None = None
    start_m: float = 0.0
    bins: int | None = None
    wall_to_wall: bool = False
    photons: float | None = None
    background: float = 0.0
    noise_seed: int = 0

    def check_backend(self, backend: str) -> None:
        """Raise typer.BadParameter for a backend that the capture would ignore."""
        if backend != "cpu" and self.capture != "lidar":
            raise typer.BadParameter(
                f"--backend {backend} renders the capture lidar alone, {self.capture} is summed"
                " path by path on the CPU: drop it"
            )

    def refuse_unused(self) -> None:
        """Raise typer.BadParameter if any option is given, as no transient is asked for."""
        given = [
            f"--{name.replace('_', '-')}"
            for name, default in self._field_defaults.items()
            if getattr(self, name) != default
        ]
        if given:
            raise typer.BadParameter(
                f"{', '.join(given)}: no transient is written: drop this, or add --transient"
                " FILE.hdf5"
            )

    def to_capture(self) -> transients.Capture:
        """Return the capture that the options describe.

        Raises typer.BadParameter or SceneError with the option's value and its range.
        """
        if self.photons is None and (self.background or self.noise_seed):
            option = "--background" if self.background else "--noise-seed"
            raise typer.BadParameter(f"{option} is of counted photons: give --photons too")
        point = _numbers("--laser", self.laser, 2)
        noise = None
        if self.photons is not None:
            if not self.photons > 0:
                raise typer.BadParameter(f"--photons must be above 0, got {self.photons:g}")
            noise = transients.Noise(self.photons, self.background, self.noise_seed)
        return transients.Capture(
            self.capture,
            self.wall_cells,
            _extent(self.wall_extent),
            (point[0], point[1]) if point else None,
            None if self.bin_mm is None else self.bin_mm / 1e3,
            self.start_m,
            self.bins,
            first_and_last=not self.wall_to_wall,
            noise=noise,
        )


def _extent(text: str | None) -> walls.Extent | None:
    from pydantic import ValidationError

    if not (ends := _numbers("--wall-extent", text, 4)):
        return None
    try:
        return walls.Extent(x_min_m=ends[0], x_max_m=ends[1], y_min_m=ends[2], y_max_m=ends[3])
    except ValidationError as error:
        raise typer.BadParameter(
            f"--wall-extent {text}: give X0,X1,Y0,Y1 in meters, X0 below X1 and Y0 below Y1, within"
            " 100 m"
        ) from error


def _numbers(option: str, text: str | None, count: int) -> Sequence[float]:
    try:
        numbers = [float(part) for part in text.split(",")] if text is not None else []
    except ValueError:
        numbers = [0.0]
    if text is not None and len(numbers) != count:
        raise typer.BadParameter(
            f"{option} takes {count} numbers with commas between, got {text!r}"
        )
    return numbers


def transient_path(path: Path, *, overwrite: bool) -> Path:
    """Return the file to write. Raises typer.BadParameter for another suffix, OutputExistsError if
    it exists.
    """
    if path.suffix not in {".hdf5", ".h5"}:
        raise typer.BadParameter(f"--transient {path}: choose a name that ends in .hdf5")
    return output_path(path, "transient", path.suffix, overwrite=overwrite)


def write_transient(
    path: Path,
    scene: renderer.Scene,
    capture: transients.Capture,
    accuracy: renderer.Accuracy,
    backend: str,
    *,
    as_json: bool,
) -> None:
    """Render a transient, write it and print what it holds. Raises SceneError where no light
    returns.
    """
    save = transients.save_transient  # needs an extra, which is missed before the long work
    start_s = time.perf_counter()
    with tracked("rendering the transient", at_once=False) as on_progress:
        found = transients.render_transient(scene, capture, accuracy, backend, on_progress)
    seconds = time.perf_counter() - start_s
    # With noise, which may count no photon, the light was tested before it.
    if capture.noise is None and not found.histograms.any():
        raise SceneError(
            "no light returns within the bins: move the object into the box, or widen --bins,"
            " --start-m and --wall-extent"
        )
    save(path, found)
    shape = " x ".join(map(str, found.histograms.shape))
    facts = {"capture": found.kind, "layout": found.layout.name, "shape": found.histograms.shape}
    window = {"start_m": found.start_m, "bin_m": found.bin_m, "energy": float(found.curve.sum())}
    text = f"Transient ({found.kind}, {shape}) in {seconds:.2f} s: {path}"
    finish({**facts, **window, "seconds": seconds, "out": str(path)}, as_json=as_json, text=text)
