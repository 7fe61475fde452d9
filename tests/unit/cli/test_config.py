"""Settings: option before environment before the folder's file before the user's; unknown keys are
refused.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from made_benches import make_bench

from nlos_cam.cli import main as module
from nlos_cam.cli.common import Camera
from nlos_cam.cli.config import (
    FILE,
    SETTINGS,
    Value,
    _is_another,
    read_settings,
    shared_options,
    variable,
)
from nlos_cam.cli.main import main
from nlos_cam.errors import RecordingError

Run = Callable[..., Any]
LIVE = """camera = "sim:scene.toml"\nwall = "bench.toml"\nview_port = 9300\n"""


@pytest.fixture(autouse=True)
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """An empty current folder, and an empty folder of the user's."""
    here = tmp_path / "here"
    users = tmp_path / "users"
    for folder in (here, users / "nlos-cam"):
        folder.mkdir(parents=True)
    monkeypatch.chdir(here)
    monkeypatch.setattr(typer, "get_app_dir", lambda name: str(users / name))
    for name in SETTINGS:
        monkeypatch.delenv(variable(name), raising=False)
    return here, users / "nlos-cam"


def serve_as(monkeypatch: pytest.MonkeyPatch, name: str, command: Callable[..., None]) -> None:
    """Let the program have one command of this name, which is this function."""

    def build_app(_: str | None) -> typer.Typer:
        app = typer.Typer()
        app.callback()(lambda: None)
        app.command(name)(shared_options(name, command))
        return app

    monkeypatch.setattr(module, "build_app", build_app)


