"""`render`: objects to files of maps, options that reach the scene or the accuracy, and exit
codes.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from nlos_calibration import Extent
from nlos_calibration.rig import Rig, dump_toml, load_rig

from nlos_cam.cli.render import hidden_depth
from nlos_cam.errors import SceneError
from nlos_cam.objects.placement import object_depth
from nlos_cam.render import (
    EFFECTS,
    HiddenObject,
    Material,
    Scene,
    SceneFile,
    SensorModel,
    render,
    sensor_effects,
)
from nlos_cam.transients import Capture, Noise

Run = Callable[..., Any]
DRAFT = "--accuracy", "draft", "--out", "maps.npz", "--overwrite"

RIG = load_rig("paper-rig")
NAMES = [*EFFECTS, *(effect.name for effect in sensor_effects(SensorModel()))]


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures take a second each."""
    monkeypatch.setattr("nlos_cam.cli.render._draw", lambda path, *_: path.touch())


@pytest.fixture
def rendered(run: Run) -> Run:
    """Render in draft unless a bound is given; returns the JSON result and the contents of the
    file.
    """

    def call(hidden: object, *options: object) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        chosen = DRAFT[2:] if any(str(option).startswith("--max") for option in options) else DRAFT
        result = run("render", hidden, *chosen, *options)
        with np.load(result["out"]) as file:
            return result, dict(file)

    return call


def test_render_writes_maps(rendered: Run, tmp_path: Path) -> None:
    out = tmp_path / "cup.npz"

    result, file = rendered("cup", "--out", out)

    assert result["accuracy"] == "draft"
    assert result["out"] == str(out)
    assert result["seconds"] > 0
    assert file["depth_m"].shape == file["intensity"].shape == file["margin"].shape == (64, 80)
    assert file["object_depth_m"].shape == (64, 64)
    assert str(file["rig_name"]) == RIG.name
    assert str(file["rig_checksum"]) == RIG.checksum


