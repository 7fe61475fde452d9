"""Bench folder: it gives back what was written, and nothing that does not fit."""

import shutil
from pathlib import Path

import pytest
from made_benches import SERIAL, make_bench, wall_of, write_wall
from nlos_calibration import load_measured
from nlos_calibration.errors import CalibrationError, RecordFileError
from nlos_models import load_record, shipped_folder
from nlos_models.errors import CheckpointError
from small_frames import FrameCamera

from nlos_cam.bench import (
    MANIFEST,
    ForecastRecord,
    check_new,
    edit_bench,
    iou_in_use,
    is_bench,
    load_bare_wall,
    load_bench,
    write_weights,
)
from nlos_cam.cli.benches import files_in_bench, write_to_bench
from nlos_cam.errors import OutputExistsError
from nlos_cam.files import read_toml
from nlos_cam.forecast import FORECAST_VERSION


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make_bench(tmp_path / "bench")


def set_line(folder: Path, start: str, line: str) -> None:
    """Replace the first line of bench.toml that starts so."""
    lines = (folder / MANIFEST).read_text(encoding="utf-8").splitlines()
    number = next(n for n, text in enumerate(lines) if text.startswith(start))
    lines[number] = line
    (folder / MANIFEST).write_text("\n".join(lines), encoding="utf-8")


def camera_of(folder: Path, serial: str = SERIAL) -> FrameCamera:
    camera = FrameCamera(1)
    camera.intrinsics = load_bench(folder).rig.pinhole
    camera.identity = {"serial": serial}
    return camera


def test_bench_gives_back_the_wall_that_was_measured(folder: Path) -> None:
    bench = load_bench(folder)
    record = load_measured(folder / "stations/main/occluder.toml").record

    assert bench.measured.record == record
    assert bench.rig == bench.calibrated.rig == record.rig
    assert bench.calibrated.reference is not None
    assert set(bench.stations) == {"main"}
    assert bench.record.camera.serial == SERIAL
    assert bench.weights is None
    assert bench.calibrated.notes == ()


def test_bench_of_a_bare_wall_says_what_is_not_measured(tmp_path: Path) -> None:
    write_wall(tmp_path / "bench", wall_of())

    (note,) = load_bench(tmp_path / "bench").calibrated.notes

    assert "calibrate --occluder" in note


def test_object_box_of_the_bench_is_that_of_its_rig(folder: Path) -> None:
    set_line(folder, "x_max_m", "x_max_m = 0.6")

    assert load_bench(folder).rig.object_box.x_max_m == 0.6
    assert load_bare_wall(folder).record.rig.object_box.x_max_m == 0.6


def test_bench_with_another_object_box_is_judged_anew(folder: Path) -> None:
    before = load_bench(folder).measured.record
    set_line(folder, "x_min_m", "x_min_m = 0.02")
    after = load_bench(folder).measured.record

    assert before.verdict == "good"
    assert after.verdict == "out of range"
    assert "move the object" in after.advice


def test_bare_wall_stays_where_the_occluders_files_are_lost(folder: Path) -> None:
    (folder / "stations/main/occluder.toml").write_text("half of it", encoding="utf-8")

    with pytest.raises(RecordFileError, match="has changed"):
        load_bench(folder)
    assert load_bare_wall(folder).record.occluder is None


def test_wall_measured_again_drops_the_occluder_keeps_the_box(folder: Path) -> None:
    set_line(folder, "x_max_m", "x_max_m = 0.6")
    write_wall(folder, wall_of(), overwrite=True)
    bench = load_bench(folder)

    assert bench.measured.record.occluder is None
    assert bench.rig.object_box.x_max_m == 0.6
    assert not (folder / "stations/main/occluder.toml").exists()


def test_bare_wall_of_no_station_is_refused(folder: Path) -> None:
    with pytest.raises(RecordFileError, match="choose from main"):
        load_bare_wall(folder, "left")


def test_measurement_of_another_process_meanwhile_stays(tmp_path: Path) -> None:
    first = wall_of()
    files = files_in_bench(tmp_path / "bench", occluder=False, overwrite=False)
    write_wall(tmp_path / "bench", first)

    with pytest.raises(OutputExistsError, match="--overwrite"):
        write_to_bench(
            tmp_path / "bench", files, wall_of(frames=7).record, first.reference, overwrite=False
        )
    assert load_bench(tmp_path / "bench").measured.record.frames == first.record.frames


def test_existing_measurement_stays_unless_overwritten(folder: Path) -> None:
    with pytest.raises(OutputExistsError, match="--overwrite"):
        write_wall(folder, wall_of())


def test_camera_of_the_bench_opens_it_and_no_other(folder: Path) -> None:
    bench = load_bench(folder)

    assert bench.for_camera(camera_of(folder)).rig == bench.rig

    with pytest.raises(CalibrationError, match="other-one"):
        bench.for_camera(camera_of(folder, "other-one"))
    smaller = camera_of(folder)
    smaller.intrinsics = smaller.intrinsics.scaled(48, 36)
    with pytest.raises(CalibrationError, match="48x36"):
        bench.for_camera(smaller)


