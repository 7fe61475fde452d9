"""Studies, checks and the run on a GPU in the small: files are written, and figures are right where
they are known.
"""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_uncertainty import FakeUncertainty
from nlos_calibration import load_rig
from nlos_models import checkpoint
from nlos_models.training import MapSet
from small_frames import sheet_network
from small_maps import untrained_weights, use_small_networks

from nlos_cam.dataset import read_labelled
from nlos_cam.errors import NlosCamError
from nlos_cam.evaluate import TARGETS, seeded_objects
from nlos_cam.objects import benchmark_objects, object_box
from nlos_cam.recording import load_sidecar
from nlos_cam.render import MultiBounce, load_scene

RIG = load_rig("paper-rig")
Tool = Callable[[str], ModuleType]
Read = Callable[..., Any]
Patch = pytest.MonkeyPatch


@dataclass(frozen=True)
class Size:
    size: int


@pytest.fixture
def harness(tool: Tool, tmp_path: Path, monkeypatch: Patch) -> ModuleType:
    module = tool("harness")
    monkeypatch.setattr(module, "DOCS", tmp_path / "docs")
    monkeypatch.setattr(module, "cache_folder", lambda: tmp_path / "cache")
    return module


@pytest.fixture
def run(tool: Tool, harness: ModuleType, monkeypatch: Patch) -> Read:
    """Run a study's main with arguments, and return its JSON."""

    def call(line: str, result: str, *arguments: object) -> Any:
        monkeypatch.setattr("sys.argv", [*line.split(), *map(str, arguments)])
        tool(line.split(maxsplit=1)[0]).main()
        return json.loads((harness.DOCS / "figures" / f"{result}.json").read_text(encoding="utf-8"))

    return call


def test_studies_and_attacks_know_one_state_of_the_program(harness: ModuleType, tool: Tool) -> None:
    state = tool("program_state")

    assert harness.program_digest is state.program_digest
    assert state.program_digest() != state.program_digest("tools/studies")
    assert {"*.toml", "SHA256SUMS"} < set(state.PATTERNS)


def test_figures_come_back_as_written_a_record_a_line(harness: ModuleType) -> None:
    facts = {"a, {b}": [{"value": 0.5, "of": "two\nlines"}, {"value": [1, 2], "empty": []}]}
    text = harness.with_records_on_one_line(facts)

    assert json.loads(text) == facts
    assert '{ "value": 0.5, "of": "two\\nlines" }' in text.split("\n  ")[1]


