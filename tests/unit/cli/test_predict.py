"""`predict`: refusals in one line, and a bench folder in place of a rig."""

import json
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, get_args

import pytest
from made_benches import make_bench
from nlos_calibration import dump_toml, load_rig

from nlos_cam.bench import load_bench
from nlos_cam.cli.main import main
from nlos_cam.forecast import FRAMES, MATERIALS, Conditions, forecast
from nlos_cam.render import Radiometry


def test_predict_takes_a_rig_file_and_names_what_it_sees(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    home = load_rig("paper-rig")
    assert home.occluder
    closed = home.occluder.model_copy(update={"z_min_m": 1e-6})
    file = tmp_path / "mine.toml"
    file.write_text(dump_toml(home.model_copy(update={"occluder": closed, "name": "mine"})))
    page = tmp_path / "mine.html"

    assert main(["predict", str(file), "--quick", "--json", "--out", str(page)]) == 0

    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["rig"] == "mine"
    assert found["expectations"][0]["cells"] == 0
    assert "sees nothing" in page.read_text()


def test_predict_bench_takes_its_rig_and_an_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = make_bench(Path("bench"))

    assert main(["predict", "--bench", "bench", "cup", "--quick", "--json"]) == 0

    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["rig_checksum"] == load_bench(folder).rig.checksum
    assert found["object"] == "cup"
    assert found["lidar"]["cells"] > 100
    assert main(["predict", "--bench", "bench", "paper-rig", "cup"]) == 2


def test_predict_of_an_object_alone_takes_the_configured_bench(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = make_bench(Path("bench"))
    Path("nlos-cam.toml").write_text('bench = "bench"\n', encoding="utf-8")

    assert main(["predict", "cup", "--quick", "--json"]) == 0

    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["rig_checksum"] == load_bench(folder).rig.checksum
    assert found["object"] == "cup"


def test_predict_of_an_object_alone_takes_the_papers_rig(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)

    assert main(["predict", "cup", "--quick", "--json"]) == 0

    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (found["rig"], found["object"]) == ("paper-rig", "cup")


@pytest.mark.parametrize("rig", ["paper-rig", "mine.toml", "cup"])
def test_predict_of_a_rig_leaves_the_configured_bench(
    rig: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    make_bench(Path("bench"))
    Path("nlos-cam.toml").write_text('bench = "bench"\n', encoding="utf-8")
    text = dump_toml(load_rig("paper-rig"))
    for name in ("mine.toml", "cup"):  # a file may have the name of a category
        Path(name).write_text(text, encoding="utf-8")

    assert main(["predict", rig, "--quick", "--json"]) == 0

    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["rig_checksum"] == load_rig("paper-rig").checksum
    assert found["object"] is None


def test_predict_places_an_object_as_render_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "cup.html"
    words = ["predict", "paper-rig", "cup", "--quick", "--json", "--out", str(page)]
    found: list[dict[str, Any]] = []
    for placement in ([], ["--front-m", "0.1", "--size-m", "0.12", "--overwrite"]):
        assert main([*words, *placement]) == 0
        found.append(json.loads(capsys.readouterr().out.splitlines()[-1]))

    assert found[1]["lidar"]["cells"] < found[0]["lidar"]["cells"]
    assert "What the lidar would show" in page.read_text()


def test_predict_refuses_a_placement_of_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["predict", "paper-rig", "--quick", "--x-m", "0.1"]) == 2
    assert "--x-m: no OBJECT is named" in capsys.readouterr().err


@pytest.mark.parametrize("columns", [60, 80, 100])
def test_predict_cuts_no_label_of_the_full_table(
    columns: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", str(columns))
    quick = forecast(load_rig("paper-rig"), quick=True)
    rows = [
        replace(quick.at(), conditions=Conditions(frames, material, radiometry))
        for frames, material, radiometry in product(FRAMES, MATERIALS, get_args(Radiometry))
    ]
    full = replace(quick, expectations=tuple(rows))
    monkeypatch.setattr("nlos_cam.forecast.forecast", lambda *_, **__: full)
    monkeypatch.setattr("nlos_cam.forecast.changes", lambda *_: [])

    assert main(["predict", "paper-rig"]) == 0

    shown = capsys.readouterr().out
    assert "…" not in shown
    for word in ("retroreflective,", "lambertian", "IoU 100", "outline", "error mm"):
        assert word in shown


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("nowhere", "no bench folder nowhere"),
        ("empty-folder", "empty-folder is not a bench folder"),
    ],
)
def test_predict_bench_names_a_folder_that_is_none(
    wrong: str,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "empty-folder").mkdir()
    monkeypatch.chdir(tmp_path)

    assert main(["predict", "--bench", wrong, "--quick"]) == 4

    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "hint"),
    [
        (["predict", "cupp"], 2, "'cup'"),
        (["predict", "cupp", "cup"], 2, "a bench folder"),
        (["predict", "nowhere"], 2, "a bench folder"),
        (["predict", "nowhere/"], 4, "no bench folder nowhere"),
        (["adapt", "nowhere/"], 4, "no bench folder nowhere"),
    ],
)
def test_wrong_rig_or_bench_says_what_it_might_be(
    words: list[str],
    code: int,
    hint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)

    assert main(words) == code

    assert hint in capsys.readouterr().err


@pytest.mark.parametrize("wrong", ["nowhere.toml", "papper-rig", "bare-wall", "empty-folder"])
def test_predict_refuses_what_is_no_rig_in_one_line(
    wrong: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty-folder").mkdir()
    monkeypatch.chdir(tmp_path)

    assert main(["predict", wrong, "--quick"]) in {1, 2, 4}

    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    "words",
    [
        ["predict", "mirrored.toml", "--quick"],
        ["render", "cup", "--rig", "mirrored.toml"],
        ["evaluate", "--rig", "mirrored.toml", "--out", "figures"],
    ],
    ids=lambda words: words[0],
)
def test_mirrored_bench_is_refused_by_every_command(
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    box = "[object_box]\nx_min_m = -0.575\nx_max_m = -0.325\n"
    turned = "[lidar]\nyaw_deg = -45.0\n\n[occluder]\nx_m = -0.2\n"
    Path("mirrored.toml").write_text(f'base = "paper-rig"\n\n{turned}\n{box}', encoding="utf-8")

    assert main([*words, "--json"]) == 4

    out, err = capsys.readouterr()
    message = json.loads(out.splitlines()[-1])["error"]["message"]
    assert "mirror the bench" in message
    assert "\n" not in message
    assert "Traceback" not in err