def test_weights_come_back_with_the_rig_of_their_bench(folder: Path, tmp_path: Path) -> None:
    source = tmp_path / "own"
    shutil.copytree(shipped_folder(), source)
    write_weights(folder, source)
    bench = load_bench(folder)

    assert bench.weights == folder / "weights"
    assert load_record(bench.weights).rig is None  # of the packaged rig

    record = load_record(source).model_copy(update={"rig_checksum": bench.rig.checksum})
    (source / "SHA256SUMS").unlink()
    (source / "doubt.json").unlink()
    (source / "checkpoint.json").write_text(record.model_dump_json(), encoding="utf-8")
    write_weights(folder, source)

    assert load_record(folder / "weights").rig == bench.rig.model_dump(mode="json")
    assert iou_in_use(folder) is None

    write_weights(folder, source, 0.61)

    assert iou_in_use(folder) == 0.61

    assert not (folder / "weights/doubt.json").exists()


def test_weights_are_known_on_a_bench_that_is_nearly_the_same(folder: Path, tmp_path: Path) -> None:
    source = Path(shutil.copytree(shipped_folder(), tmp_path / "own"))
    checksum = load_bench(folder).rig.checksum
    record = load_record(source).model_copy(update={"rig_checksum": checksum})
    for name in ("SHA256SUMS", "doubt.json"):
        (source / name).unlink()
    (source / "checkpoint.json").write_text(record.model_dump_json(), encoding="utf-8")
    write_weights(folder, source, 0.61)

    set_line(folder, "x_max_m", "x_max_m = 0.57503")  # by less than they can notice
    near = iou_in_use(folder)
    set_line(folder, "x_max_m", "x_max_m = 0.6")

    assert near == 0.61
    assert iou_in_use(folder) is None


def test_lost_weights_do_not_lock_the_bench(folder: Path) -> None:
    """Deleted, or half replaced by a kill: commands that make new ones can load it."""
    write_weights(folder, shipped_folder())
    shutil.rmtree(folder / "weights")

    with pytest.raises(RecordFileError, match="adapt the bench again"):
        load_bench(folder)
    assert load_bench(folder, weights=False).weights is None
    assert iou_in_use(folder) is None

    write_weights(folder, shipped_folder())

    assert load_bench(folder).weights == folder / "weights"


@pytest.mark.parametrize("name", ["direct.safetensors", "doubt.onnx", "quality.json"])
def test_damaged_weights_do_not_replace_those_in_use(
    folder: Path, tmp_path: Path, name: str
) -> None:
    write_weights(folder, shipped_folder())
    source = Path(shutil.copytree(shipped_folder(), tmp_path / "own"))
    content = (source / name).read_bytes()
    (source / name).write_bytes(content[: len(content) // 2])

    with pytest.raises(CheckpointError, match=f"{name} is missing or damaged"):
        write_weights(folder, source)

    assert load_bench(folder).weights == folder / "weights"
    assert (folder / "weights" / name).read_bytes() == content


def test_a_stopped_first_measurement_is_repeated(tmp_path: Path) -> None:
    (tmp_path / "bench/stations/main").mkdir(parents=True)

    write_wall(tmp_path / "bench", wall_of())

    assert is_bench(tmp_path / "bench")


def test_forecast_holds_for_the_rig_that_it_was_made_for(folder: Path) -> None:
    checksum = load_bench(folder).rig.checksum
    forecast = ForecastRecord(
        version=FORECAST_VERSION, rig_checksum=checksum, expected_iou=0.6, hidden_share=0.25
    )
    with edit_bench(folder) as edit:
        edit.set_forecast("main", forecast)

    assert load_bench(folder).expected_iou == 0.6
    assert load_bench(folder).hidden_share == 0.25

    set_line(folder, "x_max_m", "x_max_m = 0.6")
    assert load_bench(folder).expected_iou is None
    assert load_bench(folder).hidden_share == 0.0


def test_added_file_is_checked(folder: Path) -> None:
    path = folder / "report.html"
    path.write_bytes(b"<html>")
    with edit_bench(folder) as edit:
        edit.add(path)

    assert "report.html" in load_bench(folder).record.files

    path.write_bytes(b"other")
    with pytest.raises(RecordFileError, match=r"report\.html has changed"):
        load_bench(folder)


def test_interrupted_edit_leaves_the_bench_as_it_was(folder: Path) -> None:
    before = read_toml(folder / MANIFEST)

    def interrupt() -> None:
        with edit_bench(folder) as edit:
            edit.add(folder / "stations/main/wall.html")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt()

    assert read_toml(folder / MANIFEST) == before
    assert load_bench(folder).rig


def test_folder_with_other_files_does_not_become_a_bench(folder: Path, tmp_path: Path) -> None:
    check_new(folder)
    check_new(tmp_path / "new")
    check_new(tmp_path / "none" / "bench")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/one.png").touch()
    (tmp_path / "file").touch()

    assert is_bench(folder)
    with pytest.raises(OutputExistsError, match="no bench"):
        check_new(Path("/"))
    for taken in ("photos", "file", "file/bench"):
        assert not is_bench(tmp_path / taken)
        with pytest.raises(OutputExistsError):
            check_new(tmp_path / taken)


def test_read_only_bench_is_refused_before_it_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda *_: False)  # root may write everywhere
    for place in ("", "none/bench"):
        with pytest.raises(OutputExistsError, match="read-only"):
            check_new(tmp_path / place)
