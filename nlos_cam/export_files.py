"""The files of an export: a PNG per frame with a table, one NPZ per stream, a point cloud per set."""

import csv
from collections import Counter
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, Protocol

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from nlos_cam.camera.streams import FORMATS, FrameSet, Pairing, Sample
from nlos_cam.errors import NlosCamError, RecordingError

POINTS = "points"
TO_BGR = {"rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGRA}
"""What a PNG wants of encodings that OpenCV does not write as they are; a .npz keeps every stream's own bytes."""


class Sink(Protocol):
    """Where the frames of one stream go."""

    def add(self, sample: Sample) -> None: ...

    def close(self) -> None:
        """Finish the files."""
        ...


class PngSink:
    """One PNG a frame, named by its number (16 bit for depth, in the stream's own units), and a table of timestamps."""

    def __init__(self, folder: Path, stream: str, encoding: str) -> None:
        self._folder, self._encoding = folder / stream, encoding
        self._folder.mkdir()
        self._table = (folder / f"{stream}.csv").open("w", newline="", encoding="utf-8")
        self._rows = csv.writer(self._table)
        self._rows.writerow(["file", "frame_number", "timestamp_s"])
        self._seen: Counter[int] = Counter()

    def add(self, sample: Sample) -> None:
        """Raises NlosCamError where the picture cannot be written."""
        self._seen[sample.number] += 1
        again = f"-{self._seen[sample.number]}" if self._seen[sample.number] > 1 else ""
        path = self._folder / f"{sample.number:06d}{again}.png"
        code = TO_BGR.get(self._encoding)
        pixels = sample.pixels if code is None else cv2.cvtColor(sample.pixels, code)
        done, png = cv2.imencode(".png", pixels)
        if not done:
            raise NlosCamError(f"frame {sample.number} of {sample.stream} ({self._encoding}) makes no PNG: use npz")
        path.write_bytes(png.tobytes())
        self._rows.writerow([f"{self._folder.name}/{path.name}", sample.number, f"{sample.timestamp_s:.6f}"])

    def close(self) -> None:
        self._table.close()


class NpzSink:
    """All frames of a stream in one .npz: pixels (N, height, width), frame_number, timestamp_s (N,)."""

    def __init__(self, folder: Path, stream: str, constants: dict[str, Any]) -> None:
        self._path, self._constants = folder / f"{stream}.npz", constants
        self._pixels: IO[bytes] = TemporaryFile(dir=folder)  # noqa: SIM115  closed in close()
        self._shape: tuple[int, ...] = ()
        self._type: np.dtype[Any] = np.dtype(np.uint8)
        self._numbers: list[int] = []
        self._timestamps_s: list[float] = []

    def add(self, sample: Sample) -> None:
        """Raises RecordingError where a frame is of another size than those before it."""
        self._shape, self._type = self._shape or sample.pixels.shape, sample.pixels.dtype
        if sample.pixels.shape != self._shape:
            raise RecordingError(
                f"frame {sample.number} of {sample.stream} is {sample.pixels.shape}, those before are {self._shape}: "
                "export as png"
            )
        self._pixels.write(np.ascontiguousarray(sample.pixels).tobytes())
        self._numbers.append(sample.number)
        self._timestamps_s.append(sample.timestamp_s)

    def close(self) -> None:
        self._pixels.flush()
        shape = len(self._numbers), *self._shape
        pixels = np.memmap(self._pixels, self._type, "r", shape=shape) if self._numbers else np.zeros(shape, self._type)
        np.savez_compressed(
            self._path,
            pixels=pixels,
            frame_number=np.array(self._numbers, np.int64),
            timestamp_s=np.array(self._timestamps_s),
            **self._constants,
        )
        del pixels
        self._pixels.close()


class PointSink:
    """One binary PLY for each whole set, or the first `most`; grey by infrared.

    Metres in the lidar frame: x right, y down, z ahead.
    """

    def __init__(self, folder: Path, rays: NDArray[np.float64], unit_m: float, most: int | None = None) -> None:
        self._folder, self._rays, self._unit_m, self._most = folder / POINTS, rays, unit_m, most
        self._folder.mkdir()
        self._pairing = Pairing(rays.shape[:2])
        self.written = 0

    def add(self, sample: Sample) -> None:
        if self.written == self._most or sample.stream not in FORMATS:
            return
        if found := self._pairing.add(sample):
            self._write(found)

    def _write(self, found: FrameSet) -> None:
        seen = found.depth_z16 > 0
        points_m = self._rays[seen] * (found.depth_z16[seen] * self._unit_m)[:, np.newaxis]
        grey = np.repeat(found.ir[seen][:, np.newaxis], 3, axis=1)
        cloud: Any = trimesh.PointCloud(points_m, colors=grey)
        (self._folder / f"{found.number:06d}.ply").write_bytes(cloud.export(file_type="ply"))
        self.written += 1

    def close(self) -> None:
        """Every cloud is a file of its own."""
