"""The option --bench: a bench folder in place of --wall, --weights and --rig."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from made_benches import make_bench, wall_of, write_wall
from nlos_calibration import dump_toml, load_rig
from nlos_models import RECORD, load_record, shipped_folder, weights_folder

from nlos_cam.bench import (
    MANIFEST,
    ForecastRecord,
    edit_bench,
    load_bench,
    weights_verdict,
    write_weights,
)
from nlos_cam.cli.benches import bench_or_rig, rig_or_default
from nlos_cam.cli.calibrate import _written_bench
from nlos_cam.forecast import FORECAST_VERSION
from nlos_cam.reconstruct import WALL_GRID

Run = Callable[..., Any]
FAR = """name = "far"
[rig]
base = "paper-rig"
[rig.lidar]
distance_m = 0.22
yaw_deg = 40.0
"""
HIDDEN = """[motion]
poses = 1
[object]
category = "cup"
"""


@pytest.fixture
def bench() -> Path:
    return make_bench(Path("bench"))


def change(folder: Path, name: str, before: str, after: str) -> None:
    """Replace the first occurrence of a text in a file of a bench."""
    path = folder / name
    text = path.read_text(encoding="utf-8")
    assert before in text
    path.write_text(text.replace(before, after, 1), encoding="utf-8")


def missing(folder: Path) -> None:
    shutil.rmtree(folder)


def a_file(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.write_text("wall", encoding="utf-8")


def without_record(folder: Path) -> None:
    (folder / MANIFEST).unlink()


def a_wall_record(folder: Path) -> None:
    shutil.copy(folder / "stations/main/wall.toml", folder / MANIFEST)


def a_scene(folder: Path) -> None:
    (folder / MANIFEST).write_text(FAR, encoding="utf-8")


def noise(folder: Path) -> None:
    (folder / MANIFEST).write_bytes(bytes(range(256)))


def a_later_version(folder: Path) -> None:
    change(folder, MANIFEST, "bench_version = 1", "bench_version = 2")


def outside(folder: Path) -> None:
    change(folder, MANIFEST, '"stations/main/occluder.toml"', '"../occluder.toml"')


def changed_wall(folder: Path) -> None:
    change(folder, "stations/main/occluder.toml", "frames = 30", "frames = 31")


def lost_reference(folder: Path) -> None:
    (folder / "stations/main/occluder.npz").unlink()


def other_serial(folder: Path) -> None:
    change(folder, MANIFEST, 'serial = "f0123456"', 'serial = "f9999999"')


def other_intrinsics(folder: Path) -> None:
    change(folder, MANIFEST, "fx = ", "fx = 1")


def other_size(folder: Path) -> None:
    """Of a camera with the sample recording's serial, at another resolution."""
    shutil.rmtree(folder)
    make_bench(folder, serial="")


def other_camera(folder: Path) -> None:
    shutil.rmtree(folder)
    make_bench(folder, serial="f9999999")


@pytest.mark.parametrize(
    ("spoil", "word", "code"),
    [
        (missing, "no bench folder", 4),
        (a_file, "not a bench folder", 4),
        (without_record, "no bench.toml", 4),
        (a_wall_record, "wall record", 4),
        (a_scene, "scene", 4),
        (noise, "binary", 4),
        (a_later_version, "version 1 only", 4),
        (outside, "inside the bench folder", 4),
        (changed_wall, "has changed", 4),
        (lost_reference, "cannot be read", 4),
        (other_serial, "f9999999", 4),
        (other_intrinsics, "other intrinsics", 4),
        (other_size, "the wall was measured at 96x72", 1),
        (other_camera, "the wall was measured at 96x72", 1),
    ],
)
def test_no_bench_and_benches_of_others_give_one_line(
    shown: Run, bench: Path, spoil: Callable[[Path], None], word: str, code: int
) -> None:
    spoil(bench)

    out, err = shown("replay", "sample", "--bench", bench, "--out", "out", code=code)

    (line,) = err.splitlines()
    assert line.startswith("error: ")
    assert word in line
    assert out == ""
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("words", "word"),
    [
        (["replay", "sample", "--bench", "bench", "--wall", "wall.toml"], "--bench and --wall"),
        (["render", "cup", "--bench", "bench", "--rig", "paper-rig"], "--bench and --rig"),
        (["render", "cup", "--bench", "bench", "--scene", "cup"], "--bench and --rig"),
        (["calibrate", "--wall", "--bench", "bench", "--out", "w.toml"], "--bench and --out"),
        (["calibrate", "--occluder", "w.toml", "--bench", "bench"], "--occluder bench"),
    ],
)
def test_bench_contradicts_a_record_or_rig(
    run: Run, bench: Path, words: list[str], word: str
) -> None:
    answer = run(*words, code=2)

    assert bench.exists()
    assert word in answer.err


