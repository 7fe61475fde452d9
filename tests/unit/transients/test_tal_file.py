"""Transients as files: round trip, tal's fields, wrong files, and y-tal itself where there is
one.
"""

import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from nlos_calibration import rig_named
from nlos_calibration.arrays import Float64

from nlos_cam.cli.main import main
from nlos_cam.errors import RecordingError
from nlos_cam.objects import object_box, object_depth
from nlos_cam.render import Accuracy, Scene
from nlos_cam.transients import (
    CAPTURES,
    Capture,
    Transient,
    Volume,
    back_projection,
    load_transient,
    peak_m,
    render_transient,
    save_transient,
    transient_document,
)

ROOT = Path(__file__).parents[3]
RIG = rig_named("paper-rig")
DEPTH = object_depth(3, object_box(RIG), ("cup",))[1]
SCENE = Scene(RIG, DEPTH)
ACCURACY = Accuracy("coarse", relay_columns=12, relay_rows=12, sub_bins=0, object_stride=4)
NEAR_M = 0.05
"""A plain back-projection is blurred, and brightest at the part of the object that returns most."""


@pytest.fixture(scope="module")
def transients() -> dict[str, Transient]:
    """A transient of the same cup by each capture."""
    cells = {"exhaustive": 6, "lidar": 10, "confocal": 16, "single": 16}
    return {
        kind: render_transient(SCENE, Capture(kind, cells[kind]), ACCURACY) for kind in CAPTURES
    }