def test_line_that_a_kill_cut_short_is_made_again(harness: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    path.write_text('{"a": 1}\n{"a": 2}\n{"a"', encoding="utf-8")

    assert [json.loads(line)["a"] for line in harness.whole_lines(path)] == [1, 2]
    with path.open("a", encoding="utf-8") as file:
        file.write('{"a": 3}\n')
    assert [json.loads(line)["a"] for line in harness.whole_lines(path)] == [1, 2, 3]
    assert harness.whole_lines(tmp_path / "none.jsonl") == []


def test_studies_ask_the_harness_for_what_it_has(harness: ModuleType) -> None:
    folder = Path(str(harness.__file__)).parent
    asked = {
        name
        for path in folder.glob("*.py")
        for name in re.findall(r"\bharness\.(\w+)", path.read_text(encoding="utf-8"))
    }

    assert len(asked) > 10
    assert [name for name in sorted(asked) if not hasattr(harness, name)] == []


def test_key_of_weights_is_of_their_names_and_contents(harness: ModuleType, tmp_path: Path) -> None:
    for name in ("one", "same", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text("other" if name == "other" else "one")
    key = harness.weights_key({"x": tmp_path / "one"})

    assert key == harness.weights_key({"x": tmp_path / "same"})
    assert key != harness.weights_key({"y": tmp_path / "one"})
    assert key != harness.weights_key({"x": tmp_path / "other"})


def test_bench_is_not_judged_as_adapted_for_fewer_minutes(tool: Tool, tmp_path: Path) -> None:
    benches = tool("benches")
    bench = benches.draw_bench(0, tmp_path)
    (tmp_path / "bench-1-30.json").write_text("{}", encoding="utf-8")
    (tmp_path / "bench-10-60.json").write_text("{}", encoding="utf-8")

    assert benches.judged(bench, 30.0) == {}
    with pytest.raises(NlosCamError, match="adapted for 30 minutes: 10 come before"):
        benches.judged(bench, 10.0)


def test_interrupted_collection_resumes_with_the_same_records(harness: ModuleType) -> None:
    measured: list[int] = []

    def measure(one: Size, generator: np.random.Generator) -> dict[str, float]:
        measured.append(one.size)
        if len(measured) == 4:
            raise KeyboardInterrupt
        return {"drawn": generator.uniform()}

    grid = [Size(1), Size(2)]
    with pytest.raises(KeyboardInterrupt):
        harness.collect("sizes", grid, measure, 2)
    resumed = harness.collect("sizes", grid, measure, 2)

    assert measured == [1, 1, 2, 2, 2]
    assert [(one["size"], one["seed"]) for one in resumed] == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert harness.collect("sizes", grid[:1], measure, 2) == resumed[:2]
    assert harness.fingerprint(grid, 2) != harness.fingerprint(grid, 2, "other weights")


def test_folder_of_results_takes_no_results_of_others(harness: ModuleType, tmp_path: Path) -> None:
    harness.claim(tmp_path / "work", weights="one")
    harness.claim(tmp_path / "work", weights="one")

    with pytest.raises(SystemExit, match="of another weights: name an empty folder, or remove"):
        harness.claim(tmp_path / "work", weights="two")
    (tmp_path / "work" / harness.CLAIM).unlink()
    harness.claim(tmp_path / "work", weights="two")


def test_interval_of_a_share_narrows_with_its_count(harness: ModuleType) -> None:
    few = harness.wilson(1, 10)
    many = harness.wilson(100, 1000)

    assert few["low"] < few["share"] == many["share"] < few["high"]
    assert few["high"] - few["low"] > 3 * (many["high"] - many["low"])


@pytest.mark.slow
def test_renderer_bench_agrees_with_the_cpu(run: Read, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(FileNotFoundError):  # it writes no file
        run(
            "renderer cuda --backend torch --accuracy draft --objects 1 --batch 1 --repeats 1",
            "cuda",
        )
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["difference_from_cpu"] < 1e-3


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: Patch) -> list[Path]:
    """Two untrained networks that take no time."""
    use_small_networks(monkeypatch, checkpoint)
    for seed, name in enumerate(("two", "one")):
        untrained_weights(tmp_path / name, rig=RIG, seed=seed, steps=name, objects=40 - 30 * seed)
    return [tmp_path / "two", tmp_path / "one"]


@pytest.mark.slow
def test_limits_leave_out_the_latent_of_weights_without_one(
    tool: Tool, weights: list[Path]
) -> None:
    some = seeded_objects(0, 1, object_box(RIG))
    rows = list(tool("weights").experiments(weights[1], some, some, frames=()))

    assert [row.name for row in rows] == [
        "as evaluated",
        "no silhouette step",
        "noise off",
        "training's objects",
    ]
    assert len(tool("weights").limits_table(rows).splitlines()) == 2 + len(rows)


@pytest.mark.slow
def test_rig_map_has_a_cell_for_every_place(
    tool: Tool, run: Read, weights: list[Path], monkeypatch: Patch
) -> None:
    module = tool("weights")
    record = SimpleNamespace(
        rig=None,
        bare_wall_counts=None,
        input="raw maps",
        rig_name=RIG.name,
        rig_checksum=RIG.checksum,
    )
    network = type("Plate", (), {"record": record, "__call__": sheet_network})()
    monkeypatch.setattr(module, "load_reconstructor", lambda *_: network)
    monkeypatch.setattr(module, "load_uncertainty_model", lambda *_, **__: None)
    monkeypatch.setattr(module, "benchmark_objects", lambda box: seeded_objects(0, 1, box))
    monkeypatch.setattr(module, "DISTANCES_M", (0.2,))
    monkeypatch.setattr(module, "ANGLES_DEG", (15.0, 45.0))
    monkeypatch.setattr(module, "BENCHES", [module.Place(aside_m=0.005, up_m=0.005)])
    table = run("weights rigs --weights", "rig_map", f"plate={weights[0]}")

    assert [(cell["distance_m"], cell["yaw_deg"]) for cell in table["cells"]] == [
        (0.2, 15.0),
        (0.2, 45.0),
    ]
    assert set(table["cells"][0]["weights"]["plate"]) >= set(TARGETS)
    assert [set(one["weights"]) for one in table["benches"]] == [
        {"plate", "plate, record off", "plate, not aligned"}
    ]


def test_transfer_curve_trains_on_nested_sets(tool: Tool, monkeypatch: Patch) -> None:
    transfer = tool("transfer")
    calls = list[list[str]]()
    sets = transfer.nested([Path(f"{k}.bag") for k in range(9)], (2, 5, 30))

    assert list(sets) == [2, 5, 9]
    assert set(sets[2]) < set(sets[5]) < set(sets[9])

    monkeypatch.setattr(
        transfer.harness, "nlos_cam", lambda arguments: calls.append(arguments) or len(calls) - 1
    )
    lesson = transfer.Lesson(Path("data"), Path("val"), 24, Path("run"))
    train = transfer.commanded("transfer", Path("r.toml"), "--weights", Path("w"))

    assert train(lesson) == Path("run")
    assert " ".join(calls[0]).endswith(
        "--dataset data --held-out val --objects 24 --out run --weights w"
    )

    with pytest.raises(Exception, match=r"train transfer .* ended with 1"):
        train(lesson)


def test_transfer_figures_of_exact_images_are_perfect(tool: Tool) -> None:
    image = np.where(np.indices((1, 64, 64))[2] > 20, np.float32(0.5), np.float32(0.0))
    maps = MapSet(np.zeros((1, 64, 80), np.float32), np.zeros((1, 64, 80), np.float32), image)
    box = tool("transfer").paper_box()
    exact = tool("transfer").judge(lambda *_: image, maps, box)
    near = tool("transfer").judge(lambda *_: image + np.float32(0.1) * (image > 0), maps, box)

    assert exact["silhouette_iou"]["value"] == 1
    assert exact["foreground_rmse_mm"]["value"] == 0
    assert near["foreground_too_far_mm"]["value"] == pytest.approx(-0.1 * 280 / 0.9, rel=1e-3)


def test_uncertainty_study_is_right_for_laplace_errors(tool: Tool, harness: ModuleType) -> None:
    study = tool("uncertainty")
    generator = np.random.default_rng(0)
    expected = generator.uniform(0.005, 0.05, 100_000)
    observed = np.abs(generator.laplace(0.0, expected))
    rows = study.reliability(expected, observed)
    covered = study.coverage(expected, observed)

    assert all(row["observed_mm"] == pytest.approx(row["expected_mm"], rel=0.05) for row in rows)
    assert all(row["observed"] == pytest.approx(row["level"], abs=0.01) for row in covered)

    pipeline = study.Pipeline(RIG, sheet_network, FakeUncertainty(error_v=0.2))
    answer = pipeline.answer(np.full((64, 80), 0.3, np.float32), np.ones((64, 80), np.float32))

    assert study.of_outliers([answer, answer], np.array([100, 0]))["cannot_be_seen"] == 1

    parts = {
        "reliability": rows,
        "coverage": covered,
        "surface": [{"expected": 0.5, "observed": 0.6}],
    }
    harness.save("reliability", study.draw({"test_objects": parts, "held_out_objects": parts}))


def test_color_study_judges_weights_and_vae(tool: Tool, tmp_path: Path, monkeypatch: Patch) -> None:
    color = tool("color")
    things = 6
    truth = np.zeros((things, 3, 64, 64), np.float32)
    truth[:, :, 20:40, 20:40] = 0.7
    maps = MapSet(np.ones((things, 64, 80)), np.ones((things, 3, 64, 80)), truth)
    replaced = {
        "painted_maps": lambda *_: maps,
        "load_network": lambda _: ("network", None),
        "load_vae": lambda _: ("vae", None),
        "run": lambda _network, given: given.image,
        "rebuild": lambda _vae, image: np.zeros_like(image),
        "open_dataset": lambda *_, **__: SimpleNamespace(column=lambda _: truth),
    }
    for name, fake in replaced.items():
        monkeypatch.setattr(color, name, fake)
    given = ["--weights", "w", "--vae", "v", "--dataset", "d", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", ["color", *given])
    color.main()
    figures = json.loads((tmp_path / "figures.json").read_text(encoding="utf-8"))

    assert figures["silhouette_iou"]["value"] == 1
    assert figures["baselines"]["vae_alone"]["silhouette_iou"]["value"] == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "figures.json",
        "sheet.png",
        "sheet-vae.png",
    }


def test_word_check_counts_patterns_with_their_lines(
    tool: Tool, tmp_path: Path, monkeypatch: Patch
) -> None:
    words = tool("words")
    monkeypatch.setattr(words, "ROOT", tmp_path)
    (tmp_path / "a.py").write_text('"""What is told\nmeanwhile."""\nMOST_X = 1\n', encoding="utf-8")
    found = words.findings(*words.scan(tmp_path), docstrings=True)
    counts = {key: len(lines) for key, (_, lines) in found.items()}

    assert counts == {"begin": 1, "what": 1, "tell": 1, "so": 0, "rare": 1, "names": 1}
    assert found["rare"][1][0].startswith("a.py:2:")


@pytest.mark.slow
def test_a_recording_is_of_its_object_on_the_bench_and_labelled(
    tool: Tool, tmp_path: Path, monkeypatch: Patch
) -> None:
    whole = load_scene(Path(__file__).parents[3] / "examples" / "bench.toml")
    rendered = list[Any]()
    small = whole.rig.intrinsics.model_copy(
        update=vars(whole.rig.pinhole.scaled(80, 64))
    )  # few pixels
    scene = whole.model_copy(update={"rig": whole.rig.model_copy(update={"intrinsics": small})})

    def render(scene: Any) -> Any:
        """Echoes of nothing but a depth, which take no time."""
        rendered.append(scene)
        peak = np.full((64, 80), 1e-4, np.float32)
        path_m = np.full((64, 80), 2 * np.nanmin(scene.object_depth_m), np.float32)
        return SimpleNamespace(multi=MultiBounce(peak, peak / 4, path_m, direct_included=True))

    monkeypatch.setattr(tool("transfer"), "render", render)
    things = benchmark_objects(object_box(RIG))
    paths = list(tool("transfer").record_all(scene, things[:2], tmp_path, 3, lambda *_: None))

    assert [path.name for path in paths] == ["airplane-1.bag", "airplane-2.bag"]

    for path, thing, shown in zip(paths, things[:2], rendered, strict=True):
        sidecar = load_sidecar(path.with_suffix(".json"))
        assert (sidecar.label, sidecar.state, sidecar.rig) == (thing.name, "complete", scene.rig)
        np.testing.assert_array_equal(shown.object_depth_m, thing.depth_m)
        assert (shown.rig, shown.pulse_ns) == (scene.rig, scene.sensor.pulse_ns)
        read = read_labelled([path], known=lambda _: {})
        np.testing.assert_array_equal(read.object_depth_m, np.stack([thing.depth_m] * 3))


def test_every_command_is_started_after_the_bare_interpreter(tool: Tool) -> None:
    start = tool("start")
    names = list(start.programs())

    assert names[:2] == [start.BARE, start.NUMPY]

    commands = {"--version", "doctor", "live --help", "train --help", "train compressor --help"}

    assert commands <= set(names)


def test_starts_are_compared_with_the_bare_interpreter(tool: Tool) -> None:
    start = tool("start")
    times = {
        start.BARE: start.Times(0.02, 0.01),
        start.NUMPY: start.Times(0.1, 0.1),
        "live": start.Times(0.4, 0.3),
    }

    assert start.table(times).splitlines()[-1] == "| `live` | 0.40 | 0.30 | 20.0 | 4.0 |"


def test_timed_program_must_end_well(tool: Tool) -> None:
    start = tool("start")

    assert start.timed(["-c", "print('x')"]).wall_s > 0

    with pytest.raises(RuntimeError, match="exit code 7"):
        start.timed(["-c", "raise SystemExit(7)"])


EPOCH = "epochs = 1\nbatch = 16\nlearning_rate = 1e-3\n"
MAPS = "objects = 64\nheld_out = 20\n" + EPOCH
DIRECT = "[direct]\nfeatures = 8\nwidth = 8\nblocks = 1\ntoken = 8\nmixers = 1\n"
RECIPES = {
    "small": (
        'task = "direct"\nschedule = "cosine"\nwarm_up_steps = 2\naverage = 0.9\n' + MAPS + DIRECT
    ),
    "encoder": (
        'task = "vae"\nstart = "decoder"\nschedule = "one-cycle"\nobjects = 16\nheld_out = 4\n'
        + EPOCH
    ),
    "compressor": (
        'task = "compressor"\nschedule = "one-cycle"\nimage_weight = 1.0\nwidth = 0.1\n' + MAPS
    ),
}


def test_parts_are_small_and_join_to_the_same_files(
    tool: Tool, tmp_path: Path, monkeypatch: Patch
) -> None:
    gpu = tool("gpu_run")
    folder = tmp_path / "weights"
    monkeypatch.setattr(gpu, "PART_BYTES", 1000)
    folder.mkdir()
    contents = {
        name: np.random.default_rng(k).bytes(1700)
        for k, name in enumerate(("a.safetensors", "b.json"))
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    (tmp_path / "direct.07").write_bytes(b"of a longer run before")
    parts = gpu.write_parts(folder, list(contents), tmp_path / "direct.zip")

    assert len(parts) == 4
    assert max(part.stat().st_size for part in parts) <= 1000

    gpu.join_parts(parts[0], tmp_path / "joined")

    assert {path.name: path.read_bytes() for path in (tmp_path / "joined").iterdir()} == contents


def test_epochs_fit_the_time_by_those_after_the_first(tool: Tool, tmp_path: Path) -> None:
    gpu = tool("gpu_run")
    log = tmp_path / "log.csv"
    log.write_text("epoch,loss,seconds\n0,1,30.0\n1,1,8.0\n2,1,12.0\n", encoding="utf-8")

    assert gpu.epochs_within(100, log) == 7

    log.write_text("epoch,loss,seconds\n", encoding="utf-8")
    with pytest.raises(SystemExit, match="more --minutes"):
        gpu.epochs_within(100, log)


def test_epochs_go_into_the_recipe(tool: Tool, tmp_path: Path) -> None:
    gpu = tool("gpu_run")
    recipe = tmp_path / "a.toml"
    recipe.write_text("objects = 5\nepochs = 3\n", encoding="utf-8")
    made = gpu.recipe_with(recipe, tmp_path / "b.toml", epochs=70)

    assert made.read_text(encoding="utf-8") == "objects = 5\nepochs = 70\n"
    recipe.write_text("objects = 5\n", encoding="utf-8")
    with pytest.raises(SystemExit, match="no line `epochs"):
        gpu.recipe_with(recipe, tmp_path / "b.toml", epochs=70)


@pytest.mark.slow
@pytest.mark.timeout(1200)  # processes start, render, train and evaluate one after the other
def test_whole_run_in_the_small(tool: Tool, tmp_path: Path, monkeypatch: Patch) -> None:
    gpu = tool("gpu_run")
    monkeypatch.setattr(gpu, "DIRECT_SHARE", 1e-9)  # two epochs
    monkeypatch.setattr(gpu, "TIMING_SHARE", 1.0)
    monkeypatch.setattr(gpu, "OBJECTS", 200)  # else it renders beside everything that follows
    for name, text in RECIPES.items():
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
    recipes = [
        part
        for name in ("encoder", "compressor")
        for part in (f"--{name}", str(tmp_path / f"{name}.toml"))
    ]
    recipes += [
        "--recipe",
        str(tmp_path / "small.toml"),
        "--out",
        str(tmp_path / "out"),
        "--accelerator",
        "cpu",
    ]
    small = "--held-out 20 --first-objects 100 --compressor-epochs 1 --minutes 20 --workers 1"
    gpu.train_and_judge(gpu.options().parse_args([*recipes, *small.split()]))
    facts = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))

    assert facts["objects"] >= 100

    for name in ("direct", "compressor"):
        assert 0 <= facts[name]["unseen"]["silhouette_iou"]["value"] <= 1
        assert facts[f"{name}_parts"][0] == f"{name}.00"