def test_render_takes_the_rig_of_the_bench(run: Run, bench: Path) -> None:
    pytest.importorskip("matplotlib")
    import numpy as np

    run("render", "cup", "--accuracy", "draft", "--bench", bench, "--out", "cup.npz")

    assert str(np.load("cup.npz")["rig_checksum"]) == load_bench(bench).rig.checksum


def test_doubtful_record_is_named_where_its_rig_is_used(run: Run) -> None:
    doubtful = wall_of(verdict="doubtful", advice="measure again")
    write_wall(Path("bench"), doubtful)
    words = "render", "cup", "--accuracy", "draft", "--overwrite", "--out", "cup.npz"

    assert "measure again" in run(*words, "--bench", "bench").err
    assert "measure again" in run(*words, "--rig", "bench/stations/main/wall.toml").err


def test_assumed_occluder_of_a_wall_record_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    write_wall(Path("bench"), wall_of())
    name = "bench/stations/main/wall.toml"
    for read in (bench_or_rig, partial(rig_or_default, None, default="paper-rig")):
        read(name)
        assert "the occluder has not been measured" in capsys.readouterr().err


def test_doubtful_record_is_named_before_weights_are_made(
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_wall(Path("bench"), wall_of(verdict="doubtful", advice="measure again"))

    for name in ("bench", "bench/stations/main/wall.toml"):
        bench_or_rig(name)
        assert "measure again" in capsys.readouterr().err


def test_rigs_prints_a_whole_rig_that_can_be_used(shown: Run) -> None:
    text = shown("rigs", "paper-rig").out
    Path("mine.toml").write_text(text, encoding="utf-8")

    assert load_rig("mine.toml") == load_rig("paper-rig")
    assert dump_toml(load_rig("paper-rig")) in text


def forecast(
    folder: Path, iou: float, hidden_share: float = 0.0, version: int = FORECAST_VERSION
) -> None:
    """Enter a forecast into a bench."""
    checksum = load_bench(folder).rig.checksum
    with edit_bench(folder) as edit:
        entry = ForecastRecord(
            version=version, rig_checksum=checksum, expected_iou=iou, hidden_share=hidden_share
        )
        edit.set_forecast("main", entry)


def verdict(folder: Path) -> str:
    """Return the verdict on the weights that a bench uses."""
    loaded = load_bench(folder)
    return weights_verdict(loaded.rig, weights_folder(loaded.weights), loaded).sentence


def test_verdict_on_weights_names_the_record_without_a_bench() -> None:
    wall = Path("my wall.toml")

    sentence = weights_verdict(load_rig("wide-rig"), shipped_folder(), None, wall).sentence

    assert "nlos-cam adapt 'my wall.toml'" in sentence


def test_verdict_on_weights_names_adapt_and_the_forecast(bench: Path) -> None:
    forecast(bench, 0.64)
    loaded = load_bench(bench)
    lidar = loaded.rig.lidar.model_copy(update={"distance_m": 0.25})
    farther = loaded.rig.model_copy(update={"lidar": lidar})

    verdict = weights_verdict(farther, shipped_folder(), loaded)

    assert "nlos-cam adapt bench" in verdict.sentence
    assert "expected silhouette IoU 0.64 after hours of training; those" in verdict.sentence
    assert f"in use about {verdict.present_iou:.2f})" in verdict.sentence
    assert verdict.adapting_helps is (verdict.present_iou < 0.64)


def test_verdict_on_weights_says_how_many_objects_are_hidden(bench: Path) -> None:
    forecast(bench, 0.64)
    before = verdict(bench)
    forecast(bench, 0.48, hidden_share=0.611)

    assert "nothing there" not in before
    assert "61% of the test objects change no cell" in verdict(bench)
    assert "nlos-cam predict bench" in verdict(bench)


def test_forecast_of_an_earlier_version_is_made_again_by_predict(bench: Path, run: Run) -> None:
    forecast(bench, 0.123, version=FORECAST_VERSION - 1)
    before = verdict(bench)
    own = Path("own")
    own.mkdir()
    (own / RECORD).write_text(load_record(shipped_folder()).model_dump_json(), encoding="utf-8")
    shutil.rmtree(write_weights(bench, own, 0.45))  # lost weights are in no forecast's way

    found = run("predict", "--bench", bench, "--quick")

    assert "nlos-cam predict bench" in before
    assert "0.12" not in before
    kept = load_bench(bench, weights=False).expected_iou
    assert kept == pytest.approx(found["expected_iou"], abs=1e-3)


def test_forecast_of_another_box_is_renewed_by_predict(bench: Path, run: Run) -> None:
    forecast(bench, 0.64)
    box = load_bench(bench).rig.object_box
    assert box is not None
    nearer = box.model_copy(update={"z_far_m": box.z_far_m - 0.05})
    with edit_bench(bench) as edit:
        station = edit.stations["main"].model_copy(update={"object_box": nearer})
        edit.set_station("main", station, load_bench(bench).measured.record)
    edited = verdict(bench)
    run("predict", bench, "cup", "--quick")  # an object of its own says nothing about others
    after_an_object = verdict(bench)
    found = run("predict", bench, "--quick")

    assert "nlos-cam predict bench" in edited
    assert "0.64" not in edited
    assert after_an_object == edited
    assert "predict" not in verdict(bench)
    assert load_bench(bench).expected_iou == pytest.approx(found["expected_iou"], abs=1e-3)


def test_verdict_on_own_weights_says_how_far_they_are(bench: Path) -> None:
    own = Path("own")
    own.mkdir()
    record = load_record(shipped_folder())
    update = {"rig_checksum": load_bench(bench).rig.checksum}
    (own / RECORD).write_text(record.model_copy(update=update).model_dump_json(), encoding="utf-8")
    write_weights(bench, own, 0.45)

    assert "0.45" in verdict(bench)
    assert "adapt" not in verdict(bench)

    forecast(bench, 0.64)
    assert "where 0.64 is expected" in verdict(bench)
    assert "more --minutes of `nlos-cam adapt bench`" in verdict(bench)


def test_lost_weights_stop_no_calibration(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_weights(bench, shipped_folder())
    shutil.rmtree(bench / "weights")

    assert _written_bench(bench).weights is None
    assert "adapt the bench again" in capsys.readouterr().err


@pytest.mark.slow
def test_three_commands_lead_from_recordings_to_pictures(run: Run) -> None:
    """A bench that is not the home rig; no number is copied from one command to the next."""
    bare = '[rig]\nbase = "bare-wall"\n[rig.lidar]\ndistance_m = 0.22\nyaw_deg = 40.0\n'
    scenes = {
        "bare": f'name = "far"\n{bare}',
        "empty": FAR,
        "cup": FAR.replace("[rig]", HIDDEN + "[rig]", 1),
    }
    for name, text in scenes.items():
        Path(f"{name}.toml").write_text(text, encoding="utf-8")
        run("capture", f"sim:{name}.toml", "--frames", "20", "--out", f"{name}.bag")

    run("calibrate", "--wall", "--bag", "bare.bag", "--bench", "bench")
    run("calibrate", "--occluder", "bench", "--bag", "empty.bag")
    report = run("replay", "cup.bag", "--bench", "bench", "--stills", "1", "--out", "pictures")

    assert report["frames"] == 20
    assert list(Path("pictures").glob("*.png"))
    assert load_bench(Path("bench")).rig.lidar.distance_m == pytest.approx(0.22, abs=1e-3)


def test_info_describes_a_bench_and_its_damage(run: Run, bench: Path) -> None:
    answer = run("info", bench)

    assert answer["kind"] == "bench"
    assert answer["facts"]["camera"] == "f0123456"
    assert answer["next"] == ["nlos-cam live --camera l515 --bench bench"]
    assert run("info", bench / MANIFEST)["kind"] == "record of a bench"

    changed_wall(bench)

    assert "has changed" in run("info", bench, code=4)["problem"]


def test_bench_folder_given_as_a_record_names_its_option(run: Run, bench: Path) -> None:
    answer = run("replay", "sample", "--wall", bench, "--out", "out", code=4)

    assert "--bench" in answer.err


def test_own_weights_on_the_wall_grid_say_how_far_they_are(bench: Path) -> None:
    own = Path("own")
    own.mkdir()
    record = load_record(shipped_folder())
    rig = load_bench(bench).rig.model_dump(mode="json")
    update = {"rig_checksum": WALL_GRID.checksum, "rig": rig}
    (own / RECORD).write_text(record.model_copy(update=update).model_dump_json(), encoding="utf-8")
    write_weights(bench, own, 0.45)

    assert "0.45" in verdict(bench)


@pytest.mark.parametrize("damage", [noise, a_later_version])
def test_damaged_bench_is_refused_before_a_camera_is_opened(
    run: Run, bench: Path, damage: Callable[[Path], None]
) -> None:
    damage(bench)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nlos_cam.cli.calibrate._capture", None)
        ended = run("calibrate", "sim", "--wall", "--bench", bench, "--overwrite", code=4)

    assert "another bench" in ended.err


def test_folder_of_results_does_not_hide_a_packaged_rig(bench: Path) -> None:
    Path("wide-rig").mkdir()
    rig, measured = bench_or_rig("wide-rig")

    assert (rig, measured) == (load_rig("wide-rig"), None)

    bench.rename("paper-rig")

    assert bench_or_rig("paper-rig")[1] is not None
