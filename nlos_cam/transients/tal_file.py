"""Transients in the HDF5 of tal (y-tal, "your transient auxiliary library"), field by field as its
`tal.io` reads and writes them.

A file of somebody else is read within bounds: no array that declares more than the file holds.
"""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from nlos_calibration.arrays import Float64

from nlos_cam.errors import RecordingError
from nlos_cam.files import atomic_file, describe, read_hdf5
from nlos_cam.transients.transient import Layout, Transient

PLANE_BYTES = 8 << 20
"""Bytes of a chunk."""
MAX_BINS = 1 << 20
LAYOUTS = {"UNKNOWN": 0, "T_Sx_Sy": 1, "T_Lx_Ly_Sx_Sy": 2, "T_Si": 3, "T_Li_Si": 4}
GRIDS = {"UNKNOWN": 0, "N_3": 1, "X_Y_3": 2}
VOLUMES = {"UNKNOWN": 0, "N_3": 1, "X_Y_Z_3": 2, "X_Y_3": 3}
"""Enumerations of tal.enums."""
NAMES = {
    "H",
    "H_format",
    "delta_t",
    "laser_grid_xyz",
    "sensor_grid_xyz",
    "t_accounts_first_and_last_bounces",
}
"""Fields without which a file says too little."""


def save_transient(path: Path, transient: Transient) -> None:
    """Write a transient as tal's HDF5, atomically. Raises FileBusyError while another process
    writes it.
    """
    fields: dict[str, Any] = {
        "sensor_xyz": transient.detector_m,
        "sensor_grid_xyz": transient.detector_grid_m,
        "sensor_grid_normals": transient.detector_normals,
        "laser_xyz": transient.laser_m,
        "laser_grid_xyz": transient.laser_grid_m,
        "laser_grid_normals": transient.laser_normals,
    }
    enums = {
        "H_format": (LAYOUTS, transient.layout.name),
        "sensor_grid_format": (GRIDS, _grid_name(transient.detector_grid_m)),
        "laser_grid_format": (GRIDS, _grid_name(transient.laser_grid_m)),
        "volume_format": (VOLUMES, "X_Y_Z_3"),
    }
    with atomic_file(path) as part, h5py.File(part, "w") as file:
        histograms = transient.histograms
        plane_bytes = histograms[0].nbytes
        chunk = max(1, min(len(histograms), PLANE_BYTES // plane_bytes)), *histograms.shape[1:]
        file.create_dataset(
            "H", data=histograms, chunks=chunk, compression="gzip", compression_opts=1
        )
        for name, value in fields.items():
            # tal takes lengths in float32, and an empty value for what is not known.
            file[name] = h5py.Empty("f8") if value is None else value.astype(np.float32)
        for name, (members, member) in enums.items():
            kind = h5py.enum_dtype(members, basetype="i")
            file.create_dataset(name, (1,), dtype=kind)[0] = members[member]
        file["delta_t"] = transient.bin_m
        file["t_start"] = transient.start_m
        file["t_accounts_first_and_last_bounces"] = transient.first_and_last
        file["scene_info"] = transient.scene or "{}"


def _grid_name(grid_m: Float64) -> str:
    return "X_Y_3" if grid_m.ndim == 3 else "N_3"


def load_transient(path: Path) -> Transient:
    """Read a transient from tal's HDF5, by nlos-cam or by any other program.

    Raises RecordingError for a file that is none, is damaged, or contradicts itself.
    """
    if not path.is_file():
        raise RecordingError(f"{path} is not a file: check the name")
    try:
        with h5py.File(path) as file:
            return _checked(_read(file))
    except MemoryError:
        raise
    except Exception as error:  # h5py raises almost anything for damage
        raise RecordingError(
            f"{path} cannot be read as tal's HDF5 ({describe(error)}): write it again with"
            " `tal.io.write_capture` or `nlos-cam render --transient`"
        ) from error


def _read(file: h5py.File) -> Transient:
    if missing := sorted(NAMES - set(file)):
        raise ValueError(f"it has no {', '.join(missing)}")
    code = int(_number(file, "H_format"))
    if code not in set(Layout):
        known = ", ".join(f"{one.value} ({one.name})" for one in Layout)
        raise ValueError(f"H_format is {code}, not one of {known}")
    histograms = read_hdf5(file, "H")
    if histograms.dtype.kind not in "fiu":
        raise ValueError("H does not hold numbers")
    # Not a number is neither within the limit nor beyond it.
    ends = float(histograms.min(initial=0)), float(histograms.max(initial=0))
    if not all(abs(end) <= float(np.finfo(np.float32).max) for end in ends):
        raise ValueError("H holds light that is not finite")
    start = _number(file, "t_start") if _is_given(file, "t_start") else 0.0
    return Transient(
        histograms.astype(np.float32, copy=False),
        Layout(code),
        _points(file, "laser_grid_xyz"),
        _points(file, "sensor_grid_xyz"),
        _number(file, "delta_t"),
        start,
        bool(_number(file, "t_accounts_first_and_last_bounces")),
        _optional(file, "laser_xyz"),
        _optional(file, "sensor_xyz"),
        _optional(file, "laser_grid_normals"),
        _optional(file, "sensor_grid_normals"),
        _scene(file),
    )


def _is_given(file: h5py.File, name: str) -> bool:
    """Return False for a field that is missing, or empty as tal writes None.

    Raises ValueError for one that lies elsewhere.
    """
    link = file.get(name, getlink=True)
    if link is None:
        return False
    if isinstance(link, h5py.HardLink) and isinstance(stored := file[name], h5py.Dataset):
        return stored.shape is not None
    raise ValueError(f"{name} is not an array of this file")


def _number(file: h5py.File, name: str) -> float:
    if not _is_given(file, name):
        raise ValueError(f"{name} is empty")
    values = read_hdf5(file, name)
    if values.size != 1 or values.dtype.kind not in "fiub":
        raise ValueError(f"{name} is not one number")
    number = float(values.reshape(()))
    if not np.isfinite(number):
        raise ValueError(f"{name} is {number}")
    return number


def _points(file: h5py.File, name: str) -> Float64:
    values = read_hdf5(file, name) if _is_given(file, name) else np.zeros(0)
    if values.dtype.kind not in "fiu" or values.ndim not in {1, 2, 3} or values.shape[-1:] != (3,):
        raise ValueError(f"{name} is not an array of points (n, 3) or (x, y, 3)")
    points = values.astype(np.float64)
    if not np.isfinite(points).all() or np.abs(points).max(initial=0) > 1e6:
        raise ValueError(f"{name} holds points that are not finite, or beyond 1000 km")
    return points


def _optional(file: h5py.File, name: str) -> Float64 | None:
    return _points(file, name) if _is_given(file, name) else None


def _scene(file: h5py.File) -> str:
    if not _is_given(file, "scene_info"):
        return ""
    texts = read_hdf5(file, "scene_info")
    if texts.dtype != object or texts.size != 1:
        raise ValueError("scene_info is not a text")
    return str(texts.reshape(-1)[0])


def _checked(transient: Transient) -> Transient:
    """Return a transient whose parts agree. Raises ValueError for another."""
    shape = transient.histograms.shape
    axes = transient.layout.axes
    if len(shape) != len(axes) or not min(shape, default=0):
        raise ValueError(f"H has shape {shape}, but its format is {transient.layout.name}")
    if not 0 < transient.bin_m <= 1e3 or abs(transient.start_m) > 1e6:
        raise ValueError(
            f"delta_t is {transient.bin_m:g} and t_start {transient.start_m:g}: meters of path are"
            " expected"
        )
    if transient.end_m <= 0:
        raise ValueError(
            f"its last bin ends at {transient.end_m:g} m of path, before any light can arrive"
        )
    if shape[0] > MAX_BINS:
        raise ValueError(f"H has {shape[0]} bins, more than {MAX_BINS}")
    _check_grids(transient)
    if transient.first_and_last and (transient.laser_m is None or transient.detector_m is None):
        raise ValueError(
            "its times include the legs from laser and detector, whose places it lacks"
        )
    for name, place in (("laser_xyz", transient.laser_m), ("sensor_xyz", transient.detector_m)):
        if place is not None and place.shape != (3,):
            raise ValueError(f"{name} has shape {place.shape}, not (3,)")
    return transient


def _check_grids(transient: Transient) -> None:
    """Raise ValueError for grids of other points than those of the axes of H."""
    shape = transient.histograms.shape
    axes = transient.layout.axes
    by_axis = {"S": transient.detector_grid_m, "L": transient.laser_grid_m}
    for letter, grid in by_axis.items():
        sizes = tuple(
            size for size, axis in zip(shape, axes, strict=True) if axis.startswith(letter)
        )
        points = grid.shape[:-1]
        # A list of points (n, 3) may stand for a grid, but a grid must run as the axes do.
        is_same_grid = points == sizes or min(len(points), len(sizes)) == 1
        if sizes and not (is_same_grid and np.prod(sizes) == np.prod(points)):
            raise ValueError(f"H has {sizes} points of {letter}, but its grid has {points}")
    lasers = int(np.prod(transient.laser_grid_m.shape[:-1]))
    if "L" not in "".join(axes) and not transient.paired and lasers != 1:
        raise ValueError(f"{lasers} laser points belong to no axis of H")