def test_render_writes_picture(
    rendered: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.undo()  # the picture is drawn

    rendered("cup", "--out", tmp_path / "cup.npz")

    assert (tmp_path / "cup.png").read_bytes().startswith(b"\x89PNG")


def test_render_explains_its_effects(rendered: Run) -> None:
    keys = {"name", "included", "reason", "bound", "seconds"}

    result, _ = rendered("cup", "--explain")

    assert [effect["name"] for effect in result["effects"]] == NAMES
    assert all(set(effect) == keys for effect in result["effects"])
    assert "self-occlusion" in result.err


def test_render_of_a_depth_map_equals_the_library(rendered: Run) -> None:
    depth_m = object_depth(2, RIG.object_box)[1]
    np.save("thing.npy", depth_m)
    _, file = rendered("thing.npy")
    expected = render(Scene(RIG, depth_m), "draft")

    np.testing.assert_array_equal(file["depth_m"], expected.depth_m)
    np.testing.assert_array_equal(file["intensity"], expected.intensity)
    np.testing.assert_array_equal(file["object_depth_m"], depth_m)


@pytest.mark.parametrize("kind", ["category", "file"])
def test_render_places_its_object_as_a_scene_file_does(mesh: str, rendered: Run, kind: str) -> None:
    """Every option is given, and each arrives."""
    name, only = {"category": ("hat", {"seed": 4}), "file": (mesh, {"up": "z"})}[kind]
    pose = {"size_m": 0.15, "tilt_x_deg": -10.0, "tilt_y_deg": 200.0, "turn_deg": 30.0}
    fields = {**pose, "x_m": -0.01, "y_m": 0.02, "front_m": 0.05, **only}
    options = [
        text for field, value in fields.items() for text in (f"--{field.replace('_', '-')}", value)
    ]

    np.testing.assert_array_equal(
        rendered(name, *options)[1]["object_depth_m"], _of_scene(**{kind: name, **fields})
    )


def test_render_takes_the_rig_of_a_scene_and_reports_its_file(rendered: Run) -> None:
    lent = SceneFile(name="a scene", rig=RIG.model_copy(update={"name": "lent"}))
    Path("scene.toml").write_text(dump_toml(lent), encoding="utf-8")

    assert str(rendered("hat", "--scene", "scene.toml")[1]["rig_name"]) == "lent"

    result, _ = rendered("cup", "--out", "other")

    assert Path(result["out"]).is_file()


@pytest.fixture
def plate() -> str:
    depth = np.full((16, 16), np.nan, np.float32)
    depth[4:12, 4:12] = 0.2
    np.save("plate.npy", depth)
    return "plate.npy"


def _included(result: dict[str, Any]) -> set[str]:
    return {effect["name"] for effect in result["effects"] if effect["included"]}


@pytest.mark.slow
def test_render_takes_a_material_and_an_albedo(plate: str, rendered: Run) -> None:
    result, _ = rendered(plate, "--material", "phong", "--specular", "0.3", "--exponent", "4")

    assert "brdf" in _included(result)

    (_, black), (_, white) = (rendered(plate, "--albedo", albedo) for albedo in "01")

    assert (white["intensity"] > black["intensity"]).any()


def test_render_keeps_the_material_of_a_scene(
    plate: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    glossy = Material(kind="phong", specular=0.6, exponent=9)
    hidden = HiddenObject(category="cup", material=glossy)
    scene = SceneFile(name="glossy", rig=RIG, object=hidden)
    Path("scene.toml").write_text(dump_toml(scene), encoding="utf-8")
    scenes = list[Scene]()
    draw = "nlos_cam.cli.render.renderer.render"
    monkeypatch.setattr(draw, lambda scene, *_: scenes.append(scene) or render(Scene(RIG), "draft"))
    run("render", plate, *DRAFT, "--scene", "scene.toml", "--albedo", "0.5")
    run("render", plate, *DRAFT, "--scene", "scene.toml", "--specular", "0.1")

    assert scenes[0].surface.brdf == glossy.brdf
    assert scenes[0].surface.albedo == 0.5
    assert scenes[1].surface.brdf == Material(kind="phong", specular=0.1, exponent=9).brdf


def test_render_replaces_a_picture_only_when_asked(plate: str, run: Run) -> None:
    Path("maps.png").write_text("mine")
    result = run("render", plate, "--accuracy", "draft", "--out", "maps.npz", code=1)

    assert "maps.png" in result["error"]["message"]
    assert Path("maps.png").read_text() == "mine"
    assert not Path("maps.npz").exists()

    run("render", plate, *DRAFT)


def test_render_explains_an_empty_scene(rendered: Run) -> None:
    np.save("none.npy", np.full((16, 16), np.nan, np.float32))
    result, _ = rendered("none.npy", "--explain")
    seconds = {effect["name"]: effect["seconds"] for effect in result["effects"]}

    assert seconds["direct"] == 0.0


def test_render_with_three_albedos_gives_color(plate: str, rendered: Run) -> None:
    result, file = rendered(plate, "--albedo", "0.9,0.5,0.1")

    assert "colour" in _included(result)
    assert file["colour"].shape == (64, 80, 3)
    assert (file["colour"][..., 0] >= file["colour"][..., 2]).all()
    assert (file["colour"][..., 0] > file["colour"][..., 2]).any()


def test_render_takes_effects_radiometry_pulse_and_beams(plate: str, rendered: Run) -> None:
    only, _ = rendered(plate, "--effects", "three-bounce")

    assert _included(only) & {"direct", "occluder", "three-bounce"} == {"three-bounce"}

    plain, sharp = rendered(plate)
    _, lambertian = rendered(plate, "--radiometry", "lambertian")

    assert str(sharp["radiometry"]) == "paper"
    assert str(lambertian["radiometry"]) == "lambertian"
    assert (
        lambertian["intensity"].max() > 1.5 * sharp["intensity"].max()
    )  # 1/pi in place of 1/(2 pi)

    wide, blurred = rendered(plate, "--pulse-ns", "1")

    assert "pulse" in _included(wide) - _included(plain)

    for _, other in ((wide, blurred), rendered(plate, "--beams-per-cell", "2")):
        assert not np.array_equal(sharp["intensity"], other["intensity"])


@pytest.mark.slow
def test_render_takes_the_fastest_stop_within_an_error(plate: str, rendered: Run) -> None:
    assert rendered(plate, "--max-error", "0.9")[0]["accuracy"] == "draft"


@pytest.mark.slow
def test_render_takes_the_best_stop_within_a_time(plate: str, rendered: Run) -> None:
    assert rendered(plate, "--max-seconds", "0.02")[0]["accuracy"] == "standard"


@pytest.fixture
def mesh() -> str:
    corners = [(0, 0, 0), (1, 0, 0), (0, 0.6, 0), (0, 0, 0.4)]
    solid = trimesh.Trimesh(corners, [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)], process=False)
    solid.export("wedge [b].stl")
    return "wedge [b].stl"


def _of_scene(rig: Rig = RIG, **fields: Any) -> np.ndarray:
    return SceneFile(name="same", rig=rig, object=HiddenObject(**fields)).scene_at(0).object_depth_m


def test_hidden_depth_takes_a_depth_map_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    depth = _of_scene(category="hat")
    np.save("hat.NPY.npy", depth)

    np.testing.assert_array_equal(hidden_depth("hat.NPY.npy", RIG, {"size_m": None}), depth)
    assert capsys.readouterr().err == ""

    np.save("none [b].npy", np.full((64, 64), np.nan))

    assert np.isnan(hidden_depth("none [b].npy", RIG, {})).all()

    warning = capsys.readouterr().err

    assert ("none [b].npy" in warning, warning.count("\n")) == (True, 1)


def test_hidden_depth_warns_of_object_cut_or_flattened_by_box(
    mesh: str, capsys: pytest.CaptureFixture[str]
) -> None:
    trimesh.creation.box(extents=(1, 0.2, 0.01)).export(plate := "plate [b].ply")
    half = hidden_depth(plate, RIG, {"size_m": 0.2, "x_m": 0.125})  # the box ends in its middle
    flat = hidden_depth(mesh, RIG, {"tilt_y_deg": 90, "front_m": 0.2})
    of_half, of_flat = capsys.readouterr().err.splitlines()

    assert f"{plate}: 50%" in of_half
    assert np.isfinite(half[:, -1]).any()
    assert np.isnan(half[:, 0]).all()
    assert all(word in of_flat for word in (mesh, "0.3 m", "0.08 m"))
    assert np.nanmax(flat) <= RIG.object_box.z_far_m + 1e-6


def test_every_option_of_a_transient_reaches_the_capture(
    plate: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    captures: list[Capture] = []

    def keep(_: Scene, capture: Capture, *__: object) -> None:
        captures.append(capture)
        raise SceneError("nothing is rendered here")

    monkeypatch.setattr("nlos_cam.transients.render_transient", keep)
    options = (
        "--capture single --wall-cells 5 --wall-extent 0.4,0.6,-0.1,0.1 --laser 0.5,0.02"
        " --bin-mm 2.5 --start-m 0.25 --bins 40 --wall-to-wall --photons 900 --background 3"
        " --noise-seed 7"
    )
    run("render", plate, "--transient", "light.hdf5", *options.split(), code=1)
    noise = Noise(900.0, 3.0, 7)
    wall = Extent(x_min_m=0.4, x_max_m=0.6, y_min_m=-0.1, y_max_m=0.1)

    assert captures == [
        Capture("single", 5, wall, (0.5, 0.02), 0.0025, 0.25, 40, first_and_last=False, noise=noise)
    ]