@pytest.fixture
def live(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The values that a command named live was called with."""
    calls: list[dict[str, Any]] = []

    def command(
        camera: Camera = "sim", wall: Path | None = None, view_port: int | None = None
    ) -> None:
        calls.append({"camera": camera, "wall": wall, "view_port": view_port})

    serve_as(monkeypatch, "live", command)
    return calls


def test_precedence_is_option_environment_folder_user_default(
    folders: tuple[Path, Path], live: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    main(["live"])
    (folders[1] / FILE).write_text('camera = "l515"\nview_port = 9100\n', encoding="utf-8")
    main(["live"])
    (folders[0] / FILE).write_text(LIVE, encoding="utf-8")
    main(["live"])
    monkeypatch.setenv("NLOS_CAM_VIEW_PORT", "9400")
    monkeypatch.setenv("NLOS_CAM_CAMERA", "sim")
    main(["live"])
    main(["live", "run.bag", "--view-port", "9500"])

    assert live == [
        {"camera": "sim", "wall": None, "view_port": None},
        {"camera": "l515", "wall": None, "view_port": 9100},
        {"camera": "sim:scene.toml", "wall": Path("bench.toml"), "view_port": 9300},
        {"camera": "sim", "wall": Path("bench.toml"), "view_port": 9400},
        {"camera": "bag:run.bag", "wall": None, "view_port": 9500},
    ]


@pytest.mark.parametrize(
    "words", [["sim:a"], ["--camera", "sim:a"], ["sim:a", "--camera", "sim:a"]]
)
def test_camera_is_an_argument_and_an_option(live: list[dict[str, Any]], words: list[str]) -> None:
    assert main(["live", *words]) == 0
    assert live[0]["camera"] == "sim:a"


def test_paths_of_the_users_file_are_relative_to_it(folders: tuple[Path, Path]) -> None:
    (folders[1] / FILE).write_text(LIVE, encoding="utf-8")
    settings = read_settings({})

    assert settings["wall"].value == str(folders[1] / "bench.toml")
    assert settings["camera"].value == f"sim:{folders[1] / 'scene.toml'}"


@pytest.mark.parametrize("name", ["run.bag", "cup_12:30.bag", "ros.mcap", "ros.db3", "ros"])
def test_recording_of_the_users_file_is_relative_to_it(
    folders: tuple[Path, Path], name: str
) -> None:
    (folders[1] / "ros").mkdir()
    (folders[1] / "ros" / "metadata.yaml").touch()
    (folders[1] / FILE).write_text(f'camera = "{name}"', encoding="utf-8")

    assert read_settings({})["camera"].value == str(folders[1] / name)


def test_bench_of_the_settings_is_not_used_with_the_sample(live: list[dict[str, Any]]) -> None:
    Path(FILE).write_text('wall = "mine.toml"\n', encoding="utf-8")

    assert main(["live", "sample"]) == 0
    assert (live[0]["camera"], live[0]["wall"]) == ("bag:sample", None)


def test_shipped_weights_are_named_in_the_users_file(folders: tuple[Path, Path]) -> None:
    (folders[1] / FILE).write_text('weights = "wide"', encoding="utf-8")
    named = read_settings({})["weights"].value
    (folders[1] / "wide").mkdir()
    folder = read_settings({})["weights"].value

    assert (named, folder) == ("wide", str(folders[1] / "wide"))


@pytest.mark.parametrize(
    ("file", "given"),
    [("run.bag", ("mine", None)), ("view.html", (None, None)), ("sample", (None, "own"))],
)
def test_bench_of_the_settings_is_for_recordings_in_view(
    monkeypatch: pytest.MonkeyPatch, file: str, given: tuple[str | None, ...]
) -> None:
    calls: list[tuple[str | None, ...]] = []

    def command(
        file: Path,
        wall: Path | None = None,
        bench_folder: Annotated[Path | None, typer.Option("--bench")] = None,
        weights: Path | None = None,
    ) -> None:
        del file, wall
        calls.append(tuple(None if one is None else str(one) for one in (bench_folder, weights)))

    serve_as(monkeypatch, "view", command)
    Path(FILE).write_text('bench = "mine"\nweights = "own"\n', encoding="utf-8")

    assert main(["view", file]) == 0
    assert calls == [given]


WRONG = {'camrea = "sim"': "Did you mean 'camera'", "camera = 3": "text", "camera = ": "TOML"}
WRONG |= {"view_port = 0": "65535", 'view_port = "9090"': "whole number"}


@pytest.mark.parametrize(("text", "word"), WRONG.items())
def test_wrong_file_is_refused_with_its_name(
    folders: tuple[Path, Path], text: str, word: str
) -> None:
    (folders[0] / FILE).write_text(text, encoding="utf-8")
    with pytest.raises(RecordingError, match=word) as caught:
        read_settings({})

    assert FILE in str(caught.value)


def test_wrong_variable_is_a_usage_error() -> None:
    with pytest.raises(typer.BadParameter, match="NLOS_CAM_VIEW_PORT"):
        read_settings({"NLOS_CAM_VIEW_PORT": "many"})


def test_config_shows_values_as_they_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Brackets and words between colons mean something to the library that prints tables."""
    monkeypatch.setenv("NLOS_CAM_BENCH", "a[/copy]")
    monkeypatch.setenv("NLOS_CAM_CACHE", "b:car:c")
    main(["config"])
    printed = capsys.readouterr().out

    assert "a[/copy]" in printed
    assert "b:car:c" in printed


def test_config_shows_values_and_sources(
    folders: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    (folders[0] / FILE).write_text(LIVE + 'cache = "c"', encoding="utf-8")
    monkeypatch.setenv("NLOS_CAM_WEIGHTS", "mine")
    settings = run("config")["settings"]

    assert settings["cache"] == {"value": "c", "source": FILE}
    assert settings["weights"] == {"value": "mine", "source": "NLOS_CAM_WEIGHTS"}
    assert settings["camera"]["source"] == FILE


def test_port_of_the_settings_is_for_the_demo_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(variable("view_port"), "9300")
    ports: list[int | None] = []

    def command(view_port: int | None = None) -> None:
        ports.append(view_port)

    serve_as(monkeypatch, "demo", command)

    assert main(["demo"]) == 0
    assert ports == [9300]


def test_verbose_prints_settings_in_use(
    folders: tuple[Path, Path], live: list[dict[str, Any]], shown: Run
) -> None:
    (folders[0] / FILE).write_text(LIVE, encoding="utf-8")

    assert f"wall = bench.toml (from {FILE})" in shown("-v", "live").err
    assert len(live) == 1


@pytest.mark.parametrize(
    ("words", "given"),
    [
        ([], ("mine", None, None)),
        (["--bench", "other"], ("other", None, None)),
        (["--wall", "w.toml"], (None, "w.toml", "own")),
        (["--weights", "direct"], ("mine", None, "direct")),
        (["sim:a"], (None, None, "own")),
        (["l515"], ("mine", None, None)),
        (["l515:f01"], ("mine", None, None)),
    ],
)
def test_bench_of_the_settings_gives_way_to_what_is_given(
    monkeypatch: pytest.MonkeyPatch, words: list[str], given: tuple[str | None, ...]
) -> None:
    calls: list[tuple[str | None, ...]] = []

    def command(
        camera: Camera = "sim",
        wall: Path | None = None,
        bench_folder: Annotated[Path | None, typer.Option("--bench")] = None,
        weights: Path | None = None,
    ) -> None:
        del camera
        found = bench_folder, wall, weights
        calls.append(tuple(None if one is None else str(one) for one in found))

    serve_as(monkeypatch, "live", command)
    text = 'bench = "mine"\nwall = "wall.toml"\nweights = "own"\n'
    Path(FILE).write_text(text, encoding="utf-8")

    assert main(["live", *words]) == 0
    assert calls == [given]


def see_nothing(
    camera: Camera = "sim",
    bench_folder: Annotated[Path | None, typer.Option("--bench")] = None,
) -> None:
    """Take a camera and a bench, as `live` does."""
    del camera, bench_folder


@pytest.mark.parametrize(
    ("serial", "words", "notes"),
    [("f0000001", [], 1), ("f0000001", ["--bench", "other"], 0), ("simulated", [], 0)],
)
def test_left_out_bench_is_noted_where_no_other_is_named(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    serial: str,
    words: list[str],
    notes: int,
) -> None:
    make_bench(Path("mine"), serial=serial)

    serve_as(monkeypatch, "live", see_nothing)
    Path(FILE).write_text('bench = "mine"\n', encoding="utf-8")

    assert main(["live", "sim", *words]) == 0
    assert capsys.readouterr().err.count("is not used with sim") == notes


@pytest.mark.parametrize(("serial", "used"), [("f0000001", False), ("simulated", True)])
def test_wall_of_a_lidar_is_not_used_with_sim(
    monkeypatch: pytest.MonkeyPatch, serial: str, used: bool
) -> None:
    make_bench(Path("mine"), serial=serial)
    record = next(Path("mine").rglob("wall.toml"))
    walls: list[Path | None] = []

    def command(camera: Camera = "sim", wall: Path | None = None) -> None:
        del camera
        walls.append(wall)

    serve_as(monkeypatch, "live", command)
    Path(FILE).write_text(f'wall = "{record}"\n', encoding="utf-8")

    assert main(["live", "sim"]) == 0
    assert (walls[0] is not None) == used


@pytest.mark.parametrize(
    ("serial", "words", "camera"),
    [
        ("f0000001", ["--bench", "bench"], "l515:f0000001"),
        ("f0000001", ["--bench", "bench", "sim:a"], "sim:a"),
        ("simulated", ["--bench", "bench"], "sim"),
        ("f0000001", [], "sim"),
        ("f0000001", ["--bench", "no-bench"], "sim"),
    ],
)
def test_bench_names_the_lidar_that_measured_it(
    monkeypatch: pytest.MonkeyPatch, serial: str, words: list[str], camera: str
) -> None:
    make_bench(Path("bench"), serial=serial)
    calls: list[str] = []

    def command(
        camera: Camera = "sim",
        bench_folder: Annotated[Path | None, typer.Option("--bench")] = None,
    ) -> None:
        del bench_folder
        calls.append(camera)

    serve_as(monkeypatch, "live", command)

    assert main(["live", *words]) == 0
    assert calls == [camera]


@pytest.mark.parametrize(
    ("serial", "words", "note"),
    [
        ("simulated", [], "no CAMERA is given, so that sim is used"),
        ("simulated", ["--bench", "bench"], "bench was measured on a scene that may be another"),
        ("simulated", ["sim"], ""),
        ("f0000001", ["--bench", "bench"], ""),
    ],
)
def test_command_without_a_camera_says_that_sim_is_used(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    serial: str,
    words: list[str],
    note: str,
) -> None:
    make_bench(Path("bench"), serial=serial)

    serve_as(monkeypatch, "live", see_nothing)

    assert main(["live", *words]) == 0
    found = capsys.readouterr().err
    assert note in found
    assert bool(note) == ("sim is used" in found)


@pytest.mark.parametrize(
    ("setting", "given", "another"),
    [
        ("l515", "l515:f01", False),
        ("l515:f01", "l515", False),
        ("l515:f01", "l515:f02", True),
        ("l515", "sim", True),
        ("sim:a", "l515", True),
    ],
)
def test_wall_of_the_settings_is_of_their_camera(setting: str, given: str, another: bool) -> None:
    assert _is_another(given, Value(setting, FILE)) is another