@pytest.fixture(scope="module")
def saved(transients: dict[str, Transient], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the four as files, by capture."""
    folder = tmp_path_factory.mktemp("tal")
    for kind, found in transients.items():
        save_transient(folder / f"{kind}.hdf5", found)
    return folder


def off_the_object_m(point_m: tuple[float, float, float] | list[float]) -> float:
    """Return the distance of a point to the hidden surface."""
    box = object_box(RIG)
    rows, columns = np.nonzero(~np.isnan(DEPTH))
    side = len(DEPTH)
    x_m = box.x_min_m + (columns + 0.5) * (box.x_max_m - box.x_min_m) / side
    y_m = box.y_max_m - (rows + 0.5) * (box.y_max_m - box.y_min_m) / side
    surface = np.stack([x_m, y_m, DEPTH[rows, columns]], 1)
    return float(np.linalg.norm(surface - np.array(point_m), axis=1).min())


@pytest.mark.parametrize("kind", CAPTURES)
def test_file_gives_back_what_was_saved(
    kind: str, transients: dict[str, Transient], saved: Path
) -> None:
    found = load_transient(saved / f"{kind}.hdf5")
    wanted = transients[kind]

    assert np.array_equal(found.histograms, wanted.histograms)
    assert (found.layout, found.kind) == (wanted.layout, wanted.kind)
    assert (found.bin_m, found.start_m) == (wanted.bin_m, wanted.start_m)
    assert np.allclose(found.laser_grid_m, wanted.laser_grid_m, atol=1e-7)
    assert np.allclose(found.detector_grid_m, wanted.detector_grid_m, atol=1e-7)
    assert found.facts()["volume"]["size"] == [0.25, 0.25, 0.28]


@pytest.mark.parametrize("kind", CAPTURES)
def test_back_projection_is_brightest_at_the_object(kind: str, saved: Path) -> None:
    found = load_transient(saved / f"{kind}.hdf5")
    volume = Volume.of(found, 24)

    assert off_the_object_m(peak_m(back_projection(found, volume), volume)) < NEAR_M


TURNS = {
    "-z": np.diag([1.0, -1.0, -1.0]),
    "x": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "oblique": np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]]),
}
SHIFT_M = np.array([0.3, -0.2, 1.0])


def turned(found: Transient, turn: Float64) -> Transient:
    """Return a capture in other axes and of unknown volume, as another program may write it."""
    moved: dict[str, Any] = {
        name: getattr(found, name) @ turn.T + SHIFT_M
        for name in ("laser_grid_m", "detector_grid_m", "laser_m", "detector_m")
    }
    for name in ("laser_normals", "detector_normals"):
        moved[name] = getattr(found, name) @ turn.T
    return replace(found, scene="", **moved)


@pytest.mark.parametrize("facing", ["-z", "x"])
def test_wall_of_any_direction_is_projected_along_normal(
    facing: str, transients: dict[str, Transient]
) -> None:
    turn = TURNS[facing]
    found = turned(transients["confocal"], turn)
    volume = Volume.of(found, 24)
    peak = np.array(peak_m(back_projection(found, volume), volume)) - SHIFT_M
    original_m = (peak @ turn).tolist()
    caption = transient_document("turned", found, {}).as_markdown()

    assert off_the_object_m(original_m) < NEAR_M
    assert re.search(r"\) m, 0\.[12]\d\d m from the wall", caption)


def test_picture_of_oblique_wall_is_refused(transients: dict[str, Transient]) -> None:
    with pytest.raises(RecordingError, match=r"faces \(0\.60, 0\.00, 0\.80\)"):
        Volume.of(turned(transients["confocal"], TURNS["oblique"]))


def test_fields_are_those_of_tal(saved: Path) -> None:
    with h5py.File(saved / "single.hdf5") as file:
        members = h5py.check_enum_dtype(file["H_format"].dtype)

        assert members == {"UNKNOWN": 0, "T_Sx_Sy": 1, "T_Lx_Ly_Sx_Sy": 2, "T_Si": 3, "T_Li_Si": 4}
        assert (file["H_format"][0], file["laser_grid_format"][0]) == (1, 2)
        assert file["t_accounts_first_and_last_bounces"].dtype == np.bool_
        assert file["laser_grid_xyz"].shape == (1, 1, 3)
        assert np.array_equal(file["sensor_grid_normals"][0, 0], [0, 0, 1])
        assert json.loads(file["scene_info"][()])["original_format"] == "nlos-cam"


def test_file_of_tal_without_places_or_normals_is_read(tmp_path: Path) -> None:
    path = tmp_path / "stranger.hdf5"
    with h5py.File(path, "w") as file:
        file["H"] = np.ones((5, 3, 2), np.float64)
        file["H_format"] = 4
        file["laser_grid_xyz"] = np.random.default_rng(0).random((3, 3))
        file["sensor_grid_xyz"] = np.random.default_rng(1).random((2, 3))
        file["delta_t"] = 0.3
        file["t_accounts_first_and_last_bounces"] = False
        for name in ("laser_xyz", "sensor_xyz", "sensor_grid_normals", "t_start"):
            file[name] = h5py.Empty(float)
        file["scene_info"] = "config: {spp: 1}\n"
    found = load_transient(path)

    assert found.kind == "exhaustive"
    assert found.laser_m is None
    assert back_projection(found).any()
    assert main(["info", str(path), "--out", str(tmp_path / "look.png")]) == 0


def test_list_of_laser_points_stands_for_the_detectors_grid(
    saved: Path, tmp_path: Path, transients: dict[str, Transient]
) -> None:
    path = tmp_path / "list.hdf5"
    path.write_bytes((saved / "confocal.hdf5").read_bytes())
    points = transients["confocal"].laser_grid_m.reshape(-1, 3)
    replaced("laser_grid_xyz", points)(path)
    found = load_transient(path)

    assert found.kind == "confocal"
    assert np.allclose(
        back_projection(found), back_projection(load_transient(saved / "confocal.hdf5"))
    )


def replaced(name: str, value: Any) -> Callable[[Path], None]:
    def harm(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            del file[name]
            if value is not None:
                file[name] = value

    return harm


def bomb(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["H"]
        file.create_dataset("H", (1 << 20, 1 << 10, 1 << 10), "f4", chunks=(1, 1024, 1024))


def grids_of_another_shape(path: Path) -> None:
    for name in ("laser_grid_xyz", "sensor_grid_xyz"):
        replaced(name, np.zeros((32, 8, 3)))(path)


def halved(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


WRONG: dict[str, Callable[[Path], object]] = {
    "text": lambda path: path.write_text("no HDF5"),
    "cut short": halved,
    "no histograms": replaced("H", None),
    "unknown format": replaced("H_format", 9),
    "other axes": replaced("H", np.ones((9, 16, 16, 2), np.float32)),
    "texts": replaced("H", np.array([b"a"], "S1")),
    "no light at all": replaced("H", np.full((9, 16, 16), np.nan)),
    "light beyond float32": replaced("H", np.full((9, 16, 16), 1e308)),
    "other grid": replaced("sensor_grid_xyz", np.zeros((3, 3, 3))),
    "grids of another shape": grids_of_another_shape,
    "before the pulse": replaced("t_start", -1e3),
    "points at infinity": replaced("laser_grid_xyz", np.full((16, 16, 3), np.inf)),
    "bins of no width": replaced("delta_t", 0.0),
    "no number": replaced("t_start", np.array([1.0, 2.0])),
    "terabytes": bomb,
    "elsewhere": replaced("H", h5py.ExternalLink("other.hdf5", "/H")),
    "no laser": replaced("laser_xyz", h5py.Empty(float)),
    "a folder": replaced("scene_info", h5py.SoftLink("/")),
}


@pytest.mark.parametrize("harm", WRONG)
def test_wrong_file_is_one_line_and_exit_4(
    harm: str, saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "wrong.hdf5"
    path.write_bytes((saved / "confocal.hdf5").read_bytes())
    WRONG[harm](path)
    with pytest.raises(RecordingError) as caught:
        load_transient(path)

    assert "\n" not in str(caught.value)
    assert main(["info", str(path), "--out", str(tmp_path / "look.html")]) == 4
    assert str(path) in capsys.readouterr().out
    assert not (tmp_path / "look.html").exists()


def test_command_renders_a_transient_and_describes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "cup.hdf5"
    line = ["render", "cup", "--transient", str(path), "--capture", "confocal", "--wall-cells", "4"]

    assert main([*line, "--wall-extent", "0.1,0.5,-0.2,0.2", "--photons", "1000"]) == 0
    assert main(line) == 1  # it exists
    assert main(["info", str(path), "--json"]) == 0

    described = json.loads(capsys.readouterr().out.splitlines()[-1])

    assert described["facts"]["capture"] == "confocal"
    assert "x 0.150 to 0.450 m" in described["facts"]["laser points"]


def test_view_names_the_command_that_draws_a_transient(
    saved: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", str(saved / "single.hdf5")]) == 4

    told = capsys.readouterr().err.strip()

    assert told.count("\n") == 0
    assert "nlos-cam info" in told
    assert "--out look.html" in told


def tal_python() -> str | None:
    """Return a Python that has y-tal: this one, or NLOS_CAM_TAL_PYTHON."""
    return (
        sys.executable if importlib.util.find_spec("tal") else os.environ.get("NLOS_CAM_TAL_PYTHON")
    )


@pytest.mark.skipif(tal_python() is None, reason="no y-tal here, nor NLOS_CAM_TAL_PYTHON set")
def test_tal_reads_all_captures_and_finds_the_object(saved: Path) -> None:
    files = [str(saved / f"{kind}.hdf5") for kind in CAPTURES]
    program = [str(tal_python()), str(ROOT / "tools/studies/tal_reader.py"), *files]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    answer = subprocess.run(program, capture_output=True, text=True, check=True, env=environment)
    found = json.loads(answer.stdout)

    assert len(found) == len(CAPTURES)
    assert found["confocal.hdf5"]["confocal"]
    assert all(off_the_object_m(one["peak_m"]) < NEAR_M for one in found.values())


def test_report_of_a_dark_transient_names_no_brightest_point(
    transients: dict[str, Transient],
) -> None:
    lit = transients["confocal"]
    dark = replace(lit, histograms=np.zeros_like(lit.histograms))
    captions = [transient_document("", one, {}).parts[1].caption for one in (lit, dark)]

    assert "brightest at" in captions[0]
    assert "brightest at" not in captions[1]
    assert "No light" in captions[1]
