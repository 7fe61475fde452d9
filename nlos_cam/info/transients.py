"""Description of a transient in tal's HDF5, and its picture."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from nlos_cam.errors import RecordingError
from nlos_cam.files import atomic_file
from nlos_cam.info.files import Description, describe_shard

if TYPE_CHECKING:
    from nlos_calibration.arrays import Float64

MAX_NAME = 60
"""Characters of a name that a file gives itself."""


def describe_hdf5(path: Path, verify: bool) -> Description:
    """Describe a dataset's shard, or a transient with the same suffix."""
    import h5py

    try:
        with h5py.File(path) as file:
            is_transient = "H_format" in file
    except Exception:  # noqa: BLE001  h5py raises almost anything; the shard's reader says which
        is_transient = False
    return describe_transient(path, verify) if is_transient else describe_shard(path, verify)


def describe_transient(path: Path, _verify: bool) -> Description:
    """Describe a transient: axes, geometry, time axis and energy."""
    import numpy as np

    from nlos_cam.transients import load_transient

    found = load_transient(path)
    shape = found.histograms.shape
    axes = ", ".join(f"{axis} {size}" for axis, size in zip(found.layout.axes, shape, strict=True))
    lasers, detectors = found.points
    facts = {
        "capture": found.kind,
        "axes": f"{found.layout.name}: {axes}",
        "path length": (
            f"{found.bins} bins of {1e3 * found.bin_m:.4g} mm"
            f" ({found.bin_m / 0.000299792458:.4g} ps) from {found.start_m:.4g} m"
        ),
        "legs": (
            "all, from the laser to the detector" if found.first_and_last else "from wall to wall"
        ),
        "laser points": _extent(lasers),
        "detector's points": _extent(detectors),
    }
    for name, place in (("laser", found.laser_m), ("detector", found.detector_m)):
        if place is not None:
            facts[name] = "at ({:.3f}, {:.3f}, {:.3f}) m".format(*place)
    problem = ""
    if np.isfinite(found.histograms).all():
        curve = found.curve
        lit = np.flatnonzero(curve)
        facts["energy"] = f"{curve.sum():.4g}, in {(found.histograms != 0).mean():.0%} of the bins"
        if lit.size:
            first, most = (found.start_m + found.bin_m * at for at in (lit[0], curve.argmax()))
            facts["light"] = f"from {first:.3f} m of path on, most at {most:.3f} m"
    else:
        problem = f"{path} has values that are not finite: write it again"
    made_by = found.facts().get("original_format")
    name = f"{made_by}"[:MAX_NAME] if made_by else ""
    following = [f"nlos-cam info {shlex.quote(str(path))} --out look.html"]
    return Description("transient", facts, "", name, problem, "all values", following)


def _extent(points_m: "Float64") -> str:
    low = points_m.min(0)
    high = points_m.max(0)
    ends = ", ".join(
        f"{name} {a:.3f} to {b:.3f} m" if b > a else f"{name} {a:.3f} m"
        for name, a, b in zip("xyz", low, high, strict=True)
    )
    return f"{len(points_m)}: {ends}"


def write_picture(path: Path, found: Description, out: Path) -> None:
    """Write the picture of a transient (.png), or a report with it (.html).

    Raises RecordingError for a file of another kind.
    """
    if found.kind != "transient":
        raise RecordingError(f"{path} is a {found.kind}: --out is for transients (.hdf5), drop it")
    from nlos_cam.report import png
    from nlos_cam.transients import load_transient, transient_document, transient_figure

    transient = load_transient(path)
    if out.suffix == ".png":
        content = png(transient_figure(transient, path.name))
    else:
        content = transient_document(path.name, transient, found.facts).as_html().encode()
    with atomic_file(out) as part:
        part.write_bytes(content)
